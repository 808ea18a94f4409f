"""A composite as one differentiable operation, also inside recorded loops and calls."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.composite import AbstractComposite, Marches
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays


def attached(
    composite: AbstractComposite, posed: list[PosedField], rays: Rays, stop: float
) -> tuple[mi.Color3f, mi.Float]:
    """March rays through fields; differentiable by the fields' parameters and poses.

    Works where the caller is being recorded, as an emitter's ``eval`` is in the loops
    of an integrator: the derivative replays all rays, whether they meet a field or
    not. Not differentiable by the rays.

    Args:
        composite: rule by which the fields become one colour.
        posed: the fields, at least one.
        rays: n rays.
        stop: transmittance below which a ray ends.

    Returns:
        premultiplied radiance (3, n) and opacity (n,).

    Raises:
        InputError: forward mode by a pose, when the tangent is computed.
    """
    # Stock integrators switch recorded loops off to be differentiated themselves.
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, True):
        return _attached(composite, posed, dr.detach(rays), stop=stop)


def _attached(
    composite: AbstractComposite, posed: list[PosedField], rays: Rays, stop: float
) -> tuple[mi.Color3f, mi.Float]:
    sources = [
        array
        for item in posed
        for array in [*item.field.arrays(), *item.attached()]
        if dr.grad_enabled(array)
    ]
    if not sources:
        total = composite.render(posed, rays, stop).total
        return total.radiance, total.opacity
    radiance, opacity = dr.custom(_Render, composite, posed, rays, stop, sources)
    # A recorded call asks which attached arrays were read, and knows of gathers only.
    never = opacity < 0
    for array in sources:
        opacity += mi.Float(dr.gather(type(array), array, mi.UInt32(0), never))
    return radiance, opacity


class _Render(dr.CustomOp):
    """Derivatives go straight to the parameters, which Dr.Jit only has to know of."""

    def eval(
        self,
        composite: AbstractComposite,
        posed: list[PosedField],
        rays: Rays,
        stop: float,
        sources: list[Any],
    ) -> tuple[mi.Color3f, mi.Float]:
        del sources
        self.composite, self.fixed, self.stop = composite, (posed, rays), stop
        self.primal = composite.render(posed, rays, stop)
        return self.primal.total.radiance, self.primal.total.opacity

    def forward(self) -> None:
        if any(item.has_pose_gradients for item in self.fixed[0]):
            raise InputError(
                "to_world: has no derivative in forward mode; use dr.backward"
            )
        tangent = self.composite.forward(*self.fixed, self.primal, self.stop)
        self.set_grad_out((tangent.total.radiance, tangent.total.opacity))

    def backward(self) -> None:
        total: Any = self.grad_out()
        radiance, opacity = total
        cotangent = Marches(March(radiance, opacity, mi.Float(0)))
        posed, rays = self.fixed
        layers = [
            k
            for k, item in enumerate(posed)
            if item.has_gradients or item.has_pose_gradients
        ]
        gradients = self.composite.backward_rays(
            posed,
            rays,
            self.primal,
            cotangent=cotangent,
            stop=self.stop,
            layers=layers,
        )
        for k, by_rays in zip(layers, gradients, strict=True):
            posed[k].backward_pose(rays, by_rays)
