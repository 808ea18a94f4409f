"""The benchmark's field: the bundled scene in the full architecture.

The bundled field is smaller than the architecture that the figures are quoted for (16
levels, 2^19 vertices a level, two networks 64 wide), and a field with random
parameters would see other densities than a scene does. So the bundled field is copied
into the larger one: its levels are the first levels, hashed tables are repeated, its
networks' matrices are corners of the larger ones, and what is left over is random and
without influence on the result. The image stays the same, and so do the samples; the
cost of a sample is that of the full architecture.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.fields.ngp import GEOMETRY_FEATURES, SH_ORDER, NGPField, NGPLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.io import files

FULL = NGPLayout()
PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class NGPData:
    """An NGP as NumPy arrays, for both sides of the comparison.

    Attributes:
        layout: the architecture.
        lower, upper: (3,) corners of the box, metres.
        tensors: ``table``, ``density_net.I``, ``colour_net.I`` and ``sky``, float32.
        cells: boolean (rx, ry, rz), the occupancy.
        octants: bytes (rx, ry, rz), its octants that are worth a sample.
        step_m, cone: the lattice of samples.
    """

    layout: NGPLayout
    lower: np.ndarray
    upper: np.ndarray
    tensors: dict[str, np.ndarray]
    cells: np.ndarray
    octants: np.ndarray
    step_m: float
    cone: float

    @staticmethod
    def of(field: NGPField) -> NGPData:
        """Copy a field."""
        tensors = field.tensors()
        table = field.parameters()["table"].numpy().copy()
        tensors = {k: v for k, v in tensors.items() if "_net." in k or k == "sky"}
        return NGPData(
            field.layout,
            field.lower,
            field.upper,
            {"table": table, **tensors},
            field.occupancy.cells,
            _octants(field.occupancy),
            field.step_m,
            field.cone,
        )

    def field(self) -> NGPField:
        """Make the field of the active variant."""
        return NGPField(
            self.layout,
            self.lower,
            self.upper,
            tensors=self.tensors,
            occupancy=Occupancy(self.cells, self.octants),
            step_m=self.step_m,
            cone=self.cone,
        )

    def write(self, path: Path) -> None:
        """Write everything to a safetensors file, in single precision."""
        numbers = {
            "layout": np.array(astuple(self.layout)),
            "box": np.array([self.lower, self.upper]),
            "steps": np.array([self.step_m, self.cone]),
            "cells": self.cells.astype(np.uint8),
            "octants": self.octants,
        }
        files.write_safetensors(path, {**self.tensors, **numbers}, {})

    @staticmethod
    def read(path: Path) -> NGPData:
        """Read what :meth:`write` wrote."""
        tensors = files.read_safetensors(path)[0]
        names = ("layout", "box", "steps", "cells", "octants")
        layout, box, steps, cells, octants = (tensors.pop(name) for name in names)
        return NGPData(
            NGPLayout(*map(int, layout)),
            *box,
            tensors=tensors,
            cells=cells.astype(bool),
            octants=octants,
            step_m=float(steps[0]),
            cone=float(steps[1]),
        )


def _octants(occupancy: Occupancy) -> np.ndarray:
    if occupancy.octants is not None:
        return occupancy.octants
    return np.where(occupancy.cells, np.uint8(255), np.uint8(0))


def level_sizes(layout: NGPLayout) -> list[tuple[float, int, int]]:
    """Return scale, vertices along an edge and slots in the table of each level."""
    sizes = []
    for level in range(layout.levels):
        growth = 2.0 ** (level * math.log2(layout.growth))
        scale = growth * layout.base_resolution - 1
        edge = math.ceil(scale) + 1
        features = layout.features
        slots = -(-(edge**3) // features) * features
        sizes.append((scale, edge, min(slots, 2**layout.log2_table)))
    return sizes


def enlarge(data: NGPData, full: NGPLayout = FULL, seed: int = 0) -> NGPData:
    """Copy a field into a larger architecture; its image stays the same.

    Args:
        data: the field.
        full: the architecture. Its finest resolution is replaced by the one that
            makes the field's levels its first ones.
        seed: of what has no influence.
    """
    small = data.layout
    steps = (full.levels - 1) / max(small.levels - 1, 1)
    ratio = small.max_resolution / small.base_resolution
    layout = replace(
        full,
        base_resolution=small.base_resolution,
        max_resolution=round(small.base_resolution * ratio**steps),
    )
    rng = np.random.default_rng(seed)
    tensors = {
        "table": _enlarge_table(data, layout, rng).ravel(),
        "sky": data.tensors["sky"],
    }
    shapes = _matrix_shapes(layout)
    for name, shape in shapes.items():
        tensors[name] = _enlarge_matrix(data.tensors[name], shape, rng)
    return replace(data, layout=layout, tensors=tensors)


def _enlarge_table(
    data: NGPData, layout: NGPLayout, rng: np.random.Generator
) -> np.ndarray:
    small = data.tensors["table"].reshape(-1, layout.features)
    levels, start = [], 0
    old = level_sizes(data.layout)
    for level, (_, edge, slots) in enumerate(level_sizes(layout)):
        if level >= len(old):
            levels.append(rng.uniform(-1e-4, 1e-4, (slots, layout.features)))
            continue
        _, old_edge, old_slots = old[level]
        values = small[start : start + old_slots]
        start += old_slots
        if edge**3 > slots:  # hashed in both: the larger hash modulo the smaller size
            levels.append(values[np.arange(slots) % old_slots])
            continue
        z, y, x = np.unravel_index(np.arange(slots) % edge**3, (edge,) * 3)
        if old_edge**3 <= old_slots:
            x, y, z = (np.minimum(i, old_edge - 1) for i in (x, y, z))
            index = x + old_edge * (y + old_edge * z)
        else:
            x, y, z = (i.astype(np.uint32) for i in (x, y, z))
            one, two, three = (np.uint32(prime) for prime in PRIMES)
            index = (x * one ^ y * two ^ z * three) % np.uint32(old_slots)
        levels.append(values[index])
    return np.concatenate(levels).astype(np.float32)


def _matrix_shapes(layout: NGPLayout) -> dict[str, tuple[int, int]]:
    width, harmonics = layout.width, (SH_ORDER + 1) ** 2
    return {
        "density_net.0": (width, layout.levels * layout.features),
        "density_net.1": (GEOMETRY_FEATURES, width),
        "colour_net.0": (width, GEOMETRY_FEATURES + harmonics),
        "colour_net.1": (width, width),
        "colour_net.2": (3, width),
    }


def _enlarge_matrix(
    small: np.ndarray, shape: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Put a matrix into the corner of a larger one; its rows see nothing else."""
    rows, columns = small.shape
    result = rng.normal(0, 0.1, shape).astype(np.float32)
    result[:rows, columns:] = 0
    result[:rows, :columns] = small
    return result
