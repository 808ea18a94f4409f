"""Segments of a ray on which the set of fields does not change."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.march import Rays, seek
from mi_nerfattack.render.posed import PosedField


@dataclass
class Path:
    """Rays in the frame of one field, and where they are inside its box."""

    o: mi.Point3f = field(default_factory=lambda: mi.Point3f(0))
    d: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    heading: mi.Vector3f = field(default_factory=lambda: mi.Vector3f(0))
    near: mi.Float = field(default_factory=lambda: mi.Float(0))
    far: mi.Float = field(default_factory=lambda: mi.Float(0))


@dataclass
class Cursor:
    """One field's lattice interval at or ahead of the march, metres."""

    following: mi.Float = field(default_factory=lambda: mi.Float(0))
    start: mi.Float = field(default_factory=lambda: mi.Float(0))
    end: mi.Float = field(default_factory=lambda: mi.Float(0))


@dataclass
class Segment:
    """Part of the rays on which the set of fields does not change."""

    t: mi.Float = field(default_factory=lambda: mi.Float(0))
    width: mi.Float = field(default_factory=lambda: mi.Float(0))
    end: mi.Float = field(default_factory=lambda: mi.Float(0))
    inside: list[mi.Bool] = field(default_factory=list)


def enter(posed: PosedField, rays: Rays) -> tuple[Path, Cursor]:
    """Take rays into the frame of a field, with a cursor before its first interval."""
    o, d = posed.to_local(rays.origin, rays.direction)
    near, far = posed.interval(o, d, rays.t_max)
    first = dr.floor(posed.lattice_index(near))
    missed = ~(near < far)
    end = dr.select(missed, dr.inf, -1)  # -1 is spent: the first interval is sought
    path = Path(o, d, dr.normalize(d), near, far)
    return path, Cursor(first, dr.select(missed, dr.inf, 0), end)


def advance(
    posed: PosedField,
    path: Path,
    cursor: Cursor,
    t: mi.Float,
    jitter: mi.Float,
    active: mi.Bool,
) -> Cursor:
    """Move on to the next occupied interval where the present one lies behind t."""
    spent = active & (cursor.end <= t)
    index, _, _, found = seek(
        posed, path.o, path.d, cursor.following, path.near, path.far, jitter, spent
    )
    start = dr.maximum(posed.lattice(index), path.near)
    end = dr.maximum(dr.minimum(posed.lattice(index + 1), path.far), start)
    start, end = dr.select(found, start, dr.inf), dr.select(found, end, dr.inf)
    return Cursor(
        dr.select(spent, index + 1, cursor.following),
        dr.select(spent, start, cursor.start),
        dr.select(spent, end, cursor.end),
    )


def next_segment(
    cursors: list[Cursor], t: mi.Float, jitter: mi.Float, active: mi.Bool
) -> Segment:
    """Find the next segment at or after t; its end is infinite where there is none."""
    nearest = mi.Float(dr.inf)
    for cursor in cursors:
        nearest = dr.minimum(nearest, cursor.start)
    begin = dr.maximum(t, nearest)
    end = mi.Float(dr.inf)
    inside = []
    for cursor in cursors:
        entered = cursor.start <= begin
        end = dr.minimum(end, dr.select(entered, cursor.end, cursor.start))
        inside.append(active & entered & (cursor.end < dr.inf))
    exists = active & (nearest < dr.inf)
    width = dr.select(exists, end - begin, 0)
    sample = dr.select(exists, begin + jitter * width, 0)
    return Segment(sample, width, end, inside)
