"""The attacked object in PyTorch: a multi-resolution grid without decoder, marched.

Densities are constants of an attack. So the weights of all samples are found without
tape, and the tape holds colours alone, of the samples in front of the end of their ray:
rows and weights of the vertices around them, and what the sigmoid and the curve need.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from bench.ngp_data import level_sizes
from bench.torch.ngp import BATCHES, Samples, decode, occupied_samples, sum_before
from bench.torch.window import TorchWindow
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.ngp import NGPLayout
from mi_nerfattack.io import files
from mi_nerfattack.render.posed import PosedField


@dataclass(frozen=True)
class ObjectData:
    """A grid field at a pose as NumPy arrays.

    Attributes:
        levels: number, and vertices along an edge of the coarsest and of the finest.
        box: (2, 3) corners, metres of the field's frame.
        to_world: (3, 5): rotation, translation, and the scale three times.
        density: (n_vertices,) raw.
        texture: (n_vertices, 3) raw.
        cells: (rx, ry, rz) uint8, the occupancy.
        numbers: density scale and step, of the field's frame.
    """

    levels: np.ndarray
    box: np.ndarray
    to_world: np.ndarray
    density: np.ndarray
    texture: np.ndarray
    cells: np.ndarray
    numbers: np.ndarray

    @staticmethod
    def of(posed: PosedField) -> ObjectData:
        """Copy a posed grid field."""
        field, pose = posed.field, posed.pose
        assert isinstance(field, GridField)
        layout = field.layout
        edges = (layout.levels, layout.base_resolution, layout.max_resolution)
        columns = (pose.rotation, pose.translation, np.full(3, pose.scale))
        values = field.parameters()
        return ObjectData(
            levels=np.array(edges),
            box=np.array([field.lower, field.upper]),
            to_world=np.column_stack(columns),
            density=values["density"].numpy().copy(),
            texture=values["texture"].numpy().copy(),
            cells=field.occupancy.cells.astype(np.uint8),
            numbers=np.array([field.density_scale, field.step_m]),
        )

    def write(self, path: Path) -> None:
        """Write all to a safetensors file."""
        files.write_safetensors(path, dict(vars(self)), {})

    @staticmethod
    def read(path: Path) -> ObjectData:
        """Read what :meth:`write` wrote."""
        return ObjectData(**files.read_safetensors(path)[0])


@dataclass
class ObjectView:
    """What some rays show of the object.

    Attributes:
        ray: (k,) int64, the rays that meet it, ascending.
        radiance: (k, 3) premultiplied, linear; differentiable by the texture.
        passed: (k,) transmittance.
        moment: (k,) depth times opacity, metres.
    """

    ray: torch.Tensor
    radiance: torch.Tensor
    passed: torch.Tensor
    moment: torch.Tensor


def lookup(
    table: torch.Tensor, row: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Sum over all levels of a grid, interpolated from rows of a table.

    On a GPU, `index_select` and a product of matrices are faster than a bag, which is
    faster on a CPU.

    Args:
        table: (rows, k); the derivative by it is dense.
        row: (n, 8 levels) int32.
        weight: (n, 8 levels).

    Returns:
        (n, k).
    """
    if table.device.type == "cpu":
        return F.embedding_bag(row, table, mode="sum", per_sample_weights=weight)
    values = table.index_select(0, row.reshape(-1)).view(*row.shape, table.shape[1])
    return torch.bmm(weight[:, None], values)[:, 0]


