"""Textured triangle meshes: metric placement, the cube, Mitsuba shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.backend.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io.resumable import array_digest, json_digest

#: A cube's faces as seen from outside: outward normal, right and up of the picture.
#: Around -y, the front of a glTF model, they unfold into a cross.
CUBE_FACES: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "px": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "nx": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "py": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "ny": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "pz": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "nz": ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
}


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one material. Only the diffuse colour of materials is kept.

    The reflectance is the product of `colour`, `vertex_colour` and `texture`.

    Args:
        vertices: (n, 3), float64.
        faces: (m, 3), integer.
        colour: (3,), linear reflectance in [0, 1].
        normals: (n, 3), or None for flat shading.
        vertex_colour: (n, 3), linear, or None.
        uv: (n, 2), origin at the bottom left of the texture, or None.
        texture: (h, w, 3 or 4), uint8 sRGB, or None. The fourth channel is opacity.
        wrap: how the texture goes on beyond [0, 1]: "repeat", "mirror" or "clamp".
        opacity: in [0, 1], of parts without texture.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)
    normals: np.ndarray | None = None
    vertex_colour: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None
    wrap: str = "repeat"
    opacity: float = 1.0

    @property
    def is_solid(self) -> bool:
        """Whether nothing shows through."""
        return self.opacity == 1 and (
            self.texture is None or self.texture.shape[2] == 3
        )

    def placed(self, matrix: np.ndarray, offset: np.ndarray) -> MeshPart:
        """Apply an affine map, (3, 3) and (3,).

        A map that mirrors turns the triangles around again; one that is flat drops
        the normals.
        """
        determinant = np.linalg.det(matrix)
        normals = self.normals
        if determinant == 0:
            normals = None
        elif normals is not None:
            normals = normals @ np.linalg.inv(matrix)
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = normals / np.maximum(length, 1e-30)
        return replace(
            self,
            vertices=self.vertices @ matrix.T + offset,
            faces=self.faces[:, ::-1] if determinant < 0 else self.faces,
            normals=normals,
        )


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh of several materials, z up.

    Args:
        name: for messages.
        submeshes: at least one, each with at least one triangle.
    """

    name: str
    submeshes: tuple[MeshPart, ...]

    @property
    def bounds(self) -> np.ndarray:
        """Smallest and largest coordinates, (2, 3)."""
        used = np.concatenate([p.vertices[np.unique(p.faces)] for p in self.submeshes])
        return np.stack([used.min(0), used.max(0)])

    @property
    def digest(self) -> str:
        """SHA-256 of everything but the name."""
        values = [x for submesh in self.submeshes for x in vars(submesh).values()]
        others = [None if isinstance(x, np.ndarray) else repr(x) for x in values]
        arrays = array_digest(x for x in values if isinstance(x, np.ndarray))
        return json_digest([arrays, others])

    @property
    def area(self) -> float:
        """Sum of the areas of all triangles."""
        of = load_extra("trimesh.triangles", "the area of a mesh")
        triangles = [part.vertices[part.faces] for part in self.submeshes]
        return float(of.area(np.concatenate(triangles)).sum())

    def placed(self, matrix: np.ndarray, offset: np.ndarray) -> TexturedMesh:
        """Apply an affine map to all parts; see `MeshPart.placed`."""
        submeshes = (part.placed(matrix, offset) for part in self.submeshes)
        return replace(self, submeshes=tuple(submeshes))

    def transformed(self, scale: float, offset: np.ndarray) -> TexturedMesh:
        """Return the mesh with vertices `scale * (vertices + offset)`."""
        return self.placed(scale * np.eye(3), scale * offset)

    def turned(self, angle_deg: float) -> TexturedMesh:
        """Return the mesh turned about z, counter-clockwise as seen from above."""
        return self.placed(turn_matrix(angle_deg), np.zeros(3))


