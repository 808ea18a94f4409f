"""The occupancy of a field while it is fitted, from few samples of its density."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.coverage import nearest_points
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.camera.distortion import undistort
from mi_nerfattack.render.camera.intrinsics import Camera

_MIN_OPACITY = 0.01  # of a step; cells that reach less are empty
_FADING = 0.8  # share of the density of a cell that survives a visit
_VISITS = 1 << 16  # cells an update looks at
_BORDER = 0.05  # of the image, beyond which a camera still sees a cell
_CLEAR = 0.8  # of the way to the nearest sparse points is empty
_BACK = 0.15  # of this way: where the pyramid that is empty begins, behind the camera
_COARSE = 2  # cells whose visibility is decided together, along each axis


class RunningOccupancy:
    """Largest densities of the allowed cells, as far as samples tell.

    An update visits some of the cells, half of them drawn from all, half from those
    that are occupied: ``D = max(0.8 D, density at a random point)``. A cell is occupied
    if D reaches the density of a step of opacity 1 %, or the mean of D.

    Args:
        field: whose occupancy is kept.
        allowed: boolean grid over its box.
        seed: of the points.

    Source: Mueller et al. 2022, appendix C.
    """

    def __init__(self, field: AbstractField, allowed: np.ndarray, seed: int) -> None:
        self.field, self.allowed, self.seed = field, allowed, seed
        self.threshold = float(-np.log1p(-_MIN_OPACITY) / field.step_m)
        self._cells = np.stack(np.nonzero(allowed)).astype(np.int32)
        #: (allowed cells,), 1/metre; -1 where no sample has been taken
        self.density = np.full(self._cells.shape[1], -1, np.float32)
        self._occupied = np.arange(0)
        field.occupy(Occupancy(allowed))

    def update(self, step: int) -> None:
        """Visit some cells; every cell once if none has been visited.

        Args:
            step: makes the random numbers differ.
        """
        rng = np.random.default_rng([self.seed, step])
        count = len(self.density)
        fresh = np.nonzero(self.density < 0)[0]
        if len(fresh):
            chosen = fresh
        else:
            chosen = rng.integers(count, size=_VISITS // 2)
            if len(self._occupied):
                some = rng.integers(len(self._occupied), size=_VISITS // 2)
                chosen = np.concatenate([chosen, self._occupied[some]])
        for start in range(0, len(chosen), _VISITS):
            part = chosen[start : start + _VISITS]
            density = self._sample(part, rng)
            self.density[part] = np.maximum(_FADING * self.density[part], density)

    def _sample(self, chosen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        shape = np.array(self.allowed.shape)[:, None]
        lower = np.asarray(self.field.lower)[:, None]
        extent = np.asarray(self.field.upper)[:, None] - lower
        point = self._cells[:, chosen] + rng.random((3, len(chosen)), np.float32)
        # one width, whatever the number of cells, is one kernel
        padded = np.zeros((3, _VISITS), np.float32)
        padded[:, : len(chosen)] = lower + point / shape * extent
        position = mi.Point3f(padded)
        dr.make_opaque(position)
        with dr.suspend_grad():
            density = self.field.density_everywhere(position, mi.Bool(True)).numpy()
        return density[: len(chosen)]

    def install(self) -> None:
        """Give the field its occupancy."""
        known = np.maximum(self.density, 0)
        limit = min(self.threshold, float(known.mean()))
        full = (self.density < 0) | (known >= limit)
        self._occupied = np.nonzero(full)[0]
        cells = np.zeros(self.allowed.shape, bool)
        cells[tuple(self._cells[:, full])] = True
        self.field.occupy(Occupancy(cells))

    def restore(self, density: np.ndarray, bits: np.ndarray) -> None:
        """Continue from a state.

        Args:
            density: as the attribute.
            bits: (bytes,), packed cells of the field's occupancy.

        Raises:
            InputError: the state is that of another grid.
        """
        size = self.allowed.size
        if density.shape != self.density.shape or bits.size != (size + 7) // 8:
            raise InputError("checkpoint: its occupancy is that of another grid")
        self.density = density.astype(np.float32)
        cells = np.unpackbits(bits, count=size).astype(bool)
        cells = cells.reshape(self.allowed.shape)
        self._occupied = np.nonzero(cells[tuple(self._cells)])[0]
        self.field.occupy(Occupancy(cells))


def seen_cells(
    images: PosedImages,
    indices: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    shape: tuple[int, int, int],
    cameras: int = 2,
) -> np.ndarray:
    """Mark the cells of a grid over a box that several cameras look at.

    A fit may give any depth to the part of the scene that a single camera sees, and any
    colour to the part that no camera sees. Density there would only hide the rest of
    the scene from other views. The same holds for cells close to a camera: a fit begins
    with fog there, which vanishes slowly, if at all. Where sparse points show how far
    from a camera the scene begins, the cells in between are not marked.

    Args:
        images: the posed images.
        indices: of the images that count.
        lower: corner of the box, metres.
        upper: opposite corner, metres.
        shape: of the grid.
        cameras: that must see a cell, at most as many as there are.

    Returns:
        boolean `shape`.
    """
    coarse = [max(1, -(-n // _COARSE)) for n in shape]
    axes = [
        low + (np.arange(n) + 0.5) / n * (high - low)
        for n, low, high in zip(coarse, lower, upper, strict=True)
    ]
    grid = np.meshgrid(*axes, indexing="ij")
    points = np.stack(grid, axis=-1).reshape(-1, 3).astype(np.float32)
    radius = 0.5 * float(np.linalg.norm((upper - lower) / coarse))
    count = np.zeros(len(points), np.int32)
    clear = np.ones(len(points), bool)
    for index, near in zip(indices, _nearest(images, indices), strict=True):
        count += _in_view(images, int(index), points, radius=radius)
        eye = images.camera_to_world[index, :3, 3].astype(np.float32)
        before = np.nonzero(((points - eye) ** 2).sum(1) < (_CLEAR * near) ** 2)[0]
        back = _BACK * near
        open_to = _in_view(
            images, int(index), points[before], radius=0.0, border=0.0, back=back
        )
        clear[before[open_to]] = False
    cells = (clear & (count >= min(cameras, len(indices)))).reshape(coarse)
    for axis in range(3):
        cells = np.repeat(cells, _COARSE, axis)
    return np.ascontiguousarray(cells[: shape[0], : shape[1], : shape[2]])


def _nearest(images: PosedImages, indices: np.ndarray) -> np.ndarray:
    """Return how near to each camera sparse points begin, metres; 0 if unknown."""
    if images.points is None:
        return np.zeros(len(indices))
    cameras = [images.camera_of(int(i)) for i in indices]
    return nearest_points(cameras, images.camera_to_world[indices], images.points)


def _in_view(
    images: PosedImages,
    index: int,
    points: np.ndarray,
    radius: float,
    border: float = _BORDER,
    back: float = 0.0,
) -> np.ndarray:
    """Tell which points a camera so far back sees, or balls about touch its pyramid."""
    camera, pose = images.camera_of(index), images.camera_to_world[index]
    offset = points - pose[:3, 3].astype(np.float32)
    x, y, z = (offset @ pose[:3, :3].astype(np.float32)).T
    z = z + np.float32(back)
    if camera.is_fisheye and math.isinf(camera.largest_slope):
        return np.ones(len(points), bool)  # its pyramid is all of space
    left, right, top, bottom = _edges(camera)
    room = 1 + 2 * border
    near = z > -radius
    depth = np.maximum(z, 0)
    return (
        near
        & (x > room * left * depth - 2 * radius)
        & (x < room * right * depth + 2 * radius)
        & (y > room * top * depth - 2 * radius)
        & (y < room * bottom * depth + 2 * radius)
    )


def _edges(camera: Camera) -> tuple[float, float, float, float]:
    """Return the least and largest x, then y, that the image shows at distance 1."""
    across = (np.linspace(0, camera.width, 33) - camera.cx) / camera.fx
    down = (np.linspace(0, camera.height, 33) - camera.cy) / camera.fy
    x, y = np.meshgrid(across, down)
    if camera.is_distorted:
        x, y = undistort(x, y, *camera.distortion)
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())