class TorchObject:
    """An object seen along rays.

    Args:
        data: the object.
        stop: transmittance at which a ray ends.

    Attributes:
        texture: (n_vertices, 3) raw colours; collects gradients if asked to.
        evaluated: samples in front of the end of their rays, counted up.
    """

    def __init__(self, data: ObjectData, stop: float) -> None:
        levels, base, largest = map(int, data.levels)
        sizes = level_sizes(
            NGPLayout(
                levels=levels,
                features=4,
                log2_table=24,
                base_resolution=base,
                max_resolution=largest,
            )
        )
        slots = np.array([size for _, _, size in sizes])
        self.scale = torch.tensor([scale for scale, _, _ in sizes])
        self.factors = torch.tensor(
            [(1, edge, edge * edge) for _, edge, _ in sizes], dtype=torch.int32
        )
        self.first = torch.tensor(np.cumsum(slots) - slots, dtype=torch.int32)
        self.limit = -math.log(stop)
        self.density = torch.tensor(data.density)[:, None]
        self.texture = torch.tensor(data.texture)
        self.rotation = torch.tensor(data.to_world[:, :3], dtype=torch.float32)
        self.origin = torch.tensor(data.to_world[:, 3], dtype=torch.float32)
        self.size = float(data.to_world[0, 4])
        self.lower, upper = torch.tensor(data.box, dtype=torch.float32)
        self.extent = upper - self.lower
        self.cells = torch.tensor(data.cells).bool()
        self.window = TorchWindow(data.cells.astype(bool))
        self.density_scale = float(data.numbers[0]) / self.size
        self.step = float(data.numbers[1]) * self.size
        self.evaluated = 0

    def see(self, origin: torch.Tensor, direction: torch.Tensor) -> ObjectView:
        """March the rays that meet the object; tapes derivatives by the texture.

        Args:
            origin: (n, 3), metres.
            direction: (n, 3), unit vectors.
        """
        with torch.no_grad():
            lit = self._lit(origin, direction)
        colour = decode(lookup(self.texture, lit.row, lit.corner))
        radiance = torch.zeros(len(lit.met), 3)
        radiance = radiance.index_add(0, lit.ray, lit.weight[:, None] * colour)
        return ObjectView(lit.met, radiance, torch.exp(-lit.depth), moment=lit.moment)

    def _lit(self, origin: torch.Tensor, direction: torch.Tensor) -> _Lit:
        """Find the samples in front of the ends of their rays, and their weights."""
        met, samples = self._samples(origin, direction)
        depth, moment = torch.zeros(len(met)), torch.zeros(len(met))
        batches = []
        for low, high in BATCHES:
            on = (samples.rank >= low) & (samples.rank < high)
            chosen = (on & (depth < self.limit)[samples.ray]).nonzero()[:, 0]
            if not len(chosen):
                break
            ray = samples.ray[chosen]
            row, corner = self._corners(samples.unit[chosen])
            raw = lookup(self.density, row, corner)[:, 0]
            x = self.density_scale * torch.exp(raw.clamp(max=15.0))
            x = x * samples.width[chosen] * self.window(samples.unit[chosen])
            before = depth[ray] + sum_before(x, ray)
            lit = (before < self.limit).nonzero()[:, 0]
            ray, x, before = ray[lit], x[lit], before[lit]
            weight = torch.exp(-before) * -torch.expm1(-x)
            depth.index_add_(0, ray, x)
            moment.index_add_(0, ray, weight * samples.distance[chosen][lit])
            batches.append((ray, row[lit], corner[lit], weight))
        if not batches:
            empty = torch.zeros(0, 8 * len(self.scale))
            none = torch.zeros(0, dtype=torch.int64)
            batches = [(none, empty.int(), empty, torch.zeros(0))]
        ray, row, corner, weight = (
            torch.cat(some) for some in zip(*batches, strict=True)
        )
        self.evaluated += len(ray)
        return _Lit(met, depth, moment, ray=ray, row=row, corner=corner, weight=weight)

    def _samples(
        self, origin: torch.Tensor, direction: torch.Tensor
    ) -> tuple[torch.Tensor, Samples]:
        """Return the rays that meet occupied cells (k,), and their samples."""
        turned = self.rotation / (self.size * self.extent)  # columns: to the unit box
        start = (origin - self.origin) @ turned - self.lower / self.extent
        slope = direction @ turned
        safe = torch.where(slope.abs() < 1e-12, 1e-12, slope)
        a, b = -start / safe, (1 - start) / safe
        near = torch.minimum(a, b).amax(1).clamp(min=0)
        far = torch.maximum(a, b).amin(1)
        through = (near < far).nonzero()[:, 0]
        start, slope, near, far = (x[through] for x in (start, slope, near, far))
        first = (near / self.step).floor()
        count = (far / self.step).ceil() - first
        index = first[:, None] + torch.arange(float(count.max()) if len(count) else 0.0)
        if not self.window.is_open:
            near, far = self.step * first, self.step * (first + count)
        begin = torch.maximum(index * self.step, near[:, None])
        end = torch.minimum((index + 1) * self.step, far[:, None])
        rays, t = (start, slope), 0.5 * (begin + end)
        samples = occupied_samples(self.cells, rays, t, width=end - begin)
        met, samples.ray = torch.unique_consecutive(samples.ray, return_inverse=True)
        return through[met], samples

    def _corners(self, unit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of the table and weights, each (n, 8 levels)."""
        place = unit[:, None] * self.scale[:, None]  # (n, levels, 3)
        low = place.floor()
        part = place - low
        key = low.to(torch.int32) * self.factors
        x, y, z = (torch.stack([k, k + f], -1) for k, f in self._axes(key))
        u, v, w = (torch.stack([1 - p, p], -1) for p in part.unbind(-1))
        row = z[..., None, None] + y[..., None, :, None] + x[..., None, None, :]
        row += self.first[:, None, None, None]
        weight = w[..., None, None] * v[..., None, :, None] * u[..., None, None, :]
        return row.reshape(len(unit), -1), weight.reshape(len(unit), -1)

    def _axes(self, key: torch.Tensor) -> zip[tuple[torch.Tensor, torch.Tensor]]:
        return zip(key.unbind(-1), self.factors.unbind(-1), strict=True)


@dataclass
class _Lit:
    """Samples in front of the ends of k rays; `ray` (n,) counts these.

    Attributes:
        met: (k,) int64, the rays.
        depth: (k,) optical depth.
        moment: (k,), metres.
        ray: (n,) int64 into `met`.
        row: (n, 8 levels) int32.
        corner: (n, 8 levels), weights of the rows.
        weight: (n,) of the sample in its ray.
    """

    met: torch.Tensor
    depth: torch.Tensor
    moment: torch.Tensor
    ray: torch.Tensor
    row: torch.Tensor
    corner: torch.Tensor
    weight: torch.Tensor
