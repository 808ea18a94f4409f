"""What an attack made of a texture: distances, saturation, total variation.

All are of what the camera sees: a vertex of the finest level counts by how much its
colour changes the images of given drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.attack.colours import vertex_colours
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor

#: A colour value nearer than this to 0 or 1 (sRGB) is saturated.
SATURATED = 0.02
#: Vertices with less than this share of the largest weight are not seen.
_SEEN = 1e-3


@dataclass(frozen=True)
class TextureStatistics:
    """Figures of one object's texture, against the original one.

    Attributes:
        l2: root mean square distance of colours, sRGB.
        linf: largest distance of a colour value, sRGB.
        saturated_share: of the colour values, within `SATURATED` of 0 or 1.
        total_variation: mean distance of neighbouring vertices' colours, sRGB a voxel
            of the finest level.
    """

    l2: float
    linf: float
    saturated_share: float
    total_variation: float


def seen_weights(
    sensor: AbstractDifferentiableSensor, fields: Sequence[GridField], states: Any
) -> list[np.ndarray]:
    """Weigh the vertices of each object's finest level, (n, n, n) by z, y, x.

    Textures are left as they are. Costs a march and its derivative a state.

    Args:
        sensor: sees the objects.
        fields: of the objects, in the sensor's order.
        states: (steps, m, n) states from which they are seen.
    """
    textures = sensor.textures()
    grey = [mi.TensorXf(np.zeros(texture.shape, np.float32)) for texture in textures]
    sensor.set_textures(grey)  # where colours change by equal amounts
    sensor.start_gradient()
    for step, state in enumerate(states):
        seen = sensor.observe(state, step)
        ones = dr.ones(mi.TensorXf, seen.image.shape)
        sensor.vjp(seen, state, ones, False)
    gradients = sensor.texture_gradients()
    sensor.set_textures(textures)
    return [
        _finest(field, np.array(gradient).sum(axis=1))
        for field, gradient in zip(fields, gradients, strict=True)
    ]


def texture_statistics(
    field: GridField, original: Any, weights: np.ndarray
) -> TextureStatistics:
    """Judge a texture.

    Args:
        field: with the texture; has it again afterwards.
        original: (n_vertices, 3) raw colours to compare with.
        weights: from :func:`seen_weights`.
    """
    texture = field.texture
    seen = weights > _SEEN * weights.max(initial=0.0)
    if not seen.any():
        return TextureStatistics(0.0, 0.0, 0.0, 0.0)
    colour = vertex_colours(field, field.levels()[-1], seen)
    field.set_parameter("texture", original)
    change = colour - vertex_colours(field, field.levels()[-1], seen)
    field.set_parameter("texture", texture)
    weight = weights[seen] / weights[seen].sum()
    saturated = np.minimum(colour, 1 - colour) < SATURATED
    return TextureStatistics(
        float(np.sqrt((weight * (change**2).mean(axis=1)).sum())),
        float(np.abs(change).max()),
        float((weight * saturated.mean(axis=1)).sum()),
        _variation(colour, seen, weights),
    )


def _variation(colour: np.ndarray, seen: np.ndarray, weights: np.ndarray) -> float:
    """Average over pairs of neighbours that are both seen."""
    grid = np.zeros((*seen.shape, 3))
    grid[seen] = colour
    above = below = 0.0
    for axis in range(3):
        low = [slice(None)] * 3
        low[axis] = slice(None, -1)
        high = [slice(None)] * 3
        high[axis] = slice(1, None)
        first, second = tuple(low), tuple(high)
        both = np.where(
            seen[first] & seen[second],
            np.sqrt(np.maximum(weights[first] * weights[second], 0)),
            0,
        )
        below += both.sum()
        above += (both * np.abs(grid[first] - grid[second]).mean(axis=-1)).sum()
    return float(above / below) if below else 0.0


def _finest(field: GridField, values: np.ndarray) -> np.ndarray:
    level = field.levels()[-1]
    return values[level.vertices].reshape((level.resolution,) * 3)
