"""March rays through one field: colour, opacity and expected depth (A.1 to A.3).

Both passes are one recorded loop each, so a frame is one kernel whatever the number
of samples, and the memory does not depend on it. The backward pass replays the
forward pass: same positions, same occupancy, same termination.

Steps. Along a ray, a fixed lattice ``t(i)``, i = 0, 1, ..., has spacing ``step`` up
to the distance ``step / cone`` and grows exponentially after it. A sample stands for
the part of ``[t(i), t(i + 1)]`` inside the bounding box, and takes density and
radiance as constant on it. Lattice intervals whose sample lies in an empty cell of
the occupancy are skipped. Beyond ``2**23`` steps from its origin a ray sees nothing.

Error bounds, for a ray that runs l metres through the box and leaves it at t_far:

- Termination below transmittance ``stop`` takes at most ``stop`` from opacity, ``stop``
  times the largest radiance behind from a colour, ``stop * t_far`` from the moment,
  and adds nothing.
- Steps of at most h with ``jitter`` 0.5 are the midpoint rule: half the step, a quarter
  of the error. Along the ray, let S_i and L_i bound the i-th derivative of density and
  of a colour. Optical depth is off by at most ``e = h^2 (l S_2 / 24 + S_1 / 4)``, and
  so is opacity; a colour by at most
  ``e (L_0 + l L_1) + h^2 (L_1 S_0 (1 + S_0 h) / 12 + L_2 / 8)``; the moment likewise
  with L_0 = t_far, L_1 = 1, L_2 = 0. Where density has kinks, as between the vertices
  of a grid, opacity is off by at most ``h^2 V / 8``, V the total variation of the
  density's slope. Other jitters are of first order.
- Opacity and colour of homogeneous media are exact but for rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.posed import PosedField

MAX_INTERVALS = 1 << 23  # float32 counts exactly up to twice this
STOP = 1e-3
PRIVATE_BYTES = 1 << 29  # of all threads' copies of one gradient buffer


#: Maps local points, directions in a form of its own, and a mask to density and colour.
Evaluate = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclass
class Rays:
    """Rays in the world, and where a march places its samples on them.

    Attributes:
        origin: (3, n), metres.
        direction: (3, n), unit vectors.
        t_max: (n,), metres; where the ray ends.
        jitter: (n,) in [0, 1), position of the sample in its interval.
        active: (n,) mask.
        gains: factors of the radiance of each field, (3, n) each; none for 1. They
            are constants of every derivative.
    """

    origin: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0, 0, 1))
    t_max: mi.Float = field(default_factory=lambda: mi.Float(dr.inf))
    jitter: mi.Float = field(default_factory=lambda: mi.Float(0.5))
    active: mi.Bool = field(default_factory=lambda: mi.Bool(True))
    gains: list[mi.Color3f] = field(default_factory=list)

    def __iter__(self) -> Iterator[Any]:
        """Yield what :func:`march` takes after the field, in its order."""
        yield from (self.origin, self.direction, self.t_max, self.jitter, self.active)

    def light(self, posed: Sequence[Any]) -> list[Any]:
        """Return the fields with the rays' gains, one each unless there are none."""
        if not self.gains:
            return list(posed)
        pairs = zip(posed, self.gains, strict=True)
        return [item.with_gain(gain) for item, gain in pairs]


@dataclass
class March:
    """What a march gives, per ray.

    Attributes:
        radiance: (3, n) premultiplied radiance I, linear.
        opacity: (n,) a = 1 - T(t_max).
        moment: (n,) integral of t sigma T dt, metres; depth times opacity.
    """

    radiance: mi.Color3f = field(default_factory=lambda: mi.Color3f(0))
    opacity: mi.Float = field(default_factory=lambda: mi.Float(0))
    moment: mi.Float = field(default_factory=lambda: mi.Float(0))

    @staticmethod
    def zeros(count: int) -> March:
        """Return a march of `count` empty rays."""
        black = dr.zeros(mi.Color3f, count)
        return March(black, dr.zeros(mi.Float, count), dr.zeros(mi.Float, count))

    def copy(self) -> March:
        """Return a march of the same values with no derivatives attached."""
        colour = mi.Color3f(dr.detach(self.radiance))
        opacity, moment = dr.detach(self.opacity), dr.detach(self.moment)
        return March(colour, mi.Float(opacity), mi.Float(moment))

    def plus(self, other: March, active: mi.Bool) -> March:
        """Add another march on the rays of a mask (n,)."""
        return March(
            self.radiance + dr.select(active, other.radiance, 0),
            self.opacity + dr.select(active, other.opacity, 0),
            self.moment + dr.select(active, other.moment, 0),
        )

    def pair(self, other: March) -> mi.Float:
        """Return the inner product with another march, ray by ray (n,)."""
        return (
            dr.dot(self.radiance, other.radiance)
            + self.opacity * other.opacity
            + self.moment * other.moment
        )

    @property
    def depth(self) -> mi.Float:
        """Expected depth (A.3, normalised), metres; infinite where opacity is 0."""
        hit = self.opacity > 0
        return dr.select(hit, self.moment / dr.select(hit, self.opacity, 1), dr.inf)


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


