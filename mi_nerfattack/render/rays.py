"""Rays, what a march gives of them, and parts of a backward pass that wait."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import concat, put


@dataclass
class Gain:
    """Light on a field: what its radiance is multiplied by, ray by ray.

    Attributes:
        colour: (3, n), a constant of every derivative.
        row: (n,), which of the field's light maps; 0 for the light of its capture.
    """

    colour: mi.Color3f = field(default_factory=lambda: mi.Color3f(1))
    row: mi.UInt32 = field(default_factory=lambda: mi.UInt32(0))


@dataclass
class Rays:
    """Rays in the world, and where a march places its samples on them.

    Attributes:
        origin: (3, n), metres.
        direction: (3, n), unit vectors.
        t_max: (n,), metres; where the ray ends.
        jitter: (n,) in [0, 1), position of the sample in its interval.
        active: (n,) mask.
        gains: light on each field; none for the one of its capture.
    """

    origin: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    direction: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0, 0, 1))
    t_max: mi.Float = field(default_factory=lambda: mi.Float(dr.inf))
    jitter: mi.Float = field(default_factory=lambda: mi.Float(0.5))
    active: mi.Bool = field(default_factory=lambda: mi.Bool(True))
    gains: list[Gain] = field(default_factory=list)

    def light(self, posed: Sequence[Any]) -> list[Any]:
        """Return the fields with the rays' gains, one each unless there are none."""
        if not self.gains:
            return list(posed)
        pairs = zip(posed, self.gains, strict=True)
        return [item.with_gain(gain) for item, gain in pairs]


def pick_rays(value: Any, index: mi.UInt32) -> Any:
    """Gather rays of dataclasses and lists of arrays; one entry for all stays so."""
    if isinstance(value, list):
        return [pick_rays(item, index) for item in value]
    if is_dataclass(value):
        attributes = {item.name: getattr(value, item.name) for item in fields(value)}
        return type(value)(**{k: pick_rays(v, index) for k, v in attributes.items()})
    return value if dr.width(value) == 1 else dr.gather(type(value), value, index)


def put_rays(march: March, index: mi.UInt32, count: int) -> March:
    """Undo `pick_rays` of what was marched: entry k goes to `index[k]`.

    Args:
        march: (m,).
        index: (m,), distinct numbers below `count`; other rays are empty.
        count: n, of all rays.
    """
    result = March.zeros(count)
    put(result, march, index)
    return result


