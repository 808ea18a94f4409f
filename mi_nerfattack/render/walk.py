"""The way of rays from sample to sample, through one field or several.

A :class:`Walk` follows the lattice of one field. A :class:`MergedWalk` merges the
lattice intervals of all fields into segments on which the set of fields does not
change; each is one sample.

Most lattice intervals that a march looks at lie in the air between the camera and the
first surface. Rays side by side cross the same air, so a bundle of them is followed
once, from one block of empty cells to the next (:func:`clear_distance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays, pick_rays

MAX_INTERVALS = 1 << 23  # float32 counts exactly up to twice this
BUNDLE = 16  # rays
_MARGIN = 1e-3  # cells; thirty times what single precision rounds off


@dataclass
class Path:
    """Rays in the frame of a field, from a lattice point before its box to its end.

    Far from their origin, single precision would show in positions and lengths, so
    both are counted from where a path begins.

    Attributes:
        o: (3, n), where the paths begin.
        d: (3, n), directions per world metre.
        heading: (3, n), directions of unit length.
        begin: (n,), distance of `o` from the rays' origins, metres in the world.
        first: (n,), lattice point there.
        near: (n,), where density may begin, metres after `begin`.
        far: (n,), where density ends at the latest, metres after `begin`.
    """

    o: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    d: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    heading: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    begin: mi.Float = field(default_factory=lambda: mi.Float(0))
    first: mi.Float = field(default_factory=lambda: mi.Float(0))
    near: mi.Float = field(default_factory=lambda: mi.Float(0))
    far: mi.Float = field(default_factory=lambda: mi.Float(0))

    @staticmethod
    def of(posed: PosedField, rays: Rays) -> Path:
        """Take rays into a field's frame."""
        o, d = posed.to_local(rays.origin, rays.direction)
        near, far = posed.interval(o, d, rays.t_max)
        meets = near < far
        # The path begins at the last lattice point before the box
        first = dr.select(meets, dr.floor(posed.lattice_index(near)), 0)
        begin = posed.lattice(first)
        path = Path(o + begin * d, d, dr.normalize(d), begin=begin, first=first)
        near, far = near - begin, far - begin
        if not posed.field.window.is_open:
            # Density falls to 0 at the box. Whole intervals around it leave no edge
            # that would move with the ray.
            last = posed.lattice_index_after(begin, first, far)
            end = posed.lattice_after(begin, first, dr.ceil(last))
            near, far = mi.Float(0), dr.minimum(end, rays.t_max - begin)
        path.near, path.far = near, dr.select(meets, far, near)
        return path

    def edge(self, posed: PosedField, index: mi.Float) -> mi.Float:
        """Return where a lattice interval begins, metres after `begin`."""
        return posed.lattice_after(self.begin, self.first, index)

    def interval(self, posed: PosedField, s: mi.Float) -> mi.Float:
        """Return the lattice interval at a distance after `begin`."""
        return dr.floor(posed.lattice_index_after(self.begin, self.first, s))

    def at(self, t: mi.Float) -> mi.Point3f:
        """Return points (3, n) at distances (n,) of the rays, in world metres."""
        return mi.Point3f(self.o + (t - self.begin) * self.d)


@dataclass
class Segment:
    """Part of rays that a sample represents.

    Attributes:
        t: (n,), position of the sample, metres.
        width: (n,), length of the part, metres.
        active: (n,), rays that have a sample.
        inside: (n,) for each field, rays on which the field has a sample.
    """

    t: mi.Float
    width: mi.Float
    active: mi.Bool
    inside: list[mi.Bool]

    def depths(self, densities: Sequence[mi.Float]) -> list[mi.Float]:
        """Return the optical depth of each field, (n,), 0 where there is none."""
        return [dr.select(self.active, x * self.width, 0) for x in densities]


@dataclass
class Walk:
    """Rays on their way through the lattice of one field.

    Attributes:
        paths: of the field, one.
        jitter: (n,), position of the samples in their intervals.
        index: (n,), the lattice interval ahead, counted from the path's first.
    """

    paths: list[Path] = field(default_factory=list)
    jitter: mi.Float = field(default_factory=lambda: mi.Float(0.5))
    index: mi.Float = field(default_factory=lambda: mi.Float(0))

    @staticmethod
    def start(
        posed: PosedField, rays: Rays, clear: mi.Float | None = None
    ) -> tuple[Walk, mi.Bool]:
        """Return rays before their first interval, and those that meet the box.

        Args:
            posed: the field.
            rays: n rays.
            clear: (n,), metres on which rays meet empty cells alone.
        """
        path = Path.of(posed, rays)
        active = mi.Bool(rays.active) & (path.near < path.far)
        walk = Walk([path], rays.jitter, mi.Float(0))
        if clear is not None:
            walk.index = dr.maximum(path.interval(posed, clear - path.begin), 0)
        return walk, active

    def next(
        self, posed: Sequence[PosedField], active: mi.Bool
    ) -> tuple[Walk, Segment]:
        """Go on to the next interval in an occupied cell."""
        index, t, width, active = seek(
            posed[0], self.paths[0], self.index, self.jitter, active
        )
        walk = Walk(self.paths, self.jitter, index + 1)
        return walk, Segment(t, width, active, [active])


