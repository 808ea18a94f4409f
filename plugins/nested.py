"""What `field_integrator` keeps of a ray, and how it samples the nested integrator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.composite import Seen


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
    if not isinstance(integrator, mi.ad.integrators.common.RBIntegrator):
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
