"""March rays through one field: colour, opacity and expected depth (A.1 to A.3).

Both passes are one recorded loop each, so a frame is one kernel whatever the number
of samples, and the memory does not depend on it. The backward pass replays the
forward pass: same positions, same occupancy, same termination.

Steps. Along a ray, a fixed lattice ``t(i)``, i = 0, 1, ..., has spacing ``step`` up
to the distance ``step / cone`` and grows exponentially after it. A sample represents
``[t(i), t(i + 1)]``, and takes density and radiance as constant on it. In a field that
has no empty cell, it represents only the part inside the bounding box. Lattice
intervals whose sample lies in an empty cell of the occupancy are skipped. The density
there is 0, and rises from 0 continuously (`Window`), so that no sample comes or goes
abruptly when a ray moves. Where octants of cells are skipped, too, samples of a small
opacity do come and go (`fit.pruning`). Beyond ``2**23`` steps in a box a ray sees
nothing.

Error bounds, for a ray that runs l metres through the box and leaves it at t_far:

- Termination below transmittance ``stop`` takes at most ``stop`` from opacity, ``stop``
  times the largest radiance behind from a colour, ``stop * t_far`` from the moment,
  and adds nothing.
- Steps of at most h with ``jitter`` 0.5 are the midpoint rule: half the step, a quarter
  of the error. Along the ray, let S_i and L_i bound the i-th derivative of density and
  of a colour. Optical depth is off by at most ``e = h^2 (l S_2 / 24 + S_1 / 4)``, and
  so is opacity; a colour by at most
  ``e (L_0 + l L_1) + h^2 (L_1 S_0 (1 + S_0 h) / 12 + L_2 / 8)``. The same bound holds
  for the moment with L_0 = t_far, L_1 = 1, L_2 = 0. Other jitters are of first order.
- Where slopes jump, as between the vertices of a grid, their total variation replaces
  the second derivatives. Let V be the total variation of the density's slope, and W of
  a colour's slope. Opacity is off by at most ``h^2 V / 8``. With
  ``e = h^2 (V / 8 + S_1 / 4)``, a colour is off by at most
  ``e (L_0 + l L_1) + h^2 S_0 (L_1 (1 + S_0 h) / 12 + W / 4)``.
- Opacity and colour of homogeneous media are exact except for rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import Remainder, Sums
from mi_nerfattack.render.walk import MergedWalk, Path, Segment, Walk

STOP = 1e-6
PRIVATE_BYTES = 1 << 29  # of all threads' copies of one gradient buffer

#: Maps local points, directions in a form of its own, and a mask to density and colour.
Evaluate = Callable[[Any, Any, Any], tuple[Any, Any]]


@contextmanager
def private_gradients() -> Iterator[None]:
    """Let derivatives recorded inside accumulate into one copy of a buffer a thread.

    Without write conflicts there is no need for atomic operations, which takes four
    fifths off the time of a grid's derivative. Costs memory, so it holds for buffers
    whose copies fit in `PRIVATE_BYTES`. LLVM only; without effect on CUDA.
    """
    before = dr.expand_threshold()
    copies = max(1, PRIVATE_BYTES // (4 * max(1, dr.thread_count())))
    dr.set_expand_threshold(max(before, copies))
    try:
        yield
    finally:
        dr.set_expand_threshold(before)


def march(
    posed: PosedField, rays: Rays, stop: float = STOP, clear: mi.Float | None = None
) -> March:
    """Integrate radiance, opacity and depth moment along rays; not differentiable.

    Args:
        posed: the field and its pose.
        rays: n rays; masked ones are empty. A jitter of 0.5 is the midpoint rule; gains
            are left to `posed`.
        stop: transmittance below which a ray ends; bounds the error.
        clear: (n,), metres on which rays meet empty cells alone, which saves time.

    Source: appendix A.1 to A.3, with the signs of Mildenhall et al. 2020, eq. 3.
    """
    with dr.suspend_grad():
        heading = dr.normalize(posed.turn(rays.direction))
        walk, active = Walk.start(posed, rays, clear)
        sums = integrate(
            [posed], walk, active, evaluate=[posed.eval], towards=[heading], stop=stop
        )
        return sums.march()


def march_derivative(  # noqa: D417  one entry describes three
    mode: dr.ADMode,
    posed: PosedField,
    rays: Rays,
    primal: March,
    cotangent: March,
    stop: float = STOP,
    with_rays: bool = False,
) -> tuple[March, RayGradient]:
    """Replay :func:`march` and propagate derivatives through the field.

    With ``w_k`` the weight and ``T_k+1`` the transmittance behind sample k:
    ``dI/dL_k = w_k``, ``dI/dsigma_k = width_k (T_k+1 L_k - sum_{j>k} w_j L_j)``. The
    opacity and the moment have derivatives of the same form; `sums.Remainder` names the
    terms. Parameters of the field (and nothing else) get their derivatives through
    Dr.Jit's graph: in backward mode they are accumulated into ``dr.grad`` of every
    parameter with gradients enabled; in forward mode they are read from there.

    Sample positions and the ends of the interval count as constants along the ray;
    rays that only touch the box are not differentiated with respect to that.

    Args:
        mode: forward or backward.
        posed, rays, stop: as in the pass that gave `primal`.
        primal: the result of :func:`march`.
        cotangent: derivative of the objective by radiance, opacity and moment;
            ignored in forward mode.
        with_rays: differentiate by the rays, too; in backward mode alone.

    Returns:
        the tangent of the march (forward mode; zeros otherwise), and the objective's
        derivatives by the rays (with them; zeros otherwise).
    """
    with dr.suspend_grad(), private_gradients():
        walk, active = Walk.start(posed, rays)
        tangent, (by_rays,) = replay(
            mode,
            [posed],
            walk,
            active=active,
            primal=primal,
            cotangent=cotangent,
            stop=stop,
            with_rays=with_rays,
        )
    return tangent, by_rays


@dr.syntax
def integrate(
    posed: Sequence[PosedField],
    walk: Walk | MergedWalk,
    active: mi.Bool,
    evaluate: Sequence[Evaluate],
    towards: Sequence[Any],
    stop: float,
) -> Sums:
    """Do what :func:`march` does, for one or several fields.

    Args:
        posed: the fields' poses, boxes, steps and occupancies.
        walk: n rays before their first samples.
        active: (n,), rays that may have samples.
        evaluate: for each field; maps local points (3, n), its `towards` and a mask
            to density, in 1/(world metre), and radiance.
        towards: what `evaluate` needs to know of the rays' directions.
        stop: transmittance below which a ray ends.
    """
    sums = Sums.zeros(len(posed))
    while active:
        # The next lattice interval in an occupied cell, and one sample in it
        walk, segment = walk.next(posed, active)
        points = [path.at(segment.t) for path in walk.paths]
        densities, colours = _evaluate(evaluate, points, towards, segment=segment)
        # A.1 to A.3 as sums: T phi(x) x L, and the same of 1 and of t
        sums = sums.plus(segment.depths(densities), colours, segment.t)
        # Behind transmittance `stop`, nothing is seen
        active = segment.active & (dr.exp(-sums.tau) > stop)
    return sums


@dataclass
class RayGradient:
    """Derivatives of an objective by n rays, as one field sees them.

    Attributes:
        origin: (3, n).
        direction: (3, n).
        heading: (3, n), by the direction of travel that the radiance depends on, while
            a march goes on; then it is part of `direction`.
        log_density: (n,), by the logarithm of a factor of the field's density.
    """

    origin: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    heading: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    log_density: mi.Float = field(default_factory=lambda: mi.Float(0))

    def plus(
        self, point: Any, heading: Any, growth: mi.Float, segment: Segment
    ) -> RayGradient:
        """Add what a sample's point and heading got, and its `Slope.growth`."""
        # A point o + t d moves with its origin, and by t times its direction
        by_point = dr.select(segment.active, mi.Vector3f(dr.grad(point)), 0)
        by_heading = dr.select(segment.active, dr.grad(heading), 0)
        return RayGradient(
            self.origin + by_point,
            self.direction + segment.t * by_point,
            self.heading + by_heading,
            log_density=self.log_density + dr.select(segment.active, growth, 0),
        )

    def in_world(self, posed: PosedField, path: Path) -> RayGradient:
        """Return the derivatives by origin and direction in the world."""
        # Through the normalisation h = d / |d|: its derivative is (1 - h h^T) / |d|
        along = path.heading * dr.dot(path.heading, self.heading)
        turned = (self.heading - along) * dr.rcp(dr.norm(path.d))
        by_origin, by_direction = posed.to_world_gradient(
            self.origin, self.direction + turned
        )
        return RayGradient(by_origin, by_direction, log_density=self.log_density)


