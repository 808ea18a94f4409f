r"""3D Gaussian splats as the constant background of a depth composite.

Along a ray o + t w, splat i with centre c, standard deviations s and rotation R has
its peak at the distance t_i where ``m(t) = |diag(1/s) R^T (o + t w - c)|`` is least,
and there the opacity ``a_i = min(opacity_i exp(-m(t_i)^2 / 2), 0.9999)``; it is left
out where ``m(t_i) > 3``. Splats are laid over each other in the order of t_i, as if
each were a thin sheet there: ``I = sum_i c_i a_i prod_{j<i} (1 - a_j)``, likewise the
opacity, and the depth moment with t_i in place of c_i. Splats whose peak lies behind
the origin or beyond the end of the ray are not seen; one that contains the origin is.

Kernel and opacity are those of Mitsuba's ``volprim_rf_basic``, which lays splats over
each other in the order in which the ray enters them, and culls those around the
camera. The order by peaks is that of 3D Gaussian ray tracing.

Trainers compare with sRGB images, so that colours are sRGB: they are summed up in
sRGB, and the sum is decoded once, ``a decode(I / a)``, into premultiplied linear
radiance. Opaque rays show what the trainer's viewer shows; through others, what lies
behind shines in linear light.

Source: Kerbl et al. 2023, eq. 3; Moenne-Loccoz et al. 2024, sections 4.1 to 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.splats import Splats
from mi_nerfattack.render.backdrop import AbstractBackdrop
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.rays import March, Rays

REACH = 3.0  # standard deviations at which a splat ends
MAX_OPACITY = 0.9999
MAX_HITS = 4096  # of a ray; what comes behind is not seen
WAITING = 16  # entered splats that wait for their turn

_THINNEST = 1e-4  # standard deviation, of the splat's largest
_THINNEST_SHELL = 0.2  # likewise, of what rays are intersected with
_SPREAD = 0.05  # by which shells differ, so that equal splats are entered apart
_UNITS = 100.0  # small standard deviations in the unit of a tier, see there
_ACCURATE = 200.0  # small standard deviations that an intersection is accurate within
_RECORD = 16  # floats: centre, three rows of diag(1/s) R^T, opacity, padding


@dataclass
class _Tier:
    """Splats of similar size, in an acceleration structure of their own.

    It is in a unit in which they are large: Mitsuba 3.9's `ellipsoids` misses half of
    the rays through splats of a centimetre in a scene in metres.

    Attributes:
        scene: their shells, one `ellipsoids` shape.
        first: index of the first one among all.
        back: metres behind the origin from where a ray meets all that contain it.
        zoom: units of the scene per metre.
        near: metres within which an intersection is accurate.
    """

    scene: Any
    first: mi.UInt32
    back: mi.Float
    zoom: mi.Float
    near: mi.Float


@dataclass
class _Hit:
    """A splat on a ray; its peak is infinite for none."""

    peak: mi.Float = field(default_factory=lambda: mi.Float(dr.inf))
    opacity: mi.Float = field(default_factory=lambda: mi.Float(0))
    index: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))


class SplatBackground(AbstractBackdrop):
    """Splats at a pose in the world, intersected through Mitsuba's `ellipsoids`.

    A ray is one recorded loop: each turn finds the next splat that it enters, keeps
    it among up to `WAITING` others, and adds the nearest one that nothing can come in
    front of any more. The order is wrong only where a ray is inside of more than
    `WAITING` splats whose peaks are still to come. Rays end below a transmittance, or
    after `MAX_HITS` splats. Splats thinner than a ten-thousandth of their width count
    as that thick. Of two splats that a ray enters within a millionth of the distance
    from each other, one may be missed.

    Cost: a structure is built once, seconds for a million splats; a march takes time
    in proportion to the splats that rays enter until they are opaque.

    Args:
        splats: from :func:`.read_splats`.
        pose: the file's frame to the world, with the metres per unit of the file as
            its scale; identity by default.
    """

    def __init__(self, splats: Splats, pose: Pose | None = None) -> None:
        self.name: str = splats.source
        self.pose: Pose = pose or Pose.identity()
        order, groups = _group(splats)
        centers, scales, rotations = _in_world(splats, self.pose)
        self._terms = splats.harmonics.shape[1]
        self._records = mi.Float(
            _records(centers, scales, rotations, splats.opacities)[order].ravel()
        )
        self._harmonics = mi.Float(splats.harmonics[order].ravel())
        rotation = np.asarray(self.pose.rotation, np.float32)
        self._columns = [mi.Vector3f(*map(float, rotation[:, i])) for i in range(3)]
        shells = _shells(scales)
        data = np.concatenate([centers, shells, rotations[1]], 1).astype(np.float32)
        self._tiers = [_tier(data[order], shells[order], group) for group in groups]
        numbers = [(x.first, x.back, x.zoom, x.near) for x in self._tiers]
        dr.make_opaque(self._columns, self._records, self._harmonics, numbers)

    def state(self) -> list[Any]:
        """See ``AbstractBackdrop.state``."""
        tiers = [(x.scene, x.first, x.back, x.zoom, x.near) for x in self._tiers]
        return [self, tiers, self._columns, self._records, self._harmonics]

    def march(self, rays: Rays, stop: float) -> March:
        """See ``AbstractBackdrop.march``; evaluated when it returns.

        A kernel that ran later might find the acceleration structures gone.
        """
        with dr.suspend_grad():
            seen = self._march(rays, stop)
        dr.eval(seen)
        return seen

    @dr.syntax
    def _march(self, rays: Rays, stop: float) -> March:
        shade = self._shade(rays.direction)
        reached = [-tier.back for tier in self._tiers]  # metres along the ray
        waiting = [_Hit() for _ in range(WAITING)]  # by peak, the nearest first
        display = mi.Color3f(0)  # premultiplied sRGB so far
        moment = mi.Float(0)
        passed = mi.Float(1)  # transmittance so far
        hits = mi.UInt32(0)
        active = mi.Bool(rays.active) & (rays.t_max > 0)
        while active:
            reached, found = self._enter(reached, rays, active)
            waiting = _insert(waiting, found)
            sure = _nearest(reached)  # nothing new has its peak before this
            front = waiting[0]
            full = waiting[-1].peak < dr.inf
            ready = active & (front.peak < dr.inf) & ((front.peak <= sure) | full)
            weight = dr.select(ready, passed * front.opacity, 0)
            display += weight * shade(front.index, ready)
            moment += dr.select(ready, weight * front.peak, 0)
            passed -= weight
            hits += dr.select(ready, 1, 0)
            waiting = _shift(waiting, ready)
            more = (sure < rays.t_max) | (waiting[0].peak < dr.inf)
            active &= more & (passed > stop) & (hits < MAX_HITS)
        opacity = 1 - passed
        seen = opacity > 0
        colour = dr.srgb_to_linear(display / dr.select(seen, opacity, 1))
        return March(opacity * colour, opacity, moment)

    def _enter(
        self, reached: list[mi.Float], rays: Rays, active: mi.Bool
    ) -> tuple[list[mi.Float], _Hit]:
        """Advance the tier that lags behind to the next shell that a ray enters.

        Mitsuba's intersection loses digits with the square of the distance: what it
        finds far away is only approached, and found again from there.
        """
        result, found = [], _Hit()
        waits = mi.Bool(active)
        nearest = _nearest(reached)
        for tier, start in zip(self._tiers, reached, strict=True):
            chosen = waits & (start == nearest) & (start < rays.t_max)
            waits &= ~chosen
            entry = tier.zoom * (rays.origin + start * rays.direction)
            ray = mi.Ray3f(mi.Point3f(entry), mi.Vector3f(rays.direction))
            shell = tier.scene.ray_intersect_preliminary(
                ray, coherent=False, active=chosen
            )
            hit = chosen & shell.is_valid()
            ahead = dr.select(hit, shell.t, 0) / tier.zoom
            far = ahead > tier.near
            entry = start + ahead
            size = dr.max(dr.abs(rays.origin)) + dr.abs(entry)
            passed = entry + 1.5e-7 * (1e-7 + size)  # a step of single precision
            index = tier.first + shell.prim_index
            fresh = hit & ~far
            found = dr.select(fresh, self._meet(index, rays, fresh), found)
            end = dr.select(far, entry - 0.5 * tier.near, passed)
            end = dr.select(hit, end, dr.inf)
            result.append(dr.select(chosen, end, start))
        return result, found

    def _meet(self, index: mi.UInt32, rays: Rays, active: mi.Bool) -> _Hit:
        """Return peak and opacity of splats on rays; none where it is not seen."""
        parts = [
            dr.gather(mi.Vector4f, self._records, 4 * index + k, active)
            for k in range(4)
        ]
        value = [part[j] for part in parts for j in range(4)]
        offset = mi.Vector3f(rays.origin) - mi.Vector3f(*value[:3])
        rows = [mi.Vector3f(*value[3 * k : 3 * k + 3]) for k in (1, 2, 3)]
        o = mi.Vector3f(*(dr.dot(row, offset) for row in rows))
        d = mi.Vector3f(*(dr.dot(row, rays.direction) for row in rows))
        inverse = dr.rcp(dr.squared_norm(d))
        peak = -dr.dot(o, d) * inverse
        # well-conditioned where the splat is thin, unlike |o + t d|
        squared = dr.squared_norm(dr.cross(o, d)) * inverse
        opacity = dr.minimum(value[12] * dr.exp(-0.5 * squared), MAX_OPACITY)
        seen = active & (squared <= REACH**2) & (peak > 0) & (peak < rays.t_max)
        return _Hit(dr.select(seen, peak, dr.inf), opacity, index)

    def _shade(self, direction: mi.Vector3f) -> Any:
        """Return the function that gives splats' colours, sRGB, not negative."""
        local = mi.Vector3f(*(dr.dot(column, direction) for column in self._columns))
        degree = round(self._terms**0.5) - 1
        basis = dr.sh_eval(local, degree)

        def colour(index: mi.UInt32, active: mi.Bool) -> mi.Color3f:
            total = mi.Color3f(0.5)
            for j, value in enumerate(basis):
                slot = self._terms * index + j
                term = dr.gather(mi.Color3f, self._harmonics, slot, active)
                total += value * term
            return dr.maximum(total, 0)

        return colour


