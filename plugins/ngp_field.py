"""The volume `ngp_field`."""

from __future__ import annotations

import mitsuba as mi

from mi_nerfattack.plugins.field_volume import AbstractFieldVolume


class NGPFieldVolume(AbstractFieldVolume):
    r"""Instant-NGP field (``ngp_field``).

    Hash grid, density network and view-dependent colour network (Mueller et al.
    2022) with an image of the sky behind. In a stock ``heterogeneous`` medium it
    serves as ``sigma_t``; inside ``field_emitter`` and ``field_integrator`` density
    and radiance are used.

    =============  =========  =======  ========  ====================================
    name           type       unit     default   meaning
    =============  =========  =======  ========  ====================================
    filename       string                        file of ``mi-nerfattack fit``
    to_world       transform  metre    identity  rotation, translation, uniform scale
    quantity       string              density   ``density`` or ``radiance`` (seen
                                                 along the field's +z)
    density_limit  float      1/metre  infinite  cuts the density, in media alone
    step_m         float      metre    the file  step of the march, in the field's frame
    relit          boolean             false     lit by the scene's emitters, in
                                                 ``field_integrator`` alone
    table, ...     array                         parameters; differentiable
    =============  =========  =======  ========  ====================================

    .. code-block:: xml

        <volume type="ngp_field" id="scene">
            <string name="filename" value="field.safetensors"/>
        </volume>

    .. code-block:: python

        {"type": "ngp_field", "filename": "field.safetensors"}

    Not differentiable: the pose. Media step by the largest density, an estimate (see
    ``NGPField.density_bound``): ``density_limit`` makes it sharp and small.
    """

    kind = "ngp_field"
    parameter_names = ("table", "density_weights", "colour_weights", "sky")


mi.register_texture("ngp_field", lambda props: NGPFieldVolume(props))
