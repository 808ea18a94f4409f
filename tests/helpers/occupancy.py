"""The occupancy of any field, by trying its density."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy import ndimage

from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.occupancy import Occupancy


def build(
    field: AbstractField,
    resolution: int,
    threshold: float,
    seed: int = 0,
    samples: int = 8,
    dilate: int = 1,
    chunk: int = 1 << 20,
) -> Occupancy:
    """Build the occupancy of a field from its density.

    Each cell is sampled at its centre and at jittered positions; it is occupied
    when the largest density there reaches the threshold, or when a neighbour is.

    Args:
        field: the field; its present occupancy is not looked at.
        resolution: cells along the longest edge of the bounding box.
        threshold: density, 1/metre of the field's frame.
        seed: of the jitter.
        samples: positions a cell.
        dilate: neighbours that are taken along, in cells.
        chunk: evaluations a launch.
    """
    extent = np.asarray(field.upper - field.lower, float)
    shape = np.maximum(1, np.round(resolution * extent / extent.max())).astype(int)
    count = int(np.prod(shape))
    peak = np.zeros(count, np.float32)
    rng = np.random.default_rng(seed)
    for start in range(0, count, chunk):
        index = np.arange(start, min(start + chunk, count))
        cell = np.stack(np.unravel_index(index, shape))
        for k in range(samples):
            offset = 0.5 if k == 0 else rng.random(cell.shape)
            local = (
                field.lower[:, None]
                + (cell + offset) / shape[:, None] * extent[:, None]
            )
            density = field.density(mi.Point3f(local.astype(np.float32)), mi.Bool(True))
            peak[index] = np.maximum(peak[index], density.numpy())
    cells = (peak >= threshold).reshape(shape)
    if dilate and cells.any():
        cells = ndimage.binary_dilation(cells, np.ones((3, 3, 3)), iterations=dilate)
    return Occupancy(cells)