@dr.syntax
def seek(
    posed: PosedField,
    o: mi.Point3f,
    d: mi.Vector3f,
    index: mi.Float,
    near: mi.Float,
    far: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Bool]:
    """Advance local rays (n,) to their next lattice interval in an occupied cell.

    Returns:
        index, sample position and width (metres) of the interval, and which rays
        found one before `far`; each (n,).
    """
    occupancy = posed.field.occupancy
    t = mi.Float(0)
    width = mi.Float(0)
    searching = mi.Bool(active)
    found = mi.Bool(False)
    while searching:
        start = dr.maximum(posed.lattice(index), near)
        end = dr.minimum(posed.lattice(index + 1), far)
        t = start + jitter * (end - start)
        width = end - start
        searching &= (start < far) & (index < MAX_INTERVALS)
        unit = posed.field.unit(o + t * d)
        distance, cell = occupancy.query(unit, searching)
        found = searching & (distance == 0)
        searching &= ~found
        scale = posed.field.unit(mi.Point3f(d)) - posed.field.unit(mi.Point3f(0))
        t_exit = t + occupancy.exit(unit, mi.Vector3f(scale), cell, distance)
        jump = dr.maximum(index + 1, dr.floor(posed.lattice_index(t_exit)))
        index = dr.select(searching, jump, index)
    return index, t, dr.maximum(width, 0), found


def pick_rays(value: Any, index: mi.UInt32) -> Any:
    """Gather rays of dataclasses and lists of arrays; one entry for all stays so."""
    if isinstance(value, list):
        return [pick_rays(item, index) for item in value]
    if is_dataclass(value):
        parts = {item.name: getattr(value, item.name) for item in fields(value)}
        return type(value)(**{k: pick_rays(v, index) for k, v in parts.items()})
    return value if dr.width(value) == 1 else dr.gather(type(value), value, index)