def _nearest(distances: list[mi.Float]) -> mi.Float:
    nearest = distances[0]
    for distance in distances[1:]:
        nearest = dr.minimum(nearest, distance)
    return nearest


def _insert(waiting: list[_Hit], new: _Hit) -> list[_Hit]:
    """Put a hit among those sorted by peak, of which the last is free.

    A shell that rounding lets a ray enter twice is still among those that wait.
    """
    again = mi.Bool(False)
    for hit in waiting:
        again |= (hit.peak < dr.inf) & (hit.index == new.index)
    new = dr.select(again, _Hit(), new)
    result = []
    for hit in waiting:
        sooner = new.peak < hit.peak
        result.append(dr.select(sooner, new, hit))
        new = dr.select(sooner, hit, new)
    return result


def _shift(waiting: list[_Hit], gone: mi.Bool) -> list[_Hit]:
    """Remove the first hit of the rays of a mask."""
    following = [*waiting[1:], _Hit()]
    return [dr.select(gone, b, a) for a, b in zip(waiting, following, strict=True)]


def _group(splats: Splats) -> tuple[np.ndarray, list[slice]]:
    """Split splats by size where a few are much larger than most.

    Rays have to start as far behind their origin as the largest is wide. With the
    large ones apart, they pass by few small ones on that way.

    Returns:
        an order (n,), and the parts of it that belong together.
    """
    sizes = splats.scales.max(1)
    small = sizes <= 2 * np.median(sizes)
    order = np.argsort(~small, kind="stable")
    split = int(small.sum())
    parts = [slice(0, split), slice(split, len(sizes))]
    return order, [part for part in parts if part.stop > part.start]


