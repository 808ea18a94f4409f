"""The volume `splat_background`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NoReturn

import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.compact_splats import load_splats
from mi_nerfattack.plugins.properties import Mask, read_filename, read_pose
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.splatting.background import SplatBackground


class SplatBackgroundVolume(mi.Volume):
    r"""
    .. _volume-splat_background:

    Gaussian splats as a background (:monosp:`splat_background`)
    ------------------------------------------------------------

    .. pluginparameters::
     :extra-rows: 2

     * - filename
       - |string|
       - .ply of a 3D Gaussian splatting trainer (``f_dc_*``, ``opacity``, ``scale_*``,
         ``rot_*``, ``f_rest_*``), .spz or .splat

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale (metres per unit of the file), file
         to world. (Default: identity)

     * - harmonics
       - :paramtype:`float[]`
       - Coefficients of the colours' spherical harmonics, (n k 3,), in the order of the
         file's splats; the first three of each are its ``f_dc_*``
       - |exposed|, |differentiable|

     * - opacity
       - :paramtype:`float[]`
       - Opacities at the splats' centres, (n,), within 0 and 1
       - |exposed|, |differentiable|

    The scene that a 3D Gaussian splatting trainer wrote, seen by ``field_integrator``
    behind, between and in front of fields, by depth. It is rasterised, for any lens,
    with the kernel of Mitsuba's ``volprim_rf_basic``. The distance of their peaks on a
    ray orders the splats:
    ``I = sum_i c_i a_i prod_{j<i} (1 - a_j)``. A splat's opacity is
    ``a_i = min(opacity_i exp(-m_i^2 / 2), 0.9999)``. Here ``m_i`` is the least
    distance of the ray from the centre in standard deviations, at most 3. See
    ``render.splatting``.

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
    ``drjit.freeze`` cannot record them.
    Derivatives are by ``harmonics`` and ``opacity``, in both modes, and by the sensor
    in backward mode. The edges of splats, three standard deviations away, and their
    order count as constants: neither has a derivative.
    """

    def __init__(
        self, props: mi.Properties, posed: SplatBackground | None = None
    ) -> None:
        spectrum.prepare()
        if posed is None:
            pose, name = read_pose(props), read_filename(props)
            posed = SplatBackground(load_splats(name), pose)
        super().__init__(props)
        self.posed = posed
        self.relit = False

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the colours and opacities of the splats, in the order of the file."""
        for name, value in self.posed.parameters().items():
            cb.put(name, value, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Hand changed parameters to the splats.

        Raises:
            InputError: a value that is not allowed, with its name.
        """
        del keys
        self.posed.update()

    def tangents(self) -> AbstractContextManager[None]:
        """See :meth:`AbstractFieldVolume.tangents`: marches read the parameters."""
        return nullcontext()

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
