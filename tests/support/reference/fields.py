"""Fields whose integrals are known, and a reader of field files of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage
from scipy.special import erf

from mi_nerfattack.fields import AbstractField
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.rays import Rays

WAVES = np.array([[1.0, 0.3, -0.5], [-0.4, 1.2, 0.2], [0.1, -0.6, 0.9]])
PHASES = np.array([0.3, 1.1, 2.5])


class GaussianField(AbstractField):
    """Density ``peak exp(-r^2 / (2 sd^2))``, colour ``0.5 + 0.4 sin(wave x + phase)``.

    The box is [-half, half]^3. What bounds its errors: along any line, the largest
    values of density and its derivatives (`sigma`) and of colour (`colour`).
    """

    kind = "gaussian"

    def __init__(self, peak: float, sd: float, half: float, step_m: float) -> None:
        self.peak, self.sd, self.half = peak, sd, half
        self.lower, self.upper = -half * np.ones(3), half * np.ones(3)
        self.step_m, self.cone = step_m, 0.0
        self.occupy(Occupancy.full())
        self.sigma = peak, peak / sd * np.exp(-0.5), peak / sd**2
        frequency = np.linalg.norm(WAVES, axis=1).max()
        self.colour = 0.9, 0.4 * frequency, 0.4 * frequency**2

    def eval_everywhere(
        self, point: Any, direction: Any, active: Any
    ) -> tuple[Any, Any]:
        squared = dr.squared_norm(mi.Vector3f(point))
        density = self.peak * dr.exp(squared * (-0.5 / self.sd**2))
        rows = [
            dr.sin(dr.dot(mi.Vector3f(*wave), mi.Vector3f(point)) + phase)
            for wave, phase in zip(WAVES.tolist(), PHASES.tolist(), strict=True)
        ]
        return density & active, (0.5 + 0.4 * mi.Color3f(*rows)) & active

    def depth_to(self, o: np.ndarray, d: np.ndarray, near: Any, t: Any) -> np.ndarray:
        """Return the optical depth (n, k) from near (n,) to t (n, k), with erf."""
        middle = -(o * d).sum(1)[:, None]
        squared = (o**2).sum(1)[:, None] - middle**2
        top = self.peak * np.exp(-squared / (2 * self.sd**2))
        width = np.sqrt(2) * self.sd
        part = erf((t - middle) / width) - erf((near[:, None] - middle) / width)
        return top * self.sd * np.sqrt(np.pi / 2) * part


def box_interval(
    o: np.ndarray, d: np.ndarray, pose: Pose, half: float, t_max: Any = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays (n, 3) enter and leave a posed cube, (n,); equal if never."""
    with np.errstate(divide="ignore"):
        o = (o - pose.translation) @ pose.rotation / pose.scale
        d = d @ pose.rotation / pose.scale
        sides = np.sort(np.stack([(-half - o) / d, (half - o) / d]), axis=0)
    near = np.maximum(sides[0].max(1), 0)
    return near, np.maximum(near, np.minimum(sides[1].min(1), t_max))


