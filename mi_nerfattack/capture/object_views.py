"""Views of one object, from a mesh, a cube or a folder, upright and in metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mi_nerfattack.capture.inputs import find_bounds
from mi_nerfattack.capture.mesh.mesh import (
    CUBE_FACES,
    TexturedMesh,
    cube_mesh,
    extent_scale,
    normalise,
    turn_matrix,
)
from mi_nerfattack.capture.mesh.read import load_mesh, up_matrix
from mi_nerfattack.capture.object_renders import render_asset
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.silhouettes import check_alpha, move_views, silhouette_bounds
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.lighting.lights import Lighting


@dataclass(frozen=True, eq=False)
class ObjectViews:
    """The views that an object's grid is fitted to.

    Attributes:
        images: RGBA.
        lower, upper: (3,), box of the object, metres.
        depth: (n, height, width), metres along the ray, infinite where the ray misses
            the object; None where the depth is not known.
    """

    images: PosedImages
    lower: np.ndarray
    upper: np.ndarray
    depth: np.ndarray | None


@dataclass(frozen=True)
class Placement:
    """Size and pose that a source's object is brought to.

    Attributes:
        height_m: extent in z, or None.
        longest_m: longest extent, or None; with neither, the unit is the metre.
        up: axis of the source that points up, or None for the format's own.
        turn_deg: about z, counter-clockwise as seen from above.
    """

    height_m: float | None = None
    longest_m: float | None = None
    up: str | None = None
    turn_deg: float = 0.0

    def mesh(self, path: str | Path) -> TexturedMesh:
        """Read a mesh, upright, in metres, centred in x and y, standing on z = 0."""
        mesh = load_mesh(path, self.up).turned(self.turn_deg)
        return normalise(mesh, self.height_m, self.longest_m)

    def cube(self, edge_m: float, faces: Path | None) -> TexturedMesh:
        """Make a cube; its pictures lie in the folder `faces` as px.png and so on.

        Opacity of the pictures is ignored: a cube is solid.
        """
        pictures = None
        if faces is not None:
            pictures = {
                name: np.ascontiguousarray(
                    files.read_image(faces / f"{name}.png", as_shown=True)[..., :3]
                )
                for name in CUBE_FACES
            }
        return cube_mesh(edge_m, pictures).turned(self.turn_deg)


def render_views(
    mesh: TexturedMesh,
    n_views: int,
    size_px: int,
    seed: int,
    lighting: Lighting,
    progress: Callable[[int, int], None],
) -> ObjectViews:
    """Render a placed mesh; see `render_asset`."""
    images, depth = render_asset(
        mesh, n_views, size_px, seed=seed, lighting=lighting, progress=progress
    )
    lower, upper = mesh.bounds
    return ObjectViews(images, lower, upper, depth=depth)


def read_views(
    folder: str | Path,
    placement: Placement,
    bounds: Sequence[float] | None = None,
    long_edge_px: int | None = None,
    skip_missing: bool = False,
) -> ObjectViews:
    """Read a folder of RGBA images around an object.

    Without `bounds`, the box that the silhouettes leave (see `silhouette_bounds`) is
    what is scaled, centred in x and y and put on z = 0. With them, nothing is moved.

    Args:
        folder: as `read_images` takes it.
        placement: size and pose; `up` is z if None.
        bounds: x0, y0, z0, x1, y1, z1 in the unit of the poses, metres.
        long_edge_px: reduce the images to this longer edge.
        skip_missing: leave out frames without an image file.

    Raises:
        InputError: the folder cannot be read, its images have no alpha, or both
            `bounds` and a placement are given.
    """
    images = read_images(folder, long_edge_px, skip_missing)
    check_alpha(images, str(folder))
    if bounds is not None:
        if placement != Placement():
            raise InputError(
                "--bounds: keeps the folder's frame and unit; leave out --height-m, "
                "--longest-m, --up and --turn-deg"
            )
        return ObjectViews(images, *find_bounds(images, None, bounds), None)
    matrix = turn_matrix(placement.turn_deg) @ up_matrix(placement.up or "z")
    images = move_views(images, matrix, scale=1.0, offset=np.zeros(3))
    lower, upper = silhouette_bounds(images)
    scale = extent_scale(
        str(folder), upper - lower, placement.height_m, longest_m=placement.longest_m
    )
    base = np.array([*(0.5 * (lower + upper)[:2]), lower[2]])
    images = move_views(images, np.eye(3), scale, offset=-scale * base)
    if (placement.height_m, placement.longest_m) != (None, None):
        images = replace(images, unit="metre")
    return ObjectViews(
        images, scale * (lower - base), scale * (upper - base), depth=None
    )
