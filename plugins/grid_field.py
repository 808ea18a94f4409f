"""The volume `grid_field`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

import mitsuba as mi

from mi_nerfattack.fields import GridField
from mi_nerfattack.fields.vertex_colours import tangents
from mi_nerfattack.plugins.field_volume import AbstractFieldVolume


class GridFieldVolume(AbstractFieldVolume):
    r"""
    .. _volume-grid_field:

    Decoder-free grid field (:monosp:`grid_field`)
    ----------------------------------------------

    .. pluginparameters::
     :extra-rows: 7

     * - filename
       - |string|
       - Field file, of ``mi-nerfattack asset``: relative to the scene file, or
         :monosp:`bundled:FILE`

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale, field to world, metres.
         (Default: identity)
       - |exposed|, |differentiable|

     * - quantity
       - |string|
       - What it is in a medium: :monosp:`density` or :monosp:`radiance`.
         (Default: :monosp:`density`)

     * - density_limit
       - |float|
       - Cuts the density, 1/metre, in media alone. (Default: infinite)

     * - step_m
       - |float|
       - Step of the march, metres in the field's frame. (Default: that of the file)

     * - skip_thin
       - |bool|
       - Let rays skip parts of cells that the fit found too thin to matter, which is
         faster; no derivative by ``to_world`` or the sensor then. (Default: |false|)

     * - relit
       - |bool|
       - Lit by the scene's emitters, in ``field_integrator`` alone.
         (Default: |false|)

     * - colour
       - |tensor|
       - sRGB colours of the vertices of the finest level, (n, 3), in (0, 1)
       - |exposed|, |differentiable|

     * - density
       - :paramtype:`float[]`
       - Raw densities of the vertices of all levels, (n,)
       - |exposed|, |differentiable|

    Density ``s exp(sum_l d_l(x))`` and radiance
    ``srgb_to_linear(sigmoid(sum_l c_l(x)))`` of trilinearly interpolated vertices of
    several levels (appendix A.4.1). In a stock ``heterogeneous`` medium it serves as
    ``sigma_t`` (quantity ``density``) or ``albedo`` (quantity ``radiance``); inside
    ``field_emitter`` and ``field_integrator`` both are used.

    .. tabs::
        .. code-tab:: xml

            <volume type="grid_field" id="object">
                <string name="filename" value="hydrant.safetensors"/>
                <transform name="to_world"><scale value="2"/></transform>
            </volume>

        .. code-tab:: python

            {
                "type": "grid_field",
                "filename": "hydrant.safetensors",
                "to_world": mi.ScalarTransform4f().scale(2),
            }

    Media step by the largest density: in an object as opaque as fitted ones are
    (7,700/metre), a path takes thousands of steps. ``density_limit`` 500 still lets no
    light pass more than a centimetre (0.7 %).

    ``colour`` represents the texture of all levels: a step of an optimiser is a change
    of colour by that step. Keep it above 0 and below 1, for instance by
    ``dr.clip(colour, 0.01, 0.99)``. Where the file calls space empty, the density is 0
    whatever ``density`` says: see ``fields.occupancy``. A new ``to_world`` moves the
    field, except in media. Derivatives by it are in backward mode alone, and need an
    empty cell: else the density ends at the faces of the field's box at once.
    """

    kind = "grid_field"
    field: GridField

    def parameters(self) -> dict[str, Any]:
        """Return the colours of the finest level's vertices, and the densities."""
        return {
            "colour": self.field.colours.value,
            "density": self.field.parameters()["density"],
        }

    def _tangents(self) -> AbstractContextManager[None]:
        return tangents(self.field)


mi.register_texture("grid_field", lambda props: GridFieldVolume(props))