def meet_box(
    o: mi.Point3f, d: mi.Vector3f, lower: mi.Point3f, upper: mi.Point3f
) -> tuple[mi.Float, mi.Float]:
    """Return where lines enter and leave a box, (n,) each.

    A line that misses the box enters after it leaves. This function replaces
    `mi.BoundingBox3f.ray_intersect`, which takes only the rays of the variant that was
    set first in the process.
    """
    safe = dr.select(dr.abs(d) < 1e-12, dr.copysign(mi.Vector3f(1e-12), d), d)
    a, b = (lower - o) / safe, (upper - o) / safe
    return dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))


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

    def over(self, back: March) -> March:
        """Lay this march over another; all that passes it meets the one at the back."""
        passed = 1 - self.opacity
        return March(
            self.radiance + passed * back.radiance,
            self.opacity + passed * back.opacity,
            self.moment + passed * back.moment,
        )

    def pair(self, other: March) -> mi.Float:
        """Return the inner product with another march, ray by ray (n,)."""
        return (
            dr.dot(self.radiance, other.radiance)
            + self.opacity * other.opacity
            + self.moment * other.moment
        )

    def differs(self) -> mi.Bool:
        """Tell where any of it is not 0, (n,)."""
        colour = dr.any(self.radiance != 0)
        return colour | (self.opacity != 0) | (self.moment != 0)

    def images(self, name: str, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
        """Return the layers of a file of one image, row by row from the top left.

        Args:
            name: of the layer; empty for the image itself.
            shape: height and width.

        Returns:
            ``NAME`` (height, width, 4), premultiplied, and ``NAME.Z``, metres.
        """
        colour = self.radiance.numpy().T.reshape(*shape, 3)
        opacity = self.opacity.numpy().reshape(*shape, 1)
        key = f"{name}.Z" if name else "Z"
        depth = self.depth.numpy().reshape(shape)
        return {name: np.concatenate([colour, opacity], axis=-1), key: depth}

    @property
    def depth(self) -> mi.Float:
        """Expected depth (A.3, normalised), metres; infinite where opacity is 0."""
        hit = self.opacity > 0
        return dr.select(hit, self.moment / dr.select(hit, self.opacity, 1), dr.inf)


@dataclass
class Sparse:
    """A march of many rays of which few meet anything, without the others.

    Attributes:
        march: (m,), of the rays that meet something.
        index: (m,), which rays they are.
        count: n, of all rays.
    """

    march: March
    index: mi.UInt32
    count: int

    @staticmethod
    def of(march: March) -> March | Sparse:
        """Leave out the rays that meet nothing, where these are most; evaluates."""
        count = dr.width(march)
        index = dr.compress(march.differs())
        if 2 * dr.width(index) > count:
            return march
        return Sparse(pick_rays(march, index), index, count)

    def full(self) -> March:
        """Return the march of all rays."""
        return put_rays(self.march, self.index, self.count)


def shares_by_depth(layers: Sequence[March]) -> list[March]:
    """Weaken each layer by those of smaller expected depth.

    What is left of them adds up to their composite by depth. Of equal depths the first
    in the list is in front.

    Args:
        layers: one march a layer, each of n rays.
    """
    depths, shares = [layer.depth for layer in layers], []
    for index, layer in enumerate(layers):
        # Transmittance of all layers in front of this one, (n,)
        passed = mi.Float(1)
        for other, front in enumerate(layers):
            nearer = depths[other] < depths[index]
            if other < index:
                nearer |= depths[other] == depths[index]
            if other != index:
                passed *= dr.select(nearer, 1 - front.opacity, 1)
        channels = layer.radiance, layer.opacity, layer.moment
        shares.append(March(*(passed * channel for channel in channels)))
    return shares


FIRST_RAYS = 1 << 13  # that tasks wait for before a launch


@dataclass
class Task:
    """A part of a backward pass.

    Attributes:
        rays: m of the rays, with the gains of the fields to march.
        primal: what they gave.
        cotangent: derivative of the objective by `primal`.
        fields: indices of the fields to march.
    """

    rays: Rays = field(default_factory=Rays)
    primal: March = field(default_factory=March)
    cotangent: March = field(default_factory=March)
    fields: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Number of rays."""
        return dr.width(self.rays.direction)


class TaskQueue:
    """Tasks that wait until there are rays enough for a launch.

    A launch goes over the whole buffer of gradients, however few its rays are.
    """

    def __init__(self) -> None:
        self._waiting: dict[tuple[int, ...], list[Task]] = {}

    def add(self, task: Task) -> Iterator[Task]:
        """Let a task wait, or yield it with those that wait for the same fields."""
        dr.eval(task)  # or it holds all rays of its image
        waiting = self._waiting.setdefault(task.fields, [])
        waiting.append(task)
        if sum(one.size for one in waiting) >= FIRST_RAYS:
            yield self._joined(task.fields)

    def finish(self) -> Iterator[Task]:
        """Yield all that wait, a task for each set of fields."""
        for which in list(self._waiting):
            yield self._joined(which)

    def clear(self) -> None:
        """Forget all that wait."""
        self._waiting.clear()

    def _joined(self, which: tuple[int, ...]) -> Task:
        tasks = self._waiting.pop(which)
        return concat(tasks, [task.size for task in tasks])


def select(
    mask: mi.Bool, rays: Rays, primal: March, cotangent: March, which: tuple[int, ...]
) -> list[Task]:
    """Return the task of marching the wanted rays again; none without such rays.

    Rays without a cotangent are not among them.
    """
    index = dr.compress(mask & cotangent.differs())
    if not dr.width(index):
        return []

    gains = [rays.gains[k] for k in which] if rays.gains else []
    arrays = replace(rays, gains=gains), primal, cotangent
    return [Task(*(pick_rays(x, index) for x in arrays), fields=which)]
