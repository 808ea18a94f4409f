"""What an attack made of a texture: distances, saturation, variation, spectrum.

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

from mi_nerfattack.attack.texture.colours import vertex_colours
from mi_nerfattack.attack.texture.constraints import neighbours
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor

#: A colour value nearer than this to 0 or 1 (sRGB) is saturated.
SATURATED = 0.02
#: Vertices with less than this share of the largest weight are not seen.
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True)
class TextureStatistics:
    """Figures of one object's texture, against the original one.

    Attributes:
        l2: root mean square distance of colours, sRGB.
        linf: largest distance of a colour value, sRGB.
        saturated_share: of the colour values, within `SATURATED` of 0 or 1.
        total_variation: mean distance of neighbouring vertices' colours, sRGB a voxel
            of the finest level.
        spectrum: shares of `l2` squared by the size of what changed: entry k is of
            structure of 2^k to 2^(k + 1) voxels, the last of the mean change. Empty
            where nothing changed.
    """

    l2: float
    linf: float
    saturated_share: float
    total_variation: float
    spectrum: list[float]


def seen_weights(
    sensor: AbstractDifferentiableSensor, fields: Sequence[GridField], states: Any
) -> list[np.ndarray]:
    """Weigh the vertices of each object's finest level, (n, n, n) by z, y, x.

    Textures are left as they are, also when this fails. Costs a march and its
    derivative a state.

    Args:
        sensor: sees the objects.
        fields: of the objects, in the sensor's order.
        states: (steps, m, n) states from which they are seen.
    """
    textures = sensor.textures()
    grey = [mi.TensorXf(np.zeros(texture.shape, np.float32)) for texture in textures]
    try:
        sensor.set_textures(grey)  # where colours change by equal amounts
        sensor.start_gradient()
        for step, state in enumerate(states):
            # The derivative of the sum of all pixel values, summed over the states
            observation = sensor.observe(state, step)
            ones = dr.ones(mi.TensorXf, observation.image.shape)
            sensor.vjp(observation, state, ones, attached=False)
        gradients = sensor.texture_gradients()
    finally:
        sensor.stop_gradient()
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
        field: with the texture; has it again afterwards, also when this fails.
        original: (n_vertices, 3) raw colours to compare with.
        weights: from :func:`seen_weights`.
    """
    texture = field.texture
    visible = weights > _LEAST_WEIGHT * weights.max(initial=0.0)
    if not visible.any():
        return TextureStatistics(
            l2=0.0, linf=0.0, saturated_share=0.0, total_variation=0.0, spectrum=[]
        )
    # The colours of both textures, at the vertices that the images show
    colour = vertex_colours(field, field.levels()[-1], visible)
    try:
        field.set_parameter("texture", original)
        change = colour - vertex_colours(field, field.levels()[-1], visible)
    finally:
        field.set_parameter("texture", texture)
    weight = weights[visible] / weights[visible].sum()
    saturated = np.minimum(colour, 1 - colour) < SATURATED
    return TextureStatistics(
        float(np.sqrt((weight * (change**2).mean(axis=1)).sum())),
        float(np.abs(change).max()),
        float(min(1, (weight * saturated.mean(axis=1)).sum())),  # weights round
        total_variation=_variation(colour, visible, weights),
        spectrum=_spectrum(change, visible, weights),
    )


def _spectrum(
    change: np.ndarray, visible: np.ndarray, weights: np.ndarray
) -> list[float]:
    """Take a change apart by Haar's averages over blocks, weighted.

    What an average over eight neighbours leaves of them is structure of their size; the
    averages are taken apart likewise. The parts' squares add up to that of the whole.
    """
    # A cube whose edge is a power of two; what is outside the lattice weighs 0
    size = 1 << (max(visible.shape) - 1).bit_length()
    values, weight = np.zeros((size,) * 3 + (3,)), np.zeros((size,) * 3 + (1,))
    inside = tuple(slice(n) for n in visible.shape)
    values[inside][visible] = change
    weight[inside][visible] = weights[visible][:, None]
    total = (weight * values**2).sum()
    if not total:
        return []
    # The weighted square that is left after each average over eight neighbours
    left = [total]
    while len(values) > 1:
        above = _blocks(weight * values)
        weight = _blocks(weight)
        values = np.divide(above, weight, out=above, where=weight > 0)
        left.append((weight * values**2).sum())
    # What one average removes is structure of the size of its blocks
    return (-np.diff([*left, 0.0]) / total).tolist()


def _blocks(cube: np.ndarray) -> np.ndarray:
    """Add up 2 x 2 x 2 neighbours."""
    for axis in range(3):
        cube = cube.take(range(0, cube.shape[axis], 2), axis) + cube.take(
            range(1, cube.shape[axis], 2), axis
        )
    return cube


def _variation(colour: np.ndarray, visible: np.ndarray, weights: np.ndarray) -> float:
    """Average over pairs of neighbours that are both seen."""
    grid = np.zeros((*visible.shape, 3))
    grid[visible] = colour
    above = below = 0.0
    for axis in range(3):
        first, second = neighbours(axis)
        both = np.where(
            visible[first] & visible[second],
            np.sqrt(np.maximum(weights[first] * weights[second], 0)),
            0,
        )
        below += both.sum()
        above += (both * np.abs(grid[first] - grid[second]).mean(axis=-1)).sum()
    return float(above / below) if below else 0.0


def _finest(field: GridField, values: np.ndarray) -> np.ndarray:
    level = field.levels()[-1]
    return values[level.vertices].reshape((level.resolution,) * 3)