def cube_mesh(
    edge_m: float, faces: Mapping[str, np.ndarray] | None = None
) -> TexturedMesh:
    """Make a cube, centred in x and y and standing on z = 0.

    Args:
        edge_m: length of the edge in metres, positive.
        faces: pictures (h, w, 3), uint8 sRGB, by the names of `CUBE_FACES`; None
            for a grey cube of reflectance 0.5.
    """
    if not 0 < edge_m < np.inf:
        raise InputError(f"edge_m: {edge_m}; must be positive")
    if faces is not None and set(faces) != set(CUBE_FACES):
        raise InputError(f"faces: {sorted(faces)}; needs {', '.join(CUBE_FACES)}")
    submeshes = []
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    for name, axes in CUBE_FACES.items():
        normal, right, up = (np.array(axis, np.float64) for axis in axes)
        corners = normal + (2 * uv[:, :1] - 1) * right + (2 * uv[:, 1:] - 1) * up
        vertices = 0.5 * edge_m * (corners + [0, 0, 1])
        part = MeshPart(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
        if faces is not None:
            white, texture = (1.0, 1.0, 1.0), faces[name]
            part = replace(part, colour=white, uv=uv, texture=texture, wrap="clamp")
        submeshes.append(part)
    return TexturedMesh("cube", tuple(submeshes))


def normalise(
    mesh: TexturedMesh, height_m: float | None = None, longest_m: float | None = None
) -> TexturedMesh:
    """Scale a mesh to metres, centre it in x and y and stand it on z = 0.

    Args:
        mesh: z up.
        height_m: extent in z afterwards.
        longest_m: longest extent afterwards; not together with `height_m`. With
            neither, the file's unit is taken to be the metre.
    """
    low, high = mesh.bounds
    scale = extent_scale(mesh.name, high - low, height_m, longest_m=longest_m)
    offset = np.array([*(-0.5 * (low + high)[:2]), -low[2]])
    return mesh.transformed(scale, offset)


def extent_scale(
    name: str, extent: np.ndarray, height_m: float | None, longest_m: float | None
) -> float:
    """Return the factor that brings an extent (3,) to a height or a longest edge.

    Raises:
        InputError: with the name, if there is nothing to scale; or a size is not
            positive, or both are given.
    """
    if height_m is not None and longest_m is not None:
        raise InputError("height_m, longest_m: give one of them, not both")
    for key, size_m, present in (
        ("height_m", height_m, float(extent[2])),
        ("longest_m", longest_m, float(extent.max())),
    ):
        if size_m is None:
            continue
        if not 0 < size_m < np.inf:
            raise InputError(f"{key}: {size_m}; must be positive")
        if present <= 0:
            raise InputError(f"{name}: has no height to scale; give its longest edge")
        return size_m / present
    return 1.0


def turn_matrix(angle_deg: float) -> np.ndarray:
    """Return the rotation (3, 3) about z, counter-clockwise as seen from above."""
    if not np.isfinite(angle_deg):
        raise InputError(f"turn_deg: {angle_deg}; must be finite")
    return Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()


def mitsuba_shapes(mesh: TexturedMesh) -> dict[str, Any]:
    """Build Mitsuba meshes with two-sided diffuse materials, by name.

    Textures repeat; a texture's fourth channel becomes a `mask`.
    """
    return {f"part_{i:03d}": _mitsuba_shape(p) for i, p in enumerate(mesh.submeshes)}


def _mitsuba_shape(part: MeshPart) -> Any:
    colour = part.vertex_colour
    if colour is not None and part.texture is None:
        colour = colour * np.array(part.colour)  # a texture holds the part's already
    # Mitsuba's bitmaps have their origin at the top left
    uv = None if part.uv is None else part.uv * [1, -1] + [0, 1]
    arrays = MeshArrays(part.vertices, part.faces, part.normals, uv=uv, colour=colour)
    return make_mesh("part", arrays, mi.load_dict(_material(part)))


def _material(part: MeshPart) -> dict[str, Any]:
    reflectance: Any
    if part.texture is not None:
        texture = _tinted(part.texture[..., :3], part.colour)
        reflectance = _bitmap(texture, False, part.wrap)
        if part.vertex_colour is not None:
            reflectance = _product(reflectance)
    elif part.vertex_colour is not None:
        reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        reflectance = {"type": "rgb", "value": list(part.colour)}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    if part.is_solid:
        return bsdf
    opacity: Any = part.opacity
    if part.texture is not None:
        opacity = _bitmap(np.ascontiguousarray(part.texture[..., 3:]), True, part.wrap)
    return {"type": "mask", "opacity": opacity, "bsdf": bsdf}


def _product(texture: dict[str, Any]) -> Any:
    """Multiply a texture by the colours of the vertices."""

    class Product(mi.Texture):
        def __init__(self) -> None:
            mi.Texture.__init__(self, mi.Properties())
            self.texture = mi.load_dict(texture)
            colours = {"type": "mesh_attribute", "name": "vertex_color"}
            self.colours = mi.load_dict(colours)

        def eval(self, si: Any, active: Any = True) -> Any:
            return self.texture.eval(si, active) * self.colours.eval(si, active)

        def is_spatially_varying(self) -> bool:
            return True

        def to_string(self) -> str:
            return f"Product[{self.texture}, {self.colours}]"

    return Product()


def _tinted(texture: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
    """Multiply an sRGB texture by a linear colour."""
    if colour == (1.0, 1.0, 1.0):
        return np.ascontiguousarray(texture)
    linear = srgb_to_linear_numpy(texture.astype(np.float32) / 255)
    product = linear_to_srgb_numpy(linear * np.array(colour, np.float32))
    return np.round(255 * product).astype(np.uint8)


def _bitmap(image: np.ndarray, raw: bool, wrap: str) -> dict[str, Any]:
    bitmap = mi.Bitmap(image)
    return {"type": "bitmap", "bitmap": bitmap, "raw": raw, "wrap_mode": wrap}