@dr.syntax
def seek(
    posed: PosedField, path: Path, index: mi.Float, jitter: mi.Float, active: mi.Bool
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Bool]:
    """Advance rays (n,) to their next lattice interval in an occupied cell.

    Returns:
        index, sample position (metres from the origin) and width of the interval, and
        which rays found one before they left the box; each (n,).
    """
    occupancy = posed.field.occupancy
    s = mi.Float(0)
    width = mi.Float(0)
    searching = mi.Bool(active)
    hit = mi.Bool(False)
    while searching:
        # The interval, cut at the ends of the path, and the sample in it
        start = dr.maximum(path.edge(posed, index), path.near)
        end = dr.minimum(path.edge(posed, index + 1), path.far)
        s = start + jitter * (end - start)
        width = end - start
        searching &= (start < path.far) & (index < MAX_INTERVALS)
        # The search ends where the sample lies in an occupied cell
        unit = posed.field.unit(mi.Point3f(path.o + s * path.d))
        distance, cell = occupancy.query(unit, searching)
        hit = searching & (distance == 0)
        searching &= ~hit
        # Otherwise the search jumps over the empty block, by one interval at least
        rate = posed.field.unit_vector(path.d)
        leaving = s + occupancy.exit(unit, rate, cell, distance=distance)
        jump = dr.maximum(index + 1, path.interval(posed, leaving))
        index = dr.select(searching, jump, index)
    return index, path.begin + s, dr.maximum(width, 0), hit


@dataclass
class Cursor:
    """One field's lattice interval at or ahead of the march, metres."""

    following: mi.Float
    start: mi.Float
    end: mi.Float

    @staticmethod
    def before(path: Path) -> Cursor:
        """Return a cursor before the first interval."""
        missed = ~(path.near < path.far)
        start = dr.select(missed, dr.inf, 0)
        end = dr.select(missed, dr.inf, -1)  # spent: the first interval is sought
        return Cursor(mi.Float(0), start, end)

    def advance(
        self,
        posed: PosedField,
        path: Path,
        t: mi.Float,
        jitter: mi.Float,
        active: mi.Bool,
    ) -> Cursor:
        """Move on to the next occupied interval where the present one lies behind t."""
        spent = active & (self.end <= t)
        index, _, _, hit = seek(posed, path, self.following, jitter, spent)
        start = dr.maximum(path.edge(posed, index), path.near) + path.begin
        end = dr.minimum(path.edge(posed, index + 1), path.far) + path.begin
        end = dr.maximum(end, start)
        # A cursor without a further interval waits at infinity
        start, end = dr.select(hit, start, dr.inf), dr.select(hit, end, dr.inf)
        return Cursor(
            dr.select(spent, index + 1, self.following),
            dr.select(spent, start, self.start),
            dr.select(spent, end, self.end),
        )


@dataclass
class MergedWalk:
    """Rays on their way through the lattices of several fields.

    Attributes:
        paths: one of each field.
        jitter: (n,), position of the samples in their segments.
        cursors: one of each field.
        t: (n,), end of the segments behind, metres.
    """

    paths: list[Path] = field(default_factory=list)
    jitter: mi.Float = field(default_factory=lambda: mi.Float(0.5))
    cursors: list[Cursor] = field(default_factory=list)
    t: mi.Float = field(default_factory=lambda: mi.Float(0))

    @staticmethod
    def start(posed: Sequence[PosedField], rays: Rays) -> tuple[MergedWalk, mi.Bool]:
        """Return rays before their first segment, and those that may have one."""
        paths = [Path.of(item, rays) for item in posed]
        cursors = [Cursor.before(path) for path in paths]
        walk = MergedWalk(paths, rays.jitter, cursors, t=mi.Float(0))
        return walk, mi.Bool(rays.active)

    def next(
        self, posed: Sequence[PosedField], active: mi.Bool
    ) -> tuple[MergedWalk, Segment]:
        """Go on to the next segment that a field covers."""
        # Cursors whose interval lies behind t move on to their next occupied interval
        fields = zip(self.cursors, posed, self.paths, strict=True)
        cursors = [
            cursor.advance(item, path, self.t, self.jitter, active)
            for cursor, item, path in fields
        ]
        # The segment begins at t, or at the nearest interval if all lie ahead
        nearest = mi.Float(dr.inf)
        for cursor in cursors:
            nearest = dr.minimum(nearest, cursor.start)
        active = active & (nearest < dr.inf)
        begin = dr.maximum(self.t, nearest)
        # The segment ends at the next point where a field begins or ends
        end = mi.Float(dr.inf)
        inside = []
        for cursor in cursors:
            entered = cursor.start <= begin
            end = dr.minimum(end, dr.select(entered, cursor.end, cursor.start))
            inside.append(active & entered & (cursor.end < dr.inf))
        width = dr.select(active, end - begin, 0)
        sample = dr.select(active, begin + self.jitter * width, 0)
        t = dr.select(active, end, self.t)
        walk = MergedWalk(self.paths, self.jitter, cursors, t=t)
        return walk, Segment(sample, width, active, inside)


