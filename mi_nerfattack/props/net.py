"""The net of a box: its faces as a cross, glue tabs, and what to cut and to fold.

The net of a flat object is one face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: In an inch.
MM = 25.4
_TAB_MM = 15.0
_TAB_SHARE = 0.2  # of the shortest edge, at most


@dataclass(frozen=True)
class Rectangle:
    """An upright rectangle on paper, millimetres, y up."""

    left: float
    bottom: float
    width: float
    height: float

    @classmethod
    def around(cls, points: Sequence[tuple[float, float]]) -> Rectangle:
        """Return the smallest one that holds all points."""
        low, high = np.min(points, 0).tolist(), np.max(points, 0).tolist()
        return cls(low[0], low[1], high[0] - low[0], high[1] - low[1])

    @property
    def right(self) -> float:
        """Of its right edge."""
        return self.left + self.width

    @property
    def top(self) -> float:
        """Of its top edge."""
        return self.bottom + self.height

    def common(self, other: Rectangle) -> Rectangle | None:
        """Return what it shares with another, None if that has no area."""
        left, bottom = max(self.left, other.left), max(self.bottom, other.bottom)
        width = min(self.right, other.right) - left
        height = min(self.top, other.top) - bottom
        good = width > 1e-6 and height > 1e-6
        return Rectangle(left, bottom, width, height) if good else None


@dataclass(frozen=True)
class Tab:
    """A strip that is glued beneath a face.

    Attributes:
        outline: four corners, millimetres; the first and the last are on the fold.
        under: name of the face.
    """

    outline: tuple[tuple[float, float], ...]
    under: str


Line = tuple[tuple[float, float], tuple[float, float]]


class Net:
    """The walls side by side, left, front, right, back; top and bottom at the front.

    Seen from outside, as printed: the paper is folded away from the reader.

    Args:
        edges_mm: (3,), of the box along its own x, y and z.
        sheet: name of the only face, of a flat object; None for all faces.

    Attributes:
        faces: by their names.
        tabs: one at each of the seven pairs of edges that meet when it is folded.
        cuts: lines to cut along, around faces and tabs.
        folds: lines between faces, and between faces and tabs.
    """

    def __init__(self, edges_mm: np.ndarray, sheet: str | None = None) -> None:
        x, y, z = map(float, edges_mm)
        self.faces = {
            "left": Rectangle(0, 0, y, z),
            "front": Rectangle(y, 0, x, z),
            "right": Rectangle(y + x, 0, y, z),
            "back": Rectangle(2 * y + x, 0, x, z),
            "top": Rectangle(y, z, x, y),
            "bottom": Rectangle(y, -y, x, y),
        }
        self.tabs: list[Tab] = []
        self.folds: list[Line] = []
        self.cuts: list[Line] = []
        if sheet is None:
            self._add_lines(x, y, z)
        else:
            face = self.faces[sheet]
            self.faces = {sheet: face}
            xs, ys = (face.left, face.right), (face.bottom, face.top)
            self.cuts += [((a, ys[0]), (a, ys[1])) for a in xs]
            self.cuts += [((xs[0], b), (xs[1], b)) for b in ys]

    def _add_lines(self, x: float, y: float, z: float) -> None:
        """Add tabs, and where to cut and to fold."""
        depth = min(_TAB_MM, _TAB_SHARE * min(x, y, z))
        ends = (0.0, y, y + x, 2 * y + x, 2 * (x + y))
        left, front, right, after, end = ends
        # around the net counter-clockwise: each tab is right of its fold
        folds = (
            ((left, z), (left, 0.0), "back"),
            ((left, 0.0), (front, 0.0), "bottom"),
            ((right, 0.0), (after, 0.0), "bottom"),
            ((after, 0.0), (end, 0.0), "bottom"),
            ((end, z), (after, z), "top"),
            ((after, z), (right, z), "top"),
            ((front, z), (left, z), "top"),
        )
        self.tabs = [Tab(_tab(p, q, depth), under) for p, q, under in folds]
        inner: list[Line] = [((e, 0.0), (e, z)) for e in ends[1:4]]
        inner += [((front, level), (right, level)) for level in (0.0, z)]
        self.folds = inner + [(p, q) for p, q, _ in folds]
        self.cuts = [((end, 0.0), (end, z))]
        for low, high, outer in ((z, z + y, z + y), (-y, 0.0, -y)):
            self.cuts.append(((front, outer), (right, outer)))
            self.cuts += [((side, low), (side, high)) for side in (front, right)]
        for tab in self.tabs:
            self.cuts += list(zip(tab.outline[:-1], tab.outline[1:], strict=True))

    @property
    def bounds(self) -> Rectangle:
        """The box around faces and tabs."""
        return Rectangle.around([point for line in self.cuts for point in line])


def _tab(
    p: tuple[float, float], q: tuple[float, float], depth: float
) -> tuple[tuple[float, float], ...]:
    """Return the corners of a tab at the fold from p to q, sides at 45 degrees."""
    start, end = np.array(p), np.array(q)
    along = depth * (end - start) / np.linalg.norm(end - start)
    out = np.array([along[1], -along[0]])
    corners = (start, start + along + out, end - along + out, end)
    return tuple((float(corner[0]), float(corner[1])) for corner in corners)