def absorption(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Return ``phi(x) = (1 - exp(-x)) / x`` and its derivative, accurate at 0.

    ``x phi(x)`` is the opacity of optical depth x; in single precision ``1 - exp(-x)``
    loses the digits that thin media live on.
    """
    small = x < 0.1
    safe = dr.select(small, 1, x)
    passed = dr.exp(-safe)
    phi = (1 - passed) / safe
    series = 1 + x * (-1 / 2 + x * (1 / 6 + x * (-1 / 24 + x / 120)))
    slope = -1 / 2 + x * (1 / 3 + x * (-1 / 8 + x * (1 / 30 - x / 144)))
    return (
        dr.select(small, series, phi),
        dr.select(small, slope, (passed - phi) / safe),
    )


def march(
    posed: PosedField,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    t_max: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
    stop: float = STOP,
) -> March:
    """Integrate radiance, opacity and depth moment along rays; not differentiable.

    Args:
        posed: the field and its pose.
        origin: (3, n), metres in the world.
        direction: (3, n), unit vectors.
        t_max: (n,), metres; where the ray ends.
        jitter: (n,) in [0, 1), position of the sample in its interval; 0.5 is the
            midpoint rule.
        active: (n,) mask; masked rays are empty.
        stop: transmittance below which a ray ends; bounds the error.

    Source: appendix A.1 to A.3, with the signs of Mildenhall et al. 2020, eq. 3.
    """
    with dr.suspend_grad():
        rays = Rays(origin, direction, t_max, jitter, active)
        heading = dr.normalize(posed.turn(direction))
        return integrate(posed, rays, posed.eval, heading, stop)


def march_derivative(  # noqa: D417  one entry describes seven
    mode: dr.ADMode,
    posed: PosedField,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    t_max: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
    primal: March,
    cotangent: March,
    stop: float = STOP,
    t_rays: tuple[mi.Vector3f, mi.Vector3f] | None = None,
) -> tuple[March, mi.Vector3f, mi.Vector3f]:
    """Replay :func:`march` and propagate derivatives through the field.

    With ``w_k`` the weight and ``T_k+1`` the transmittance behind sample k:
    ``dI/dL_k = w_k``, ``dI/dsigma_k = width_k (T_k+1 L_k - sum_{j>k} w_j L_j)``, and
    likewise for opacity and moment. Parameters of the field (and nothing else) get
    their derivatives through Dr.Jit's graph: in backward mode they are accumulated
    into ``dr.grad`` of every parameter with gradients enabled; in forward mode they
    are read from there.

    Sample positions and the ends of the interval count as constants along the ray;
    rays that only touch the box are not differentiated with respect to that.

    Args:
        mode: forward or backward.
        posed, origin, direction, t_max, jitter, active, stop: as in the pass
            that gave `primal`.
        primal: the result of :func:`march`.
        cotangent: derivative of the objective by radiance, opacity and moment;
            ignored in forward mode.
        t_rays: tangents of origin and direction, (3, n) each, in forward mode; None
            where the rays are constants.

    Returns:
        the tangent of the march (forward mode; zeros otherwise), and the objective's
        derivative by origin and direction (3, n) (backward mode).
    """
    rays = Rays(origin, direction, t_max, jitter, active)
    with dr.suspend_grad(), private_gradients():
        return _march_derivative(mode, posed, rays, primal, cotangent, stop, t_rays)


def enter(
    posed: PosedField, rays: Rays
) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float, mi.Bool]:
    """Take rays into a field's frame.

    Returns:
        local origins and directions, the interval inside the field's box (metres), and
        which rays have one; each (n,).
    """
    o, d = posed.to_local(rays.origin, rays.direction)
    near, far = posed.interval(o, d, rays.t_max)
    return o, d, near, far, mi.Bool(rays.active) & (near < far)


@dr.syntax
def integrate(
    posed: PosedField, rays: Rays, evaluate: Evaluate, towards: Any, stop: float
) -> March:
    """Do what :func:`march` does, with an evaluation of the caller's.

    Args:
        posed: the field's pose, box, steps and occupancy.
        rays: n rays.
        evaluate: maps local points (3, n), `towards` and a mask to density, in
            1/(world metre), and radiance.
        towards: what `evaluate` needs to know of the rays' directions.
        stop: transmittance below which a ray ends.
    """
    o, d, near, far, active = enter(posed, rays)
    jitter = rays.jitter
    index = dr.floor(posed.lattice_index(near))  # lattice interval in hand
    tau = mi.Float(0)  # optical depth from the origin to the interval
    radiance = mi.Color3f(0)  # premultiplied radiance so far
    moment = mi.Float(0)  # integral of t sigma T so far
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        density, colour = evaluate(mi.Point3f(o + t * d), towards, active)
        x = dr.select(active, density * width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        radiance += weight * colour
        moment += weight * t
        tau += x
        index += 1
        active &= (dr.exp(-tau) > stop) & (index < MAX_INTERVALS)
    return March(radiance, tau * absorption(tau)[0], moment)


@dr.syntax
def _march_derivative(
    mode: dr.ADMode,
    posed: PosedField,
    rays: Rays,
    primal: March,
    cotangent: March,
    stop: float,
    t_rays: tuple[mi.Vector3f, mi.Vector3f] | None,
) -> tuple[March, mi.Vector3f, mi.Vector3f]:
    backward = mode == dr.ADMode.Backward
    moving = t_rays is not None
    o, d, near, far, active = enter(posed, rays)
    heading, jitter = dr.normalize(d), rays.jitter

    index = dr.floor(posed.lattice_index(near))
    tau = mi.Float(0)
    rest = mi.Color3f(primal.radiance)  # premultiplied radiance still to come
    rest_moment = mi.Float(primal.moment)
    d_origin, d_direction, d_heading = (mi.Vector3f(0) for _ in range(3))
    tangent = March()
    t_o, t_d, t_heading = posed.local_tangents(d, heading, t_rays)
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        point = mi.Point3f(o + t * d)
        towards = mi.Vector3f(heading)
        with dr.resume_grad():
            if dr.hint(backward or moving, mode="scalar"):
                dr.enable_grad(point, towards)
            if dr.hint(moving, mode="scalar"):
                dr.set_grad(point, t_o + t * t_d)
                dr.set_grad(towards, t_heading)
            density, colour = posed.eval(point, towards, active)
            sigma, value = dr.detach(density), dr.detach(colour)
            x = dr.select(active, sigma * width, 0)
            weight = dr.exp(-tau) * x * absorption(x)[0]
            behind = dr.exp(-tau - x)
            rest -= weight * value
            rest_moment -= weight * t
            by_density = dr.select(active, width, 0)
            shift = by_density * density
            change = March(
                weight * colour + shift * (behind * value - rest),
                shift * (1 - primal.opacity),
                shift * (behind * t - rest_moment),
            )
            if dr.hint(backward, mode="scalar"):
                dr.backward_from(cotangent.pair(change))
                d_point = dr.select(active, mi.Vector3f(dr.grad(point)), 0)
                d_origin += d_point
                d_direction += t * d_point
                d_heading += dr.select(active, dr.grad(towards), 0)
            else:
                tangent = tangent.plus(dr.forward_to(change), active)
        tau += x
        index += 1
        active &= (behind > stop) & (index < MAX_INTERVALS)
    unit = d_heading - heading * dr.dot(heading, d_heading)
    d_direction += unit * dr.rcp(dr.norm(d))
    d_origin, d_direction = posed.to_world_gradient(d_origin, d_direction)
    return tangent, d_origin, d_direction
