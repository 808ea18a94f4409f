"""The volume `brick_field`."""

from __future__ import annotations

import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import BrickField
from mi_nerfattack.plugins.field_volume import AbstractFieldVolume
from mi_nerfattack.render.posed import PosedField


class BrickFieldVolume(AbstractFieldVolume):
    r"""
    .. _volume-brick_field:

    Field baked into bricks (:monosp:`brick_field`)
    -----------------------------------------------

    .. pluginparameters::
     :extra-rows: 6

     * - filename
       - |string|
       - Field file, of ``mi-nerfattack bake``: relative to the scene file, or
         :monosp:`bundled:FILE`

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale, field to world, metres.
         (Default: identity)
       - |exposed|

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

     * - relit
       - |bool|
       - Must be false: bricks have no normals. (Default: |false|)

    A reconstructed scene that is fast to look up. Each occupied cell has a brick, and
    each vertex of a brick a density and a radiance, which are interpolated trilinearly.
    An image of the sky lies behind. The volume shows what an ``ngp_field`` with
    ``skip_thin`` shows that it was baked from, without the effects of direction.

    .. tabs::
        .. code-tab:: xml

            <volume type="brick_field" id="scene">
                <string name="filename" value="bricks.safetensors"/>
            </volume>

        .. code-tab:: python

            {"type": "brick_field", "filename": "bricks.safetensors"}

    Nothing is differentiated by it, nor by ``to_world`` or the sensor, since its values
    jump from brick to brick.
    """

    kind = "brick_field"
    field: BrickField
    skips_thin = True

    def __init__(self, props: mi.Properties, posed: PosedField | None = None) -> None:
        super().__init__(props, posed)
        if self.relit:
            raise InputError(
                f"{self.id()}: a brick_field has no normals and cannot be relit; set "
                "relit to false, or give the field that it was baked from"
            )

    def resolution(self) -> mi.ScalarVector3i:
        """Return the number of cells along the edges."""
        return mi.ScalarVector3i(self.field.occupancy.shape)


mi.register_texture("brick_field", lambda props: BrickFieldVolume(props))
