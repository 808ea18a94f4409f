"""What `field_integrator` keeps of a ray, and how it samples the nested integrator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.backend.differentiate import differentiates_rays
from mi_nerfattack.errors import InputError
from mi_nerfattack.plugins.properties import background
from mi_nerfattack.render.composite import Seen
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.rays import March, Rays


@dataclass
class State:
    """What the primal pass of a ray hands to its derivatives.

    Attributes:
        seen: the fields.
        gains: factors of their radiance, as of `Rays`.
        behind: (channels, n), what the nested integrator sees; None without one.
        valid: (n,), whether it meets anything; likewise.
        aovs: its AOVs.
        inner: its own state.
    """

    seen: Seen
    gains: list[mi.Color3f] = field(default_factory=list)
    behind: Any = None
    valid: Any = None
    aovs: list[mi.Float] = field(default_factory=list)
    inner: Any = None

    def copy(self) -> State:
        """Return the same with no derivatives attached to what is seen."""
        behind = None if self.behind is None else dr.detach(self.behind)
        return replace(self, seen=self.seen.copy(), behind=behind)


def sample_nested(
    integrator: Any,
    mode: dr.ADMode,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    active: mi.Bool,
    δL: Any = None,
    state_in: Any = None,
) -> tuple[Any, ...]:
    """Sample another integrator, whichever of Mitsuba's two interfaces it has."""
    if not differentiates_rays(integrator):
        ray = mi.RayDifferential3f(ray)
        return integrator.sample(scene, sampler, ray, active=active)
    return integrator.sample(
        mode=mode,
        scene=scene,
        sampler=sampler,
        ray=ray,
        depth=mi.UInt32(0),
        δL=δL,
        δaovs=None,
        state_in=state_in,
        active=active,
    )


def look(
    integrator: Any,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    rays: Rays,
    width: int,
) -> State:
    """March the fields of a `field_integrator`, and see what lies behind them.

    Args:
        integrator: its fields and nested integrator.
        scene: that is rendered.
        sampler: of random numbers.
        ray: n rays.
        rays: the same, as far as fields are concerned.
        width: rays in a row, where nothing is being recorded; 0 otherwise.
    """
    light = integrator.relighting
    if light is not None:
        rays.gains = light.gains(scene, sampler, integrator.posed, rays)
    if width:
        dr.make_opaque(rays)
        seen = integrator.frozen.render(rays, width)
    else:
        seen = integrator.composite.render(integrator.posed, rays, integrator.stop)
    if integrator.behind is None:
        return State(seen, rays.gains)
    behind, valid, aovs, *inner = sample_nested(
        integrator.behind, dr.ADMode.Primal, scene, sampler, ray, rays.active
    )
    if light is not None:
        shadow = light.behind(scene, sampler, integrator.posed, ray, rays.active)
        behind *= spectrum.reflectance(shadow, ray.wavelengths)
    return State(seen, rays.gains, behind, valid, list(aovs), *inner)


def lay_over(
    integrator: Any, total: March, rays: Rays, behind: Any, ray: mi.Ray3f
) -> Any:
    """Lay fields over what is behind them, as a spectrum; differentiable."""
    passed = 1 - total.opacity
    if behind is not None:
        return spectrum.emission(total.radiance, ray.wavelengths) + passed * behind
    sky = background(integrator.volumes, rays.direction) & (rays.t_max == dr.inf)
    return spectrum.emission(total.radiance + passed * sky, ray.wavelengths)


def push_forward(
    integrator: Any,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    rays: Rays,
    state: State,
) -> tuple[Any, Any]:
    """Return the tangents of the colour and of the integrator's `splats`.

    Raises:
        InputError: channels of single fields, which have no tangents in this composite.
    """
    fixed = integrator.posed, rays, state.seen, integrator.stop
    tangent = integrator.composite.forward(*fixed)
    if len(tangent.layers) < len(integrator.channels.ids):
        raise InputError(
            "composite interleaved: the shares of single fields have no tangents; "
            "set composite to depth, or aovs to false"
        )
    with dr.resume_grad():
        leaf = state.copy()
        dr.enable_grad(leaf.seen, leaf.behind)
        dr.set_grad(leaf.seen.total, tangent.total)
        for layer, part in zip(leaf.seen.layers, tangent.layers, strict=False):
            dr.set_grad(layer, part)
        if integrator.differentiates_behind:
            nested, mode = integrator.behind, dr.ADMode.Forward
            t_behind, *_ = sample_nested(
                nested, mode, scene, sampler, ray, rays.active, state_in=state.inner
            )
            dr.set_grad(leaf.behind, t_behind)
        colour = lay_over(integrator, leaf.seen.total, rays, leaf.behind, ray)
        found = colour, *integrator.splats(leaf)
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        colour, alpha, aovs = dr.forward_to(found, flags=flags)
    return colour, (alpha, aovs)
