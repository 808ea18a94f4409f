"""Other light on a captured object: factors of its radiance over its box.

A field holds the light that left its surfaces when it was captured. Under another
light, a diffuse surface sends out ``E / E_0`` times this light, where E is the
irradiance under the other light and E_0 the irradiance at capture. The ratio depends on
place and normal, and on the shadows of the object on itself. Therefore it is stored at
the vertices of a lattice over the object's box, one *map* for each light. At the
samples of a march it is interpolated between the vertices.

How a map is made: parallel rays from many sides find the object's surface and its
normals (`expected_surface`). From there, shadow rays go through the object's density to
each direction of a light. A lattice vertex gets the mean of the points around it; a
vertex without points gets the mean of the nearest vertex that has points.

Left out: shadows of other objects and of the scene, light that one part of the object
throws on another, and shades sharper than a cell of the lattice. Where two faces lie in
one cell, both get their mean: see `views` for thin sheets.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import FLAT, AbstractField
from mi_nerfattack.render.lighting.lights import Light, Lighting, Sunlight, dome
from mi_nerfattack.render.lighting.relight import CLEARANCE
from mi_nerfattack.render.lighting.surface import expected_surface, geometry
from mi_nerfattack.render.march import STOP, march
from mi_nerfattack.render.posed import AbstractLightMaps, PosedField
from mi_nerfattack.render.rays import Rays

CELLS = 48  # along the longest edge of the box
_VIEWS = 32  # sides that the surface is looked at from, before those from below
_LOWEST = -0.2  # sine of their angle to the horizon
_OPAQUE = 0.9  # of rays that tell of the surface; those at outlines are left out
_MESHES = (".glb", ".gltf", ".obj", ".ply")
_DARK = 1e-3  # of the light at capture, below which nothing is known


class LightMaps(AbstractLightMaps):
    """Maps of factors of one field's radiance, each for a light.

    They belong to the field's frame: the light turns with an object that moves. Made
    when they are first asked for, and kept.

    Args:
        field: whose density counts as it is when the first map is made.
        captured: light that its radiance was captured in, in the field's frame; None
            for reflectances, which no light has shaded.
        views: (k, 3), from which sides the surface is looked at; by default all. For
            a sheet thinner than a cell, the side that counts.
    """

    def __init__(
        self,
        field: AbstractField,
        captured: Light | None,
        views: np.ndarray | None = None,
    ) -> None:
        self.field = field
        self._captured = captured
        self._views = _from_above() if views is None else views
        self._surface: _Surface | None = None
        self._rows: dict[tuple[Sunlight, bytes], int] = {}
        size = field.upper - field.lower
        #: Vertices of the lattice along x, y and z.
        self.shape: tuple[int, ...] = tuple(
            1 + np.maximum(1, np.ceil(CELLS * size / size.max())).astype(int)
        )
        self._maps: list[np.ndarray] = [np.ones((int(np.prod(self.shape)), 4))]
        #: (4 v,) of each map, red, green, blue and nothing at each vertex; x first.
        self.table: mi.Float = upload(mi.Float, self._maps[0])

    def rows(self, lights: Sequence[Sunlight], rotation: np.ndarray) -> list[int]:
        """Return which maps belong to lights; makes those that are missing.

        Args:
            lights: in the world.
            rotation: (3, 3), of the field in the world.
        """
        keys = [(light, rotation.tobytes()) for light in lights]
        missing = dict.fromkeys(key for key in keys if key not in self._rows)
        for key in missing:
            self._rows[key] = len(self._maps)
            self._maps.append(self._map(key[0].light(rotation)))
        if missing:
            self.table = upload(mi.Float, np.stack(self._maps))
            dr.make_opaque(self.table)
        return [self._rows[key] for key in keys]

    def state(self) -> list[Any]:
        """See :meth:`AbstractLightMaps.state`."""
        return [self.shape, self.table]

    def factor(self, unit: mi.Point3f, row: mi.UInt32, active: mi.Bool) -> mi.Color3f:
        """See :meth:`AbstractLightMaps.factor`; rows are from :meth:`rows`."""
        lower, weights = [], []
        for value, count in zip(unit, self.shape, strict=True):
            place = dr.clip(value, 0, 1) * (count - 1)
            cell = dr.minimum(dr.floor(dr.detach(place)), count - 2)
            lower.append(mi.UInt32(cell))
            weights.append((1 - (place - cell), place - cell))
        (nx, ny, nz), (x, y, z) = self.shape, lower
        first = ((row * nz + z) * ny + y) * nx + x
        total = mi.Vector4f(0)
        for i, j, k in product((0, 1), repeat=3):
            weight = weights[0][i] * weights[1][j] * weights[2][k]
            index = first + ((k * ny + j) * nx + i)
            total += weight * dr.gather(mi.Vector4f, self.table, index, active)
        return mi.Color3f(total.x, total.y, total.z)

    def _map(self, light: Light) -> np.ndarray:
        """Return the factors under a light, (v, 4)."""
        if self._surface is None:
            self._surface = _Surface(self.field, self._views, self.shape)
        surface = self._surface
        before = surface.spread(surface.irradiance(self._captured))
        known = surface.known & (before.min(1) > _DARK)
        now = surface.spread(surface.irradiance(light))
        factors = now / np.where(known, before.T, 1).T
        padded = np.ones((len(factors), 4), np.float32)
        padded[:, :3] = factors[_nearest(known, self.shape)]
        return padded


def light_maps(field: AbstractField) -> LightMaps:
    """Return maps that count from the light of which a field's header knows.

    This is the light of `asset`'s renders. Flat objects show reflectances, at one side.
    Of others nothing is known, so that their radiance counts as reflectance, and the
    shading that it has stays in.
    """
    info: dict[str, str] = getattr(field, "info", {})
    if (kind := info.get(FLAT)) is not None:
        side = [0.0, -1.0, 0.0] if kind == "billboard" else [0.0, 0.0, 1.0]
        return LightMaps(field, None, np.array([side]))
    source = info.get("fit.source", "")
    # files of earlier versions do not name the light, which was the default
    rendered = source == "cube" or source.lower().endswith(_MESHES)
    if "fit.ambient" in info or rendered:
        ambient = float(info.get("fit.ambient", Lighting().ambient))
        return LightMaps(field, Lighting(ambient).light())
    return LightMaps(field, None)


def _from_above() -> np.ndarray:
    """Return sides (k, 3): objects that stand on something were not seen from below."""
    towards = dome(_VIEWS)
    return towards[towards[:, 2] > _LOWEST]


class _Surface:
    """Points of a field's surface, and the lattice vertices around them.

    Args:
        source: field whose density counts.
        views: (k, 3), sides from which it is looked at.
        counts: vertices of the lattice along x, y and z.
    """

    def __init__(
        self, source: AbstractField, views: np.ndarray, counts: tuple[int, ...]
    ) -> None:
        self._shape = shape = geometry(PosedField(source))
        lower, upper = source.lower, source.upper
        cells = np.array(counts) - 1
        edge = float(((upper - lower) / cells).max())
        samples = [_look(shape, view, edge) for view in views]
        point, normal = (np.concatenate(part) for part in zip(*samples, strict=True))
        if not len(point):
            raise InputError(
                f"sun: the {source.kind} is nowhere opaque, so that it has no surface "
                "to light; remove [attack.vary.sun]"
            )
        # One mean of each cell and side of the surface, whose normals are noisy
        place = ((point - lower) / (upper - lower) * cells).clip(0, cells - 1e-6)
        axis = np.abs(normal).argmax(1)
        is_upper = np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0
        key = np.ravel_multi_index(
            [*place.astype(int).T, axis, is_upper], (*cells, 3, 2)
        )
        _, inverse, number = np.unique(key, return_inverse=True, return_counts=True)
        self._point = _sums(inverse, point, len(number)) / number[:, None]
        normal = _sums(inverse, normal, len(number))
        self._normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self._corners = _corners(
            ((self._point - lower) / (upper - lower) * cells).clip(0, cells - 1e-6),
            counts,
        )
        self._clearance = CLEARANCE * source.step_m
        self._got: dict[bytes, np.ndarray] = {}  # by direction
        self._count = int(np.prod(counts))
        #: (v,), vertices that a point lies beside.
        self._weight = self._spread(np.ones((len(number), 1)))[:, 0]
        self.known: np.ndarray = self._weight > 0

    def irradiance(self, light: Light | None) -> np.ndarray:
        """Return what points get, over pi, (n, 3); 1 without a light."""
        if light is None:
            return np.ones_like(self._point)
        total = np.zeros_like(self._point)
        for towards, strength in zip(light.towards, light.strength, strict=True):
            key = towards.tobytes()
            if key not in self._got:
                self._got[key] = self._cosine(towards)
            total += self._got[key][:, None] * strength
        return total

    def _cosine(self, towards: np.ndarray) -> np.ndarray:
        """Return what points get of a light of strength 1 from a direction, (n,)."""
        cosine = self._normal @ towards
        result = np.zeros(len(cosine), np.float32)
        (facing,) = np.nonzero(cosine > 0)
        if not len(facing):
            return result
        start = self._point[facing] + self._clearance * self._normal[facing]
        rays = Rays(_point(start), mi.Vector3f(*map(float, towards)))
        dr.make_opaque(rays)
        passed = 1 - march(self._shape, rays, STOP).opacity.numpy()
        result[facing] = cosine[facing] * passed
        return result

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return the means (v, c) around vertices of the points' values (n, c)."""
        return self._spread(values) / np.where(self.known, self._weight, 1)[:, None]

    def _spread(self, values: np.ndarray) -> np.ndarray:
        return sum(
            (_sums(at, w[:, None] * values, self._count) for at, w in self._corners),
            np.zeros((self._count, values.shape[1])),
        )