def quadrature(
    fields: list[tuple[GaussianField, Pose]], o: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate blobs as one medium in float64: radiance, opacity, moment.

    Gauss-Legendre on the parts between the borders of the boxes, with the closed form
    of the transmittance. Poses must not scale or turn (a blob is round).
    """
    spans = [(f, o - p.translation, *box_interval(o, d, p, f.half)) for f, p in fields]
    cuts = np.sort(np.stack([cut for span in spans for cut in span[2:]], 1), axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    radiance, moment = np.zeros((len(o), 3)), np.zeros(len(o))
    for a, b in zip(cuts.T[:-1], cuts.T[1:], strict=True):
        t = 0.5 * (a + b)[:, None] + 0.5 * (b - a)[:, None] * nodes
        tau = np.zeros_like(t)
        density, emission = np.zeros_like(t), np.zeros((*t.shape, 3))
        for field, local, near, far in spans:
            clipped = np.clip(t, near[:, None], far[:, None])
            tau += field.depth_to(local, d, near, clipped)
            x = local[:, None] + t[..., None] * d[:, None]
            inside = (t > near[:, None]) & (t < far[:, None])
            sigma = field.peak * np.exp(-(x**2).sum(-1) / (2 * field.sd**2)) * inside
            density += sigma
            colour = 0.5 + 0.4 * np.sin(x @ WAVES.T + PHASES)
            emission += sigma[..., None] * colour
        transmitted = np.exp(-tau) * weights * 0.5 * (b - a)[:, None]
        radiance += (transmitted[..., None] * emission).sum(1)
        moment += (transmitted * density * t).sum(1)
    ends = [f.depth_to(q, d, near, far[:, None])[:, 0] for f, q, near, far in spans]
    return radiance, -np.expm1(-np.sum(ends, axis=0)), moment


def piecewise(
    layers: list[tuple[np.ndarray, np.ndarray, float, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate homogeneous parts as one medium, in closed form and float64.

    Parts are near (n,), far (n,), density and colour (3,). Returns radiance (n, 3),
    opacity (n,) and moment (n,).
    """
    count = len(layers[0][0])
    radiance, moment, tau = np.zeros((count, 3)), np.zeros(count), np.zeros(count)
    cuts = np.sort(np.stack([cut for layer in layers for cut in layer[:2]]), axis=0)
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        middle = 0.5 * (a + b)
        sigmas = [s * ((n < middle) & (middle < f)) for n, f, s, _ in layers]
        sigma = np.sum(sigmas, axis=0)
        emission = np.transpose(sigmas) @ [layer[3] for layer in layers]
        safe = np.where(sigma > 0, sigma, 1)
        passed, before = np.exp(-sigma * (b - a)), np.exp(-tau)
        radiance += (before * (1 - passed) / safe)[:, None] * emission
        gained = (a + 1 / safe) - (b + 1 / safe) * passed
        moment += np.where(sigma > 0, before * gained, 0)
        tau += sigma * (b - a)
    return radiance, -np.expm1(-tau), moment


def rays_towards(
    middle: np.ndarray, spread: float, count: int = 64
) -> tuple[Rays, np.ndarray, np.ndarray]:
    """Make rays of all directions that pass near a point, half of them from inside."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(count, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    aim = middle + rng.uniform(-spread, spread, (count, 3))
    back = np.where(np.arange(count) % 2, 3.0, 0.3)[:, None]
    o = (aim - back * d).astype(np.float32)
    rays = Rays(mi.Point3f(o.T.copy()), mi.Vector3f(d.T.copy()))
    rays.t_max, rays.jitter = mi.Float(np.inf), mi.Float(0.5)
    dr.make_opaque(rays)
    d64 = d.astype(np.float64)
    return rays, o.astype(np.float64), d64


TYPES = {"F16": "<f2", "F32": "<f4", "U8": "u1", "U32": "<u4"}
PRIMES = np.array([1, 2654435761, 805459861], np.uint64)
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


class FileReader:
    """A field file of any kind in double precision; `cells` are those occupied."""

    def __init__(self, path: str | Path) -> None:
        raw = Path(path).read_bytes()
        start = 8 + int.from_bytes(raw[:8], "little")
        entries = json.loads(raw[8:start])
        self.header: dict[str, str] = entries.pop("__metadata__")
        self.tensors = {}
        for name, entry in entries.items():
            first, last = entry["data_offsets"]
            data = raw[start + first : start + last]
            values = np.frombuffer(data, TYPES[entry["dtype"]])
            self.tensors[name] = values.reshape(entry["shape"])
        self.lower, self.upper = (self._numbers(key) for key in ("lower", "upper"))
        shape = self._numbers("occupancy_shape").astype(int)
        bits = np.unpackbits(self.tensors["occupancy"], count=shape.prod())
        self.cells = bits.reshape(shape).astype(bool)
        self.is_grid = self.header["kind"] == "grid_field"
        self.has_bricks = self.header["kind"] == "brick_field"
        if self.is_grid:
            held = np.concatenate([self._held(*level) for level in self._sizes()])
            for name in ("density", "texture"):
                stored = self.tensors[name]
                self.tensors[name] = np.full((len(held), *stored.shape[1:]), np.nan)
                self.tensors[name][held] = stored

    def density(self, points: np.ndarray) -> np.ndarray:
        unit = (points - self.lower) / (self.upper - self.lower)
        if self.has_bricks:
            low, high = self._numbers("log_density")
            raw = low + self._bytes(unit)[:, 0] / 255 * (high - low)
            return np.exp(raw) * window(self.cells, unit)
        if self.is_grid:
            raw = self._levels(points, self.tensors["density"][:, None]).sum(1)[:, 0]
            scale = float(self.header["density_scale"])
        else:
            raw = self._geometry(points)[:, 0]
            scale = 1 / (self.upper - self.lower).max()
        return scale * np.exp(np.minimum(raw, 15)) * window(self.cells, unit)

    def radiance(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate (n, 3), linear, at points (n, 3) along unit directions (n, 3)."""
        if self.has_bricks:
            unit = (points - self.lower) / (self.upper - self.lower)
            return srgb_to_linear(self._bytes(unit)[:, 1:] / 255)
        if self.is_grid:
            return decode(self._levels(points, self.tensors["texture"]).sum(1))
        inputs = np.hstack([self._geometry(points), harmonics(directions)])
        return decode(self._network("colour_net", inputs))

    def background(self, directions: np.ndarray) -> np.ndarray:
        """Interpolate the sky (n, 3), linear, in unit directions (n, 3)."""
        sky = self.tensors["sky"].astype(float)
        height, width, _ = sky.shape
        x, y, z = directions.T
        column = np.arctan2(y, x) / (2 * np.pi) * width
        row = np.arccos(z) / np.pi * height - 0.5
        u, v = np.floor(column).astype(int), np.floor(row).astype(int)
        total = np.zeros((len(directions), 3))
        for du in (0, 1):
            for dv in (0, 1):
                weight = np.abs(1 - du - (column - u)) * np.abs(1 - dv - (row - v))
                texel = sky[np.clip(v + dv, 0, height - 1), (u + du) % width]
                total += weight[:, None] * texel
        return decode(total)

    def _bytes(self, unit: np.ndarray) -> np.ndarray:
        """Interpolate the bytes (n, 4) of bricks; NaN at points without one."""
        sizes = self.tensors["subdivisions"].astype(int)
        starts = np.cumsum((sizes + 1) ** 3) - (sizes + 1) ** 3
        vertices = self.tensors["vertices"].view(np.uint8).reshape(-1, 4).astype(float)
        number = np.full(self.cells.shape, -1)
        number[self.cells] = np.arange(len(sizes))
        scaled = unit * self.cells.shape
        result = np.full((len(unit), 4), np.nan)
        for i, (place, cell) in enumerate(zip(scaled, scaled.astype(int), strict=True)):
            if (brick := number[tuple(cell)]) < 0:
                continue
            n, start = sizes[brick], starts[brick]
            mine = vertices[start : start + (n + 1) ** 3].reshape(*[n + 1] * 3, 4)
            at = ((place - cell) * n)[:, None]
            for k in range(4):
                result[i, k] = ndimage.map_coordinates(mine[..., k], at, order=1)[0]
        return result

    def _geometry(self, points: np.ndarray) -> np.ndarray:
        table = self.tensors["table"].reshape(-1, int(self.header["features"]))
        features = self._levels(points, table).reshape(len(points), -1)
        return self._network("density_net", features)

    def _network(self, name: str, values: np.ndarray) -> np.ndarray:
        layers = sorted(key for key in self.tensors if key.startswith(f"{name}."))
        for key in layers[:-1]:
            values = np.maximum(values @ self.tensors[key].T.astype(float), 0)
        return values @ self.tensors[layers[-1]].T.astype(float)

    def _levels(self, points: np.ndarray, table: np.ndarray) -> np.ndarray:
        """Interpolate (n, levels, values of a vertex) in a table of all vertices."""
        unit = np.clip((points - self.lower) / (self.upper - self.lower), 0, 1 - 1e-6)
        values, start = [], 0
        for cells, edge, size in self._sizes():
            place = unit * cells
            low = np.floor(place).astype(np.uint64)
            total = np.zeros((len(points), table.shape[1]))
            for corner in CORNERS:
                vertex = low + corner.astype(np.uint64)
                weight = np.abs(1 - corner - (place - low)).prod(1)
                index = start + self._index(vertex, edge, size)
                total += weight[:, None] * table[index]
            values.append(total)
            start += size
        assert start == len(table)
        return np.stack(values, 1)

    def _sizes(self) -> list[tuple[float, int, int]]:
        """Return cells and vertices along an edge, and all vertices, by level."""
        keys = ("levels", "base_resolution", "max_resolution")
        levels, base, largest = (int(self.header[key]) for key in keys)
        growth = (largest / base) ** (1 / (levels - 1)) if levels > 1 else 1.0
        cells = np.exp2(np.arange(levels) * np.log2(growth)) * base - 1
        edges = np.ceil(cells).astype(int) + 1
        return [(c, n, self._size(n)) for c, n in zip(cells, edges, strict=True)]

    def _held(self, cells: float, edge: int, size: int) -> np.ndarray:
        """Tell which vertices of a level the file has (size,)."""
        held = np.zeros((edge, edge, edge), bool)
        shape = np.array(self.cells.shape)
        for cell in np.argwhere(self.cells):
            low = np.floor(cell / shape * cells - 0.001).astype(int)
            high = np.floor((cell + 1) / shape * cells + 0.001).astype(int) + 2
            (x, y, z), (u, v, w) = np.maximum(low, 0), high
            held[z:w, y:v, x:u] = True
        return np.append(held.ravel(), np.zeros(size - edge**3, bool))

    def _size(self, edge: int) -> int:
        """Return the vertices that a level takes in the file."""
        features = 4 if self.is_grid else int(self.header["features"])
        size = -(-(edge**3) // features) * features
        return size if self.is_grid else min(size, 1 << int(self.header["log2_table"]))

    def _index(self, vertex: np.ndarray, edge: int, size: int) -> np.ndarray:
        """Number the vertices (n, 3) of a level."""
        if edge**3 <= size:
            return (vertex * np.array([1, edge, edge**2], np.uint64)).sum(1).astype(int)
        x, y, z = (vertex * PRIMES & np.uint64(0xFFFFFFFF)).T
        return ((x ^ y ^ z) % np.uint64(size)).astype(int)

    def _numbers(self, key: str) -> np.ndarray:
        return np.array([float(word) for word in self.header[key].split()])


def window(cells: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Evaluate the factor of the density (n,) at points (n, 3) of the unit box."""
    halves = np.kron(np.pad(cells, 1), np.ones((2, 2, 2))) > 0
    vertices = ndimage.minimum_filter(halves, 2)[2:-1, 2:-1, 2:-1].astype(float)
    place = np.clip(unit, 0, 1).T * (2 * np.array(cells.shape)[:, None])
    return np.minimum(1, 8 * ndimage.map_coordinates(vertices, place, order=1)) ** 4


def decode(raw: np.ndarray) -> np.ndarray:
    """Turn raw colours into linear ones: the sRGB curve of their sigmoid."""
    return srgb_to_linear(1 / (1 + np.exp(-raw)))


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def harmonics(directions: np.ndarray) -> np.ndarray:
    """Evaluate the real spherical harmonics of degree 0 to 3, (n, 16)."""
    x, y, z = directions.T
    tilt = 0.45704580 - 2.28522900 * z**2
    columns = [
        0.28209479 + 0 * x,
        *(-0.48860251 * y, 0.48860251 * z, -0.48860251 * x),
        *(1.09254843 * x * y, -1.09254843 * y * z),
        0.94617470 * z**2 - 0.31539157,
        *(-1.09254843 * x * z, 0.54627422 * (x**2 - y**2)),
        *(-0.59004359 * y * (3 * x**2 - y**2), 2.89061144 * x * y * z),
        *(tilt * y, z * (1.86588166 * z**2 - 1.11952900), tilt * x),
        *(1.44530572 * z * (x**2 - y**2), -0.59004359 * x * (x**2 - 3 * y**2)),
    ]
    return np.stack(columns, 1)