@dr.syntax
def replay(  # noqa: D417  one entry describes four
    mode: dr.ADMode,
    posed: Sequence[PosedField],
    walk: Walk | MergedWalk,
    active: mi.Bool,
    primal: March,
    cotangent: March,
    stop: float,
    with_rays: bool,
) -> tuple[March, list[RayGradient]]:
    """Replay :func:`integrate` of the fields, and propagate derivatives.

    Args:
        mode: forward or backward.
        posed, walk, active, stop: as given to :func:`integrate`.
        primal: what the rays gathered.
        cotangent: derivative of the objective by it; ignored in forward mode.
        with_rays: differentiate by the rays, too; in backward mode alone.

    Returns:
        as :func:`march_derivative`, the derivatives by rays for each field.
    """
    count = range(len(posed))
    # Replay: `remainder` starts as all that the rays gathered, and loses the part of
    # each sample
    remainder, tangent = Remainder.of(primal), March()
    by_rays = [RayGradient() for _ in posed]
    while active:
        # The same sample as in the forward pass
        walk, segment = walk.next(posed, active)
        with dr.resume_grad():
            # The fields again at the sample, attached to their parameters
            points, headings = _attach(walk.paths, segment.t, with_rays)
            densities, colours = _evaluate(
                [item.eval for item in posed], points, headings, segment=segment
            )
            # dI/dL = w, dI/dsigma = width (T L - what is behind): see
            # `sums.Remainder.minus`
            depths = segment.depths(densities)
            remainder, slope = remainder.minus(
                dr.detach(depths), dr.detach(colours), segment.t
            )
            change = slope.change(depths, colours)
            # From the sample to the parameters, or from the parameters to the sample
            if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                dr.backward_from(cotangent.pair(change))
            else:
                tangent = tangent.plus(dr.forward_to(change), segment.active)
            # From the sample to the rays
            if dr.hint(with_rays, mode="scalar"):
                growth = slope.growth(cotangent, dr.detach(depths), dr.detach(colours))
                by_rays = [
                    by_rays[k].plus(points[k], headings[k], growth[k], segment)
                    for k in count
                ]
        # The same termination as in the forward pass
        active = segment.active & (dr.exp(-remainder.tau) > stop)
    return tangent, list(map(RayGradient.in_world, by_rays, posed, walk.paths))


def _evaluate(
    evaluate: Sequence[Evaluate],
    points: Sequence[Any],
    towards: Sequence[Any],
    segment: Segment,
) -> tuple[list, list]:
    """Evaluate all fields at a sample: their densities and their radiances."""
    arguments = zip(evaluate, points, towards, segment.inside, strict=True)
    values = [see(point, look, inside) for see, point, look, inside in arguments]
    return [density for density, _ in values], [colour for _, colour in values]


def _attach(paths: list[Path], t: mi.Float, with_rays: bool) -> tuple[list, list]:
    """Return points and headings of a sample in each field, as leaves if asked for."""
    points = [path.at(t) for path in paths]
    headings = [mi.Vector3f(path.heading) for path in paths]
    if with_rays:
        dr.enable_grad(points, headings)
    return points, headings