@dr.syntax
def sample_count(posed: PosedField, rays: Rays) -> mi.Float:
    """Count the samples a march would take if nothing stopped it, (n,).

    Args:
        posed: the field and its pose; only its occupancy is looked at.
        rays: n rays.
    """
    walk, active = Walk.start(posed, rays)
    count = mi.Float(0)
    while active:
        walk, segment = walk.next([posed], active)
        active = segment.active
        count += dr.select(active, 1.0, 0.0)
    return count


@dataclass
class Range:
    """Smallest box around points or directions of a bundle's rays.

    Attributes:
        lower: (3, m), in the unit box of a field.
        upper: (3, m), as `lower`.
    """

    lower: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(dr.inf))
    upper: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(-dr.inf))

    def around(self, vector: mi.Vector3f) -> Range:
        """Return the range that holds `vector`, too."""
        return Range(dr.minimum(self.lower, vector), dr.maximum(self.upper, vector))


def clear_distance(posed: PosedField, rays: Rays, last: mi.UInt32) -> mi.Float:
    """Return how far rays go before one of their bundle may meet a field.

    Args:
        posed: the field; its occupancy alone is looked at.
        rays: n rays, neighbours one after the other.
        last: n - 1, opaque, so that no number becomes code.

    Returns:
        metres (n,); 0 where a bundle is too wide for the empty cells where it begins.
    """
    count = dr.width(rays.direction)
    first = BUNDLE * dr.arange(mi.UInt32, -(-count // BUNDLE))
    begin, rate = _enclose(posed, rays, first, last)
    least = posed.lattice(mi.Float(1))
    clear = _follow(posed.field.occupancy, begin, rate, least)
    return dr.gather(mi.Float, clear, dr.arange(mi.UInt32, count) // BUNDLE)


@dr.syntax
def _enclose(
    posed: PosedField, rays: Rays, first: mi.UInt32, last: mi.UInt32
) -> tuple[Range, Range]:
    """Return ranges of where bundles (m,) begin, and of their way in a metre."""
    begin, rate = Range(), Range()
    k = mi.UInt32(0)
    while k < BUNDLE:
        # Ray k of every bundle; the last bundle repeats the last ray
        place = dr.minimum(first + k, last)
        ray = pick_rays([rays.origin, rays.direction], place)
        o, d = posed.to_local(ray[0], ray[1])
        begin = begin.around(mi.Vector3f(posed.field.unit(o)))
        rate = rate.around(posed.field.unit_vector(d))
        k += 1
    return begin, rate


@dr.syntax
def _follow(
    occupancy: Occupancy, begin: Range, rate: Range, least: mi.Float
) -> mi.Float:
    """Return how far bundles (m,) stay in empty cells, metres.

    Args:
        occupancy: the cells.
        begin: where they begin.
        rate: their way in a metre.
        least: length of a way that is worth another look, metres.
    """
    shape = mi.Vector3f(occupancy.shape)
    t = mi.Float(0)
    going = mi.Bool(True)
    while going:
        # A block of empty cells around the middle; two corners hold the whole bundle
        lower = begin.lower + t * rate.lower - _MARGIN / shape
        upper = begin.upper + t * rate.upper + _MARGIN / shape
        distance, cell = occupancy.query(mi.Point3f(0.5 * (lower + upper)), going)
        going &= distance >= 1
        going &= dr.all(dr.abs(dr.floor(lower * shape) - cell) < distance)
        going &= dr.all(dr.abs(dr.floor(upper * shape) - cell) < distance)
        # Up to where one of them leaves it
        first = occupancy.exit(mi.Point3f(lower), rate.lower, cell, distance=distance)
        other = occupancy.exit(mi.Point3f(upper), rate.upper, cell, distance=distance)
        way = dr.select(going, dr.minimum(first, other), 0)
        t += way
        going &= (way > least) & (t < dr.inf)
    return t
