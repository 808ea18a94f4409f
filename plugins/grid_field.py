"""The volume `grid_field`."""

from __future__ import annotations

import mitsuba as mi

from mi_nerfattack.plugins.field_volume import AbstractFieldVolume


class GridFieldVolume(AbstractFieldVolume):
    r"""
    .. _volume-grid_field:

    Decoder-free grid field (:monosp:`grid_field`)
    ----------------------------------------------

    .. pluginparameters::
     :extra-rows: 6

     * - filename
       - |string|
       - Field file, of ``mi-nerfattack asset``: relative to the scene file, or
         :monosp:`bundled:FILE`

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale, field to world, metres.
         (Default: identity)

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
       - Lit by the scene's emitters, in ``field_integrator`` alone.
         (Default: |false|)

     * - texture
       - |tensor|
       - Raw colours of the vertices of all levels, (n, 3)
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

    Where the file calls space empty, the density is 0 whatever ``density`` says: see
    ``fields.window``. Not differentiable: the pose.
    """

    kind = "grid_field"
    parameter_names = ("texture", "density")


mi.register_texture("grid_field", lambda props: GridFieldVolume(props))
