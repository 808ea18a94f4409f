"""The peer: the field and the march of this project in PyTorch, in single precision.

Batched throughout: all lattice intervals of a chunk of rays are made at once, those in
empty cells are dropped before anything is evaluated, transmittance is a cumulative
sum. Early termination: the occupied samples of each ray are evaluated in three batches
(the first 8 of every ray, the next 24, the rest), and a ray that has ended is left out
of the batches that follow; colour is evaluated only in front of the end. That is
faster than a density pass over all samples, and than evaluating all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from bench.ngp_data import NGPData
from bench.torch.encoding import HashGrid
from bench.torch.window import TorchWindow

BATCHES = ((0, 8), (8, 32), (32, 1 << 30))  # ranks of samples along a ray


@dataclass
class Samples:
    """Occupied lattice intervals, ray by ray.

    Attributes:
        ray: (n,) int64, ascending.
        rank: (n,) int64, position among the samples of the ray.
        unit: (n, 3), in the unit box.
        width: (n,), metres.
        distance: (n,) from the ray's origin, metres.
    """

    ray: torch.Tensor
    rank: torch.Tensor
    unit: torch.Tensor
    width: torch.Tensor
    distance: torch.Tensor


@dataclass
class Lit:
    """Samples in front of the ends of their rays.

    Attributes:
        ray: (n,) int64, ascending.
        x: (n,) optical depth.
        weight: (n,) of the colour in the ray's radiance.
        colour: (n, 3), linear.
        distance: (n,) from the ray's origin, metres.
    """

    ray: torch.Tensor
    x: torch.Tensor
    weight: torch.Tensor
    colour: torch.Tensor
    distance: torch.Tensor


class TorchNGP:
    """A field at the identity pose, seen along rays.

    Args:
        data: the field.
        stop: transmittance at which a ray ends.

    Attributes:
        parameters: table and matrices by the names of :class:`NGPData`; they collect
            gradients where they are asked to.
        sky: (height, width, 3) raw colours behind the field; likewise.
        batches: ranks of samples that are evaluated together, in order.
        evaluated: samples in front of the end of their rays, counted up.
    """

    def __init__(self, data: NGPData, stop: float) -> None:
        self.grid, self.limit = HashGrid(data.layout), -math.log(stop)
        self.batches: tuple[tuple[int, int], ...] = BATCHES
        table = data.tensors["table"].reshape(self.grid.rows, self.grid.features)
        self.parameters = {"table": _single(table)} | {
            name: _single(value)
            for name, value in data.tensors.items()
            if "_net." in name
        }
        self.sky = _single(data.tensors["sky"])
        self.lower = _single(data.lower)
        self.extent = _single(data.upper) - self.lower
        self.density_scale = 1 / float(np.max(data.upper - data.lower))
        self.occupied = torch.as_tensor(halves(data.octants))
        self.window = TorchWindow(data.cells)
        self.step, self.cone = data.step_m, max(data.cone, 1e-12)
        self.evaluated = 0

    def render(
        self,
        origin: torch.Tensor,
        direction: torch.Tensor,
        jitter: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Render rays over the sky.

        Args:
            origin: (n, 3), metres.
            direction: (n, 3), unit vectors.
            jitter: (n,) in [0, 1), position of the samples in their intervals; the
                middle when left out.

        Returns:
            (n, 3) linear radiance.
        """
        radiance, passed, _ = self.march(origin, direction, jitter)
        return radiance + passed[:, None] * self.background(direction)

    def march(
        self,
        origin: torch.Tensor,
        direction: torch.Tensor,
        jitter: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """March rays, with all that a composite by depth needs.

        Args:
            origin: (n, 3), metres.
            direction: (n, 3), unit vectors.
            jitter: as :meth:`render` takes it.

        Returns:
            premultiplied linear radiance (n, 3), transmittance (n,), and the depth
            times the opacity (n,), metres.
        """
        depth, sums = torch.zeros(len(origin)), torch.zeros(len(origin), 4)
        samples = self.samples(origin, direction, jitter)
        harmonics = spherical_harmonics(direction)
        for ranks in self.batches:
            lit = self._lit(samples, harmonics, depth, ranks)
            if lit is None:
                break
            value = torch.cat([lit.colour, lit.distance[:, None]], 1)
            sums = sums.index_add(0, lit.ray, lit.weight[:, None] * value)
            depth = depth.index_add(0, lit.ray, lit.x)
        return sums[:, :3], torch.exp(-depth), sums[:, 3]

    def _lit(
        self,
        samples: Samples,
        harmonics: torch.Tensor,
        depth: torch.Tensor,
        ranks: tuple[int, int],
    ) -> Lit | None:
        """Evaluate the samples of some ranks, given the optical depth so far."""
        low, high = ranks
        on = (samples.rank >= low) & (samples.rank < high)
        chosen = (on & (depth.detach() < self.limit)[samples.ray]).nonzero()[:, 0]
        if not len(chosen):
            return None
        ray, width = samples.ray[chosen], samples.width[chosen]
        h = self._geometry(samples.unit[chosen])
        density = self.density_scale * torch.exp(h[:, 0].clamp(max=15.0))
        x = density * width * self.window(samples.unit[chosen])
        before = depth[ray] + sum_before(x, ray)
        lit = (before.detach() < self.limit).nonzero()[:, 0]
        ray, x, before = ray[lit], x[lit], before[lit]
        colour = self._colour(h[lit], harmonics[ray])
        self.evaluated += len(lit)
        weight = torch.exp(-before) * -torch.expm1(-x)
        return Lit(
            ray, x, weight, colour=colour, distance=samples.distance[chosen][lit]
        )

    def samples(
        self,
        origin: torch.Tensor,
        direction: torch.Tensor,
        jitter: torch.Tensor | None = None,
    ) -> Samples:
        """Make all lattice intervals of rays and keep those in occupied cells."""
        start_unit = (origin - self.lower) / self.extent
        slope = direction / self.extent
        safe = torch.where(slope.abs() < 1e-12, 1e-12, slope)
        a, b = -start_unit / safe, (1 - start_unit) / safe
        near = torch.minimum(a, b).amax(1).clamp(min=0)
        far = torch.maximum(a, b).amin(1)
        hit = near < far
        near, far = torch.where(hit, near, 0), torch.where(hit, far, 0)
        if not self.window.is_open:
            near = self._lattice(self._lattice_index(near).floor())
            far = self._lattice(self._lattice_index(far).ceil())
        first = int(self._lattice_index(near).floor().min())
        last = int(self._lattice_index(far).ceil().max())
        edges = self._lattice(torch.arange(first, max(last, first) + 1.0))
        start = torch.maximum(edges[:-1], near[:, None])  # (rays, intervals)
        end = torch.minimum(edges[1:], far[:, None])
        t = torch.lerp(start, end, 0.5 if jitter is None else jitter[:, None])
        return occupied_samples(
            self.occupied, (start_unit, slope), t, width=end - start
        )

    def _lattice(self, index: torch.Tensor) -> torch.Tensor:
        """Return the distance of lattice points, metres."""
        bend = 1 / self.cone
        grown = self.step * bend * torch.exp(self.cone * (index.clamp(min=bend) - bend))
        return torch.where(index <= bend, index * self.step, grown)

    def _lattice_index(self, t: torch.Tensor) -> torch.Tensor:
        knee, bend = self.step / self.cone, 1 / self.cone
        grown = bend + torch.log(t.clamp(min=knee) / knee) * bend
        return torch.where(t <= knee, t / self.step, grown)

    def _geometry(self, unit: torch.Tensor) -> torch.Tensor:
        features = self.grid(self.parameters["table"], unit)
        return self._network("density_net", features)

    def _colour(self, h: torch.Tensor, harmonics: torch.Tensor) -> torch.Tensor:
        return decode(self._network("colour_net", torch.cat([h, harmonics], 1)))

    def _network(self, name: str, value: torch.Tensor) -> torch.Tensor:
        matrices = [m for key, m in self.parameters.items() if key.startswith(name)]
        for matrix in matrices[:-1]:
            value = F.relu(F.linear(value, matrix))
        return F.linear(value, matrices[-1])

    def background(self, direction: torch.Tensor) -> torch.Tensor:
        """Return what lies behind the field, (n, 3), linear."""
        height, width = self.sky.shape[:2]
        azimuth = torch.atan2(direction[:, 1], direction[:, 0])
        u = azimuth * (0.5 / math.pi) * width
        v = torch.acos(direction[:, 2].clamp(-1, 1)) / math.pi * height - 0.5
        column, row = u.floor(), v.floor()
        raw = torch.zeros_like(direction)
        for du in (0, 1):
            for dv in (0, 1):
                by_u = u - column if du else 1 - u + column
                by_v = v - row if dv else 1 - v + row
                x = (column.long() + du) % width
                y = (row.long() + dv).clamp(0, height - 1)
                raw += (by_u * by_v)[:, None] * self.sky[y, x]
        return decode(raw)


def occupied_samples(
    cells: torch.Tensor,
    rays: tuple[torch.Tensor, torch.Tensor],
    t: torch.Tensor,
    width: torch.Tensor,
) -> Samples:
    """Keep the intervals of rays in occupied cells.

    Args:
        cells: booleans (rx, ry, rz) of the unit box.
        rays: origins and directions (rays, 3), in units of the box.
        t: (rays, k) distances of the samples, metres.
        width: (rays, k) of the intervals, metres; none where it is not positive.
    """
    start, slope = rays
    cell = torch.zeros(t.shape, dtype=torch.int32)
    for axis, size in enumerate(cells.shape):
        place = start[:, axis, None] + t * slope[:, axis, None]
        cell = cell * size + (place * size).to(torch.int32).clamp_(0, size - 1)
    occupied = cells.reshape(-1).index_select(0, cell.reshape(-1))
    index = (occupied & (width > 0).reshape(-1)).nonzero()[:, 0]
    ray = torch.div(index, max(t.shape[1], 1), rounding_mode="floor")
    t, width = t.reshape(-1)[index], width.reshape(-1)[index]
    unit = (start[ray] + t[:, None] * slope[ray]).clamp_(0.0, 1.0 - 1e-6)
    each = torch.bincount(ray, minlength=len(start))
    rank = torch.arange(len(ray)) - (torch.cumsum(each, 0) - each)[ray]
    return Samples(ray, rank, unit, width, t)


def sum_before(x: torch.Tensor, ray: torch.Tensor) -> torch.Tensor:
    """Sum what lies before each element (n,) of its ray; rays are contiguous."""
    total = torch.cumsum(x, 0, dtype=torch.float64)
    before = total - x
    each = torch.unique_consecutive(ray, return_counts=True)[1]
    first = torch.cumsum(each, 0) - each
    base = torch.repeat_interleave(before[first], each, output_size=len(x))
    return (before - base).to(x.dtype)


def decode(raw: torch.Tensor) -> torch.Tensor:
    """Turn raw colours into linear radiance: the sRGB curve of a sigmoid."""
    value = torch.sigmoid(raw)
    dark = value <= 0.04045
    bright = torch.where(dark, 0.04045, value)
    return torch.where(dark, value / 12.92, ((bright + 0.055) / 1.055) ** 2.4)


def spherical_harmonics(direction: torch.Tensor) -> torch.Tensor:
    """Evaluate the real spherical harmonics up to order 3, (n, 16).

    Source: Sloan 2013, "Efficient Spherical Harmonic Evaluation", appendix A2.
    """
    x, y, z = direction.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    columns = [
        torch.full_like(x, 0.28209479177387814),
        -0.48860251190291987 * y,
        0.48860251190291987 * z,
        -0.48860251190291987 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.9461746957575601 * zz - 0.31539156525252,
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (1 - 5 * zz),
        z * (1.865881662950577 * zz - 1.1195289977703462),
        0.4570457994644658 * x * (1 - 5 * zz),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return torch.stack(columns, 1)


def _single(value: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(np.array(value, np.float32))


def halves(octants: np.ndarray) -> np.ndarray:
    """Return the octants of cells (rx, ry, rz), as bits, as booleans of half cells."""
    rx, ry, rz = octants.shape
    bits = np.unpackbits(octants[..., None], axis=-1, bitorder="little")
    bits = bits.reshape(rx, ry, rz, 2, 2, 2).transpose(0, 3, 1, 4, 2, 5)
    return bits.reshape(2 * rx, 2 * ry, 2 * rz).astype(bool)
