"""March rays through one field: colour, opacity and expected depth (A.1 to A.3).

Both passes are one recorded loop each, so a frame is one kernel whatever the number
of samples, and the memory does not depend on it. The backward pass replays the
forward pass: same positions, same occupancy, same termination.

Steps. Along a ray, a fixed lattice ``t(i)``, i = 0, 1, ..., has spacing ``step`` up
to the distance ``step / cone`` and grows exponentially after it. A sample stands for
the part of ``[t(i), t(i + 1)]`` inside the bounding box, and takes density and
radiance as constant on it. Lattice intervals whose sample lies in an empty cell of
the occupancy are skipped. Beyond ``2**23`` steps from its origin a ray sees nothing.

Error bounds. Termination below transmittance ``stop`` changes opacity by at most
``stop`` and each colour by at most ``stop`` times the largest radiance behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.base import AbstractField

MAX_INTERVALS = 1 << 23  # float32 counts exactly up to twice this
STOP = 1e-3


@dataclass(frozen=True)
class Pose:
    """Rigid pose and uniform scale of a field in the world.

    Attributes:
        rotation: (3, 3) proper rotation, field to world.
        translation: (3,) of the field's origin, metres in the world.
        scale: world metres per metre of the field's frame.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, np.float64)
        good = rotation.shape == (3, 3) and np.isfinite(rotation).all()
        good = good and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not (good and np.linalg.det(rotation) > 0):
            raise ValueError(f"rotation: {rotation.tolist()}; expected a 3x3 rotation")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale: {self.scale}; must be positive and finite")
        if not np.isfinite(self.translation).all():
            raise ValueError(f"translation: {self.translation}; must be finite")

    @staticmethod
    def identity() -> Pose:
        """Return the pose that leaves a field where it is."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: np.ndarray) -> Pose:
        """Split a 4x4 matrix into rotation, translation and uniform scale.

        Raises:
            ValueError: the matrix shears, reflects or scales unequally.
        """
        matrix = np.asarray(matrix, np.float64)
        volume = np.linalg.det(matrix[:3, :3]) if np.isfinite(matrix).all() else 0.0
        scale = float(np.cbrt(abs(volume)))
        if not scale > 0:
            raise ValueError(f"{matrix.tolist()} is singular or not finite")
        return Pose(matrix[:3, :3] / scale, matrix[:3, 3].copy(), scale)

    @staticmethod
    def upright(
        position: tuple[float, float, float], yaw: float, scale: float = 1.0
    ) -> Pose:
        """Return a pose that turns about the z axis by `yaw` radians."""
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Pose(rotation, np.asarray(position, float), scale)


class PosedField:
    """A field at a pose, as kernels see it: all numbers opaque.

    Args:
        field: the field.
        pose: field to world; identity by default.
    """

    def __init__(self, field: AbstractField, pose: Pose | None = None) -> None:
        self.field = field
        self.pose = pose or Pose.identity()
        rotation = np.asarray(self.pose.rotation, np.float32)
        self._columns = [mi.Vector3f(*map(float, rotation[:, i])) for i in range(3)]
        self._origin = mi.Point3f(*map(float, self.pose.translation))
        self._inverse_scale = mi.Float(1 / self.pose.scale)
        self._step = mi.Float(field.step_m * self.pose.scale)
        # cone -> 0 makes the lattice uniform; the floor keeps step / cone finite
        self._cone = mi.Float(max(field.cone, 1e-6))
        dr.make_opaque(
            self._columns, self._origin, self._inverse_scale, self._step, self._cone
        )

    def to_local(
        self, origin: mi.Point3f, direction: mi.Vector3f
    ) -> tuple[mi.Point3f, mi.Vector3f]:
        """Map a world ray; ``o + t d`` keeps its meaning with t in world metres."""
        offset = mi.Vector3f(origin - self._origin)
        o = [dr.dot(column, offset) * self._inverse_scale for column in self._columns]
        d = [
            dr.dot(column, direction) * self._inverse_scale for column in self._columns
        ]
        return mi.Point3f(*o), mi.Vector3f(*d)

    def to_world_gradient(
        self, d_origin: mi.Vector3f, d_direction: mi.Vector3f
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Transpose of :meth:`to_local`, for cotangents."""

        def turn(v: mi.Vector3f) -> mi.Vector3f:
            axes = zip(self._columns, v, strict=True)
            return sum((c * x for c, x in axes), mi.Vector3f(0)) * self._inverse_scale

        return turn(d_origin), turn(d_direction)

    def interval(
        self, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float
    ) -> tuple[mi.Float, mi.Float]:
        """Intersect a local ray with the bounding box, clipped to [0, t_max]."""
        lower = mi.Point3f(*map(float, self.field.lower))
        upper = mi.Point3f(*map(float, self.field.upper))
        safe = dr.select(dr.abs(d) < 1e-12, dr.copysign(mi.Vector3f(1e-12), d), d)
        a, b = (lower - o) / safe, (upper - o) / safe
        near = dr.max(dr.minimum(a, b))
        far = dr.min(dr.maximum(a, b))
        return dr.maximum(near, 0), dr.minimum(far, t_max)

    def lattice(self, index: mi.Float) -> mi.Float:
        """Distance of a lattice point, metres."""
        knee = self._step / self._cone
        bend = dr.rcp(self._cone)
        grown = knee * dr.exp(self._cone * (dr.maximum(index, bend) - bend))
        return dr.select(index <= bend, index * self._step, grown)

    def lattice_index(self, t: mi.Float) -> mi.Float:
        """Inverse of :meth:`lattice`."""
        knee = self._step / self._cone
        bend = dr.rcp(self._cone)
        grown = bend + dr.log(dr.maximum(t, knee) / knee) * bend
        return dr.select(t <= knee, t / self._step, grown)

    def eval(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate at a local point: density in 1/(world metre), and radiance."""
        density, radiance = self.field.eval(point, direction, active)
        return density * self._inverse_scale, radiance


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

    @property
    def depth(self) -> mi.Float:
        """Expected depth (A.3, normalised), metres; infinite where opacity is 0."""
        hit = self.opacity > 0
        return dr.select(hit, self.moment / dr.select(hit, self.opacity, 1), dr.inf)


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
        return _march(posed, origin, direction, t_max, jitter, active, stop)


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

    Returns:
        the tangent of the march (forward mode; zeros otherwise), and the objective's
        derivative by origin and direction (3, n) (backward mode).
    """
    with dr.suspend_grad():
        return _march_derivative(
            mode,
            posed,
            origin,
            direction,
            t_max,
            jitter,
            active,
            primal,
            cotangent,
            stop,
        )


@dr.syntax
def _march(
    posed: PosedField,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    t_max: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
    stop: float,
) -> March:
    o, d = posed.to_local(origin, direction)
    near, far = posed.interval(o, d, t_max)
    heading = dr.normalize(d)
    active = mi.Bool(active) & (near < far)

    index = dr.floor(posed.lattice_index(near))  # lattice interval in hand
    transmittance = mi.Float(1)  # T, from the origin to the interval
    radiance = mi.Color3f(0)  # premultiplied radiance so far
    moment = mi.Float(0)  # integral of t sigma T so far
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        density, colour = posed.eval(o + t * d, heading, active)
        passed = dr.select(active, dr.exp(-density * width), 1)
        weight = transmittance * (1 - passed)
        radiance += weight * colour
        moment += weight * t
        transmittance *= passed
        index += 1
        active &= (transmittance > stop) & (index < MAX_INTERVALS)
    return March(radiance, 1 - transmittance, moment)


@dr.syntax
def _march_derivative(
    mode: dr.ADMode,
    posed: PosedField,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    t_max: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
    primal: March,
    cotangent: March,
    stop: float,
) -> tuple[March, mi.Vector3f, mi.Vector3f]:
    backward = mode == dr.ADMode.Backward
    o, d = posed.to_local(origin, direction)
    near, far = posed.interval(o, d, t_max)
    heading = dr.normalize(d)
    active = mi.Bool(active) & (near < far)

    index = dr.floor(posed.lattice_index(near))
    transmittance = mi.Float(1)
    rest = mi.Color3f(primal.radiance)  # premultiplied radiance still to come
    rest_moment = mi.Float(primal.moment)
    d_origin, d_direction = mi.Vector3f(0), mi.Vector3f(0)  # along the ray so far
    d_heading = mi.Vector3f(0)
    out_radiance, out_opacity, out_moment = mi.Color3f(0), mi.Float(0), mi.Float(0)
    while active:
        index, t, width, active = seek(posed, o, d, index, near, far, jitter, active)
        point = mi.Point3f(o + t * d)
        towards = mi.Vector3f(heading)
        with dr.resume_grad():
            if dr.hint(backward, mode="scalar"):
                dr.enable_grad(point, towards)
            density, colour = posed.eval(point, towards, active)
            sigma, value = dr.detach(density), dr.detach(colour)
            passed = dr.select(active, dr.exp(-sigma * width), 1)
            weight = transmittance * (1 - passed)
            behind = transmittance * passed
            rest -= weight * value
            rest_moment -= weight * t
            by_density = dr.select(active, width, 0)
            shift = by_density * density
            f_radiance = weight * colour + shift * (behind * value - rest)
            f_opacity = shift * (1 - primal.opacity)
            f_moment = shift * (behind * t - rest_moment)
            if dr.hint(backward, mode="scalar"):
                dr.backward_from(
                    dr.dot(cotangent.radiance, f_radiance)
                    + cotangent.opacity * f_opacity
                    + cotangent.moment * f_moment
                )
                d_point = dr.select(active, mi.Vector3f(dr.grad(point)), 0)
                d_origin += d_point
                d_direction += t * d_point
                d_heading += dr.select(active, dr.grad(towards), 0)
            else:
                tangent = dr.forward_to(f_radiance, f_opacity, f_moment)
                out_radiance += dr.select(active, tangent[0], 0)
                out_opacity += dr.select(active, tangent[1], 0)
                out_moment += dr.select(active, tangent[2], 0)
        transmittance = behind
        index += 1
        active &= (transmittance > stop) & (index < MAX_INTERVALS)
    unit = d_heading - heading * dr.dot(heading, d_heading)
    d_direction += unit * dr.rcp(dr.norm(d))
    d_origin, d_direction = posed.to_world_gradient(d_origin, d_direction)
    return March(out_radiance, out_opacity, out_moment), d_origin, d_direction
