"""The volume `splat_background`."""

from __future__ import annotations

from typing import Any, NoReturn

import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.splats import read_splats
from mi_nerfattack.plugins.properties import Mask, read_filename, read_pose
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.splats import SplatBackground


class SplatBackgroundVolume(mi.Volume):
    r"""
    .. _volume-splat_background:

    Gaussian splats as a constant background (:monosp:`splat_background`)
    ---------------------------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - .ply of a 3D Gaussian splatting trainer: ``f_dc_*``, ``opacity``,
         ``scale_*``, ``rot_*``, ``f_rest_*``

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale (metres per unit of the file), file
         to world. (Default: identity)

    The scene that a 3D Gaussian splatting trainer wrote, seen by ``field_integrator``
    behind, between and in front of fields, by depth. Rays meet splats through Mitsuba's
    ``ellipsoids``, with the kernel of ``volprim_rf_basic``. The distance of their peaks
    orders the splats: ``I = sum_i c_i a_i prod_{j<i} (1 - a_j)``. A splat's opacity is
    ``a_i = min(opacity_i exp(-m_i^2 / 2), 0.9999)``. Here ``m_i`` is the least
    distance of the ray from the centre in standard deviations, at most 3. See
    ``render.splats``.

    .. tabs::
        .. code-tab:: xml

            <integrator type="field_integrator">
                <string name="composite" value="depth"/>
                <volume type="splat_background" id="street">
                    <string name="filename" value="street.ply"/>
                </volume>
                <volume type="grid_field" id="object">
                    <string name="filename" value="hydrant.safetensors"/>
                </volume>
            </integrator>

        .. code-tab:: python

            {
                "type": "field_integrator",
                "composite": "depth",
                "street": {"type": "splat_background", "filename": "street.ply"},
                "object": {"type": "grid_field", "filename": "hydrant.safetensors"},
            }

    Limits: a layer of the ``depth`` composite alone; splats have no density, so that
    ``interleaved``, media and ``field_emitter`` refuse them, and so does ``relit``.
    It has no parameters in ``mi.traverse``, and nothing is differentiated by it.
    """

    def __init__(
        self, props: mi.Properties, posed: SplatBackground | None = None
    ) -> None:
        spectrum.prepare()
        if posed is None:
            pose, name = read_pose(props), read_filename(props)
            posed = SplatBackground(read_splats(name), pose)
        super().__init__(props)
        self.posed = posed
        self.relit = False

    def eval(self, it: mi.Interaction3f, active: Mask = True) -> Any:
        """Refuse to be a medium."""
        del it, active
        self._refuse()

    def eval_1(self, it: mi.Interaction3f, active: Mask = True) -> mi.Float:
        """Refuse to be a medium."""
        del it, active
        self._refuse()

    def max(self) -> float:
        """Refuse to be a medium."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        raise InputError(
            f"{self.id()}: a splat_background is no medium; nest it in a "
            "field_integrator with composite 'depth'"
        )

    def to_string(self) -> str:
        """Describe the checked parameters."""
        return f"splat_background[{self.posed.name}]"


mi.register_texture("splat_background", lambda props: SplatBackgroundVolume(props))
