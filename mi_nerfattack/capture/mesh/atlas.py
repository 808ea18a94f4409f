"""A texture that gives every triangle of a mesh texels of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError

_MAX_EDGE = 8192  # pixels of an atlas
_BORDER = 1  # texels around a triangle's box, which bilinear lookups reach


@dataclass(frozen=True, eq=False)
class Atlas:
    """Where triangles lie in an image, without distortion, each in a separate box.

    The box is one texel wider than the triangle on every side. A texel outside of the
    triangle has the value of the triangle's nearest point, so that bilinear lookups do
    not mix in a neighbouring triangle.

    Attributes:
        width, height: of the image, pixels.
        uv: (m, 3, 2), of the corners, in [0, 1], origin at the bottom left.
        rows, columns: (k,), texels that are used; row 0 is the top.
        triangles: (k,), which triangle each belongs to.
        weights: (k, 3), barycentric coordinates of the point whose value each has.
    """

    width: int
    height: int
    uv: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    triangles: np.ndarray
    weights: np.ndarray

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Mix what is given at the corners (m, 3, c) at the used texels, (k, c)."""
        return np.einsum("kc,kcd->kd", self.weights, values[self.triangles])

    def image(self, values: np.ndarray) -> np.ndarray:
        """Lay out values (k, c) of the used texels as an image (height, width, c).

        Texels that no triangle uses are the mean of the others.
        """
        mean = values.mean(0).astype(values.dtype)
        result = np.tile(mean, (self.height, self.width, 1))
        result[self.rows, self.columns] = values
        return result


def lay_out(corners: np.ndarray, texel_m: float) -> Atlas:
    """Give each triangle a box of texels.

    Boxes of like heights share a strip; along strips neighbours in space are
    neighbours in the image, so that a reduced image mixes colours that are close.

    Args:
        corners: (m, 3, 3), metres, m >= 1, no triangle without area.
        texel_m: edge of a texel.

    Raises:
        InputError: the image would have more than 8192 pixels an edge.
    """
    if not 0 < texel_m < np.inf:
        raise InputError(f"texel_m: {texel_m}; must be positive")
    flat = _flattened(corners) / texel_m
    boxes = np.ceil(flat.max(1)).astype(np.int64) + 2 * _BORDER
    width = _width(boxes)
    offsets, height = _packed(boxes, _order(corners, boxes), width)
    if max(width, height) > _MAX_EDGE:
        raise InputError(
            f"texel_m: {texel_m}; gives an image of {width} x {height} pixels, of "
            f"which {_MAX_EDGE} x {_MAX_EDGE} are allowed; choose larger texels or a "
            "mesh of fewer triangles"
        )
    triangles, local = _box_texels(boxes)
    weights = _nearest(flat[triangles], local + 0.5 - _BORDER)
    columns, rows = (offsets[triangles] + local).T
    uv = (offsets[:, None] + flat + _BORDER) / [width, height]
    uv[..., 1] = 1 - uv[..., 1]
    return Atlas(
        width,
        height,
        uv,
        rows=rows,
        columns=columns,
        triangles=triangles,
        weights=weights,
    )


def _flattened(corners: np.ndarray) -> np.ndarray:
    """Turn triangles into the plane, (m, 3, 2): the longest edge along x, from 0."""
    edges = np.roll(corners, -1, axis=1) - corners
    first = np.linalg.norm(edges, axis=2).argmax(1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], 1), 1, 0)
    length = np.linalg.norm(b - a, axis=1, keepdims=True)
    along = (b - a) / length
    foot = ((c - a) * along).sum(1, keepdims=True)
    rise = np.linalg.norm(c - a - foot * along, axis=1, keepdims=True)
    zero = np.zeros_like(foot)
    rows = np.stack(
        [np.hstack(pair) for pair in ((zero, zero), (length, zero), (foot, rise))],
        axis=1,
    )
    result = np.empty_like(rows)
    np.put_along_axis(result, order[..., None], rows, 1)
    return result


def _width(boxes: np.ndarray) -> int:
    """Choose the power of two that makes the image about square."""
    area = 1.1 * float(boxes.prod(1).sum())
    return 1 << int(np.ceil(np.log2(max(np.sqrt(area), boxes[:, 0].max()))))


def _order(corners: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Sort by class of height, then along a space-filling (Morton) curve."""
    middle = corners.mean(1)
    low, extent = middle.min(0), np.ptp(middle, axis=0).max()
    cell = np.minimum(1023, 1024 * (middle - low) / max(extent, 1e-30)).astype(np.int64)
    code = np.zeros(len(cell), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.lexsort([code, -np.floor(2 * np.log2(boxes[:, 1]))])


def _packed(boxes: np.ndarray, order: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Put boxes side by side in strips: column and row of each, and the height."""
    offsets = np.empty_like(boxes)
    column = row = strip = 0
    for index in order.tolist():
        across, high = boxes[index].tolist()
        if column + across > width:
            column, row, strip = 0, row + strip, 0
        offsets[index] = column, row
        column, strip = column + across, max(strip, high)
    return offsets, row + strip


def _box_texels(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List all texels of all boxes: the box (k,), and column and row in it (k, 2)."""
    counts = boxes.prod(1)
    owner = np.repeat(np.arange(len(boxes)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    across = boxes[owner, 0]
    return owner, np.stack([number % across, number // across], axis=1)


def _nearest(flat: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the barycentric coordinates (k, 3) of the nearest points of triangles.

    Args:
        flat: (k, 3, 2), corners.
        points: (k, 2).
    """
    edges = np.roll(flat, -1, axis=1) - flat
    offset = points[:, None] - flat
    twice = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    # the area beside each edge is the share of the corner opposite of it
    beside = edges[..., 0] * offset[..., 1] - edges[..., 1] * offset[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # slivers: their edges count
        weights = np.roll(beside / twice[:, None], 2, axis=1)
    along = (offset * edges).sum(2) / (edges**2).sum(2)
    along = np.clip(along, 0, 1)
    distance = np.linalg.norm(offset - along[..., None] * edges, axis=2)
    edge, rows = distance.argmin(1), np.arange(len(flat))
    share = along[rows, edge]
    on_edge = np.zeros_like(weights)
    on_edge[rows, edge] = 1 - share
    on_edge[rows, (edge + 1) % 3] = share
    return np.where((weights >= 0).all(1, keepdims=True), weights, on_edge)
