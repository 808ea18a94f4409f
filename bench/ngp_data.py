"""A field as NumPy arrays, for both sides of a comparison."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.io import files

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
            layout=field.layout,
            lower=field.lower,
            upper=field.upper,
            tensors={"table": table, **tensors},
            cells=field.occupancy.cells,
            octants=_octants(field.occupancy),
            step_m=field.step_m,
            cone=field.cone,
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