def _look(
    shape: PosedField, view: np.ndarray, edge: float
) -> tuple[np.ndarray, np.ndarray]:
    """Find points (n, 3) and normals (n, 3) by parallel rays from one side.

    Args:
        shape: a `geometry` in its own frame.
        view: (3,), unit vector towards the side.
        edge: distance of the rays, metres.
    """
    lower, upper = shape.field.lower, shape.field.upper
    middle, reach = (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2
    other = np.eye(3)[np.abs(view).argmin()]
    right = np.cross(other, view) / np.linalg.norm(np.cross(other, view))
    up = np.cross(view, right)
    ticks = np.arange(-reach, reach, edge) + edge / 2
    a, b = (grid.ravel()[:, None] for grid in np.meshgrid(ticks, ticks))
    origin = middle + reach * view + a * right + b * up
    rays = Rays(_point(origin), mi.Vector3f(*map(float, -view)))
    dr.make_opaque(rays)
    opacity = march(shape, rays, STOP).opacity.numpy()
    surface = expected_surface(shape, rays, STOP)
    opaque = opacity > _OPAQUE
    return surface.point.numpy().T[opaque], surface.normal.numpy().T[opaque]


def _point(values: np.ndarray) -> mi.Point3f:
    return mi.Point3f(*(upload(mi.Float, np.ascontiguousarray(x)) for x in values.T))


def _sums(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Add up rows (n, c) of the same index (n,): (count, c)."""
    columns = [np.bincount(index, column, count) for column in values.T]
    return np.stack(columns, axis=1)


def _corners(
    place: np.ndarray, counts: tuple[int, ...]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the eight vertices (n,) around places (n, 3), and their weights (n,)."""
    cell = place.astype(int)
    inside = place - cell
    nx, ny, _ = counts
    corners = []
    for corner in product((0, 1), repeat=3):
        x, y, z = (cell + corner).T
        weight = np.where(corner, inside, 1 - inside).prod(1)
        corners.append(((z * ny + y) * nx + x, weight))
    return corners


def _nearest(known: np.ndarray, counts: tuple[int, ...]) -> np.ndarray:
    """Return the nearest known vertex (v,) of each vertex; itself where none is."""
    order = np.arange(len(known))
    if not known.any():
        return order
    from scipy import ndimage  # slow to import

    grid = ~known.reshape(counts[::-1])
    nearest: Any = ndimage.distance_transform_edt(
        grid, return_distances=False, return_indices=True
    )
    return np.ravel_multi_index(list(nearest), grid.shape).ravel()
