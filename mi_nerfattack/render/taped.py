"""A march whose every sample is on Dr.Jit's tape: for checking derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.march import MAX_INTERVALS, March, Rays, absorption, seek
from mi_nerfattack.render.posed import PosedField


@dr.syntax
def taped_march(posed: PosedField, rays: Rays, stop: float) -> March:
    """Do what :func:`march` does, one evaluated step at a time.

    Differentiable by Dr.Jit in everything that is attached: the field's arrays and
    pose, and the rays. Positions of samples and ends of the interval are constants,
    as for :func:`march_derivative`. Memory grows with the number of samples.

    Args:
        posed: the field and its pose.
        rays: n rays.
        stop: transmittance below which a ray ends.
    """
    o, d = posed.to_local(rays.origin, rays.direction)
    fixed_o, fixed_d = dr.detach(o), dr.detach(d)
    near, far = posed.interval(fixed_o, fixed_d, rays.t_max)
    near, far = dr.detach(near), dr.detach(far)
    heading = dr.normalize(d)
    active = mi.Bool(rays.active) & (near < far)
    index = dr.detach(dr.floor(posed.lattice_index(near)))
    tau = dr.zeros(mi.Float, dr.width(d))
    radiance = dr.zeros(mi.Color3f, dr.width(d))
    moment = dr.zeros(mi.Float, dr.width(d))
    while dr.hint(active, mode="evaluated"):
        with dr.suspend_grad():
            index, t, width, active = seek(
                posed, fixed_o, fixed_d, index, near, far, rays.jitter, active
            )
        density, colour = posed.eval(o + t * d, heading, active)
        x = dr.select(active, density * width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        radiance += weight * colour
        moment += weight * t
        tau += x
        index += 1
        active &= (dr.exp(-dr.detach(tau)) > stop) & (index < MAX_INTERVALS)
    return March(radiance, tau * absorption(tau)[0], moment)
