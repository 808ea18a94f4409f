"""The volume `ngp_field`."""

from __future__ import annotations

import mitsuba as mi

from mi_nerfattack.plugins.field_volume import AbstractFieldVolume


class NGPFieldVolume(AbstractFieldVolume):
    r"""
    .. _volume-ngp_field:

    Instant-NGP field (:monosp:`ngp_field`)
    ---------------------------------------

    .. pluginparameters::
     :extra-rows: 7

     * - filename
       - |string|
       - Field file, of ``mi-nerfattack fit``: relative to the scene file, or
         :monosp:`bundled:FILE`

     * - to_world
       - |transform|
       - Rotation, translation and uniform scale, field to world, metres.
         (Default: identity)
       - |exposed|, |differentiable|

     * - quantity
       - |string|
       - What it is in a medium: :monosp:`density` or :monosp:`radiance` (seen along
         the field's +z).
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

     * - table
       - :paramtype:`float[]`
       - Features of the hash grid
       - |exposed|, |differentiable|

     * - density_weights, colour_weights
       - :paramtype:`float[]`
       - Weights of the two networks
       - |exposed|, |differentiable|

     * - sky
       - :paramtype:`float[]`
       - Image of what lies behind, by direction
       - |exposed|, |differentiable|

    Hash grid, density network and view-dependent colour network (Mueller et al.
    2022) with an image of the sky behind. In a stock ``heterogeneous`` medium it
    serves as ``sigma_t``; inside ``field_emitter`` and ``field_integrator`` density
    and radiance are used.

    .. tabs::
        .. code-tab:: xml

            <volume type="ngp_field" id="scene">
                <string name="filename" value="field.safetensors"/>
            </volume>

        .. code-tab:: python

            {"type": "ngp_field", "filename": "field.safetensors"}

    A new ``to_world`` moves the field, except in media. Derivatives by it are in
    backward mode alone, and need an empty cell, as those of ``grid_field``. Media step
    by the largest density, an estimate (see ``NGPField.density_bound``):
    ``density_limit`` makes it sharp and small.
    """

    kind = "ngp_field"


mi.register_texture("ngp_field", lambda props: NGPFieldVolume(props))