def _in_world(
    splats: Splats, pose: Pose
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return centres and scales (n, 3), and rotations as matrices and quaternions.

    The matrices (n, 3, 3) and the quaternions (n, 4), x, y, z, w, map the splats' axes
    to the world.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(np.asarray(pose.rotation))
    local = Rotation.from_quat(splats.quaternions[:, [1, 2, 3, 0]])
    rotation = turn * local
    centers = pose.scale * turn.apply(splats.centers) + pose.translation
    scales = pose.scale * splats.scales.astype(np.float64)
    scales = np.maximum(scales, _THINNEST * scales.max(1, keepdims=True))
    return centers, scales, (rotation.as_matrix(), rotation.as_quat())


def _records(
    centers: np.ndarray,
    scales: np.ndarray,
    rotations: tuple[np.ndarray, np.ndarray],
    opacities: np.ndarray,
) -> np.ndarray:
    result = np.zeros((len(centers), _RECORD), np.float32)
    result[:, :3] = centers
    rows = rotations[0].transpose(0, 2, 1) / scales[:, :, None]
    result[:, 3:12] = rows.reshape(-1, 9)
    result[:, 12] = opacities
    return result


def _shells(scales: np.ndarray) -> np.ndarray:
    """Return standard deviations of shells that contain the splats, (n, 3)."""
    floor = _THINNEST_SHELL * scales.max(1, keepdims=True)
    index = np.arange(len(scales), dtype=np.uint64)
    spread = (index * np.uint64(2654435761) % np.uint64(1 << 32)) / float(1 << 32)
    return np.maximum(scales, floor) * (1 + _SPREAD * spread[:, None])


def _tier(data: np.ndarray, shells: np.ndarray, group: slice) -> _Tier:
    part = np.array(data[group])
    small = float(np.quantile(shells[group].min(1), 0.05))
    zoom = _UNITS / small
    part[:, :6] *= zoom
    shape = {"type": "ellipsoids", "data": mi.TensorXf(part), "extent": REACH}
    scene = mi.load_dict({"type": "scene", "splats": shape}, parallel=False)
    back = 2.01 * REACH * float(shells[group].max())  # a diameter
    numbers = (mi.Float(x) for x in (back, zoom, _ACCURATE * small))
    return _Tier(scene, mi.UInt32(group.start), *numbers)
