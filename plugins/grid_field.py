"""The volume `grid_field`."""

from __future__ import annotations

import mitsuba as mi

from mi_nerfattack.plugins.field_volume import AbstractFieldVolume


class GridFieldVolume(AbstractFieldVolume):
    r"""Decoder-free grid field (``grid_field``).

    Density ``s exp(sum_l d_l(x))`` and radiance
    ``srgb_to_linear(sigmoid(sum_l c_l(x)))`` of trilinearly interpolated vertices of
    several levels (appendix A.4.1). In a stock ``heterogeneous`` medium it serves as
    ``sigma_t`` (quantity ``density``) or ``albedo`` (quantity ``radiance``); inside
    ``field_emitter`` and ``field_integrator`` both are used.

    =============  =========  =======  ========  ====================================
    name           type       unit     default   meaning
    =============  =========  =======  ========  ====================================
    filename       string                        file of ``mi-nerfattack asset``
    to_world       transform  metre    identity  rotation, translation, uniform scale
    quantity       string              density   ``density`` or ``radiance``
    density_limit  float      1/metre  infinite  cuts the density, in media alone
    step_m         float      metre    the file  step of the march, in the field's frame
    relit          boolean             false     lit by the scene's emitters, in
                                                 ``field_integrator`` alone
    texture        tensor                        (n, 3) raw colours; differentiable
    density        array                         (n,) raw densities; differentiable
    =============  =========  =======  ========  ====================================

    .. code-block:: xml

        <volume type="grid_field" id="object">
            <string name="filename" value="hydrant.safetensors"/>
            <transform name="to_world"><scale value="2"/></transform>
        </volume>

    .. code-block:: python

        {"type": "grid_field", "filename": "hydrant.safetensors"}

    Media step by the largest density: where an object is as opaque as fitted ones are
    (100,000/metre), they never arrive. ``density_limit`` 500 still lets no light pass
    more than a centimetre (0.7 %).

    Where the file calls space empty, the density is 0 whatever ``density`` says: see
    ``fields.window``. Not differentiable: the pose.
    """

    kind = "grid_field"
    parameter_names = ("texture", "density")


mi.register_texture("grid_field", lambda props: GridFieldVolume(props))
