"""Textured triangle meshes: reading with trimesh, metric placement, Mitsuba shapes."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
#: glTF's axes (y up, facing +z) in ours (z up): x stays, y becomes z, z becomes -y
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_MAX_FILE_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one material. Only the diffuse colour of materials is kept.

    The reflectance is `colour` times `texture` or, without texture, `colour` times
    `vertex_colour`.

    Args:
        vertices: (n, 3), float64.
        faces: (m, 3), integer.
        colour: (3,), linear reflectance in [0, 1].
        normals: (n, 3), or None for flat shading.
        vertex_colour: (n, 3), linear, or None.
        uv: (n, 2), origin at the bottom left of the texture, or None.
        texture: (h, w, 3 or 4), uint8 sRGB, or None. The fourth channel is opacity.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)
    normals: np.ndarray | None = None
    vertex_colour: np.ndarray | None = None
    uv: np.ndarray | None = None
    texture: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh of several materials, z up.

    Args:
        name: for messages.
        parts: at least one, each with at least one triangle.
    """

    name: str
    parts: tuple[MeshPart, ...]

    @property
    def bounds(self) -> np.ndarray:
        """Smallest and largest coordinates, (2, 3)."""
        used = np.concatenate([p.vertices[np.unique(p.faces)] for p in self.parts])
        return np.stack([used.min(0), used.max(0)])

    def transformed(self, scale: float, offset: np.ndarray) -> TexturedMesh:
        """Return the mesh with vertices `scale * (vertices + offset)`."""
        parts = (
            replace(part, vertices=scale * (part.vertices + offset))
            for part in self.parts
        )
        return replace(self, parts=tuple(parts))


def load_mesh(path: str | Path) -> TexturedMesh:
    """Read glTF (.glb, .gltf), OBJ or PLY with its diffuse colours.

    Node transforms are applied. glTF and OBJ are taken as y up, PLY as z up. Colours
    of glTF materials and vertices are linear, those of OBJ and PLY sRGB, textures
    always sRGB. Texture alpha counts where glTF says MASK or BLEND. Metal, gloss,
    emission and transparent colour factors are left out.

    Args:
        path: the mesh; textures lie where it says.

    Raises:
        InputError: unknown suffix, unreadable or damaged file, no triangle, a value
            that is not finite, or a missing texture or material file.
    """
    import trimesh

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown suffix; use {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InputError(f"{path}: does not exist or is not a file; check the path")
    if path.stat().st_size > _MAX_FILE_BYTES:
        raise InputError(f"{path}: larger than {_MAX_FILE_BYTES} bytes; simplify it")
    resolver = _recording_resolver(path)
    with _as_input_error(path, resolver):
        scene = trimesh.load_scene(path, resolver=resolver, process=False)
    if resolver.missing:
        raise InputError(
            f"{path}: refers to the missing file {resolver.missing[0]!r}; put it "
            "beside the mesh or remove the reference"
        )
    turn = np.eye(3) if path.suffix.lower() == ".ply" else _Y_UP_TO_Z_UP
    is_gltf = path.suffix.lower() in (".glb", ".gltf")
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            with _as_input_error(path, resolver):
                part = _read_part(geometry, is_gltf)
            parts.append(
                _placed(part, turn @ transform[:3, :3], turn @ transform[:3, 3])
            )
    if not parts:
        raise InputError(f"{path}: contains no triangle; export a triangle mesh")
    mesh = TexturedMesh(path.name, tuple(parts))
    if not np.all(np.isfinite(mesh.bounds)):
        raise InputError(f"{path}: a vertex is NaN or infinite")
    return mesh


def cube_mesh(edge_m: float) -> TexturedMesh:
    """Make a grey cube, centred in x and y and standing on z = 0.

    Args:
        edge_m: length of the edge in metres, positive.
    """
    import trimesh

    if not 0 < edge_m < np.inf:
        raise InputError(f"edge_m: {edge_m}; must be positive")
    box = trimesh.creation.box((edge_m,) * 3)
    offset = np.array([0, 0, 0.5 * edge_m])
    part = MeshPart(np.array(box.vertices) + offset, np.array(box.faces))
    return TexturedMesh("cube", (part,))


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
    extent = high - low
    if height_m is not None and longest_m is not None:
        raise InputError("height_m, longest_m: give one of them, not both")
    wanted = height_m if longest_m is None else longest_m
    present = extent[2] if longest_m is None else extent.max()
    if wanted is not None and not 0 < wanted < np.inf:
        raise InputError(f"height_m or longest_m: {wanted}; must be positive")
    if present <= 0:
        raise InputError(f"{mesh.name}: has no extent to scale; give a solid mesh")
    offset = np.array([*(-0.5 * (low + high)[:2]), -low[2]])
    return mesh.transformed(1.0 if wanted is None else wanted / present, offset)


def mitsuba_shapes(mesh: TexturedMesh) -> dict[str, Any]:
    """Build Mitsuba meshes with two-sided diffuse materials, by name.

    Textures repeat; a texture's fourth channel becomes a `mask`.
    """
    return {f"part_{i:03d}": _mitsuba_shape(p) for i, p in enumerate(mesh.parts)}


def _recording_resolver(path: Path) -> Any:
    """Make a trimesh resolver that remembers what it did not find."""
    from trimesh.resolvers import FilePathResolver, Resolver

    class RecordingResolver(Resolver):
        def __init__(self, inner: Any) -> None:
            self.inner = inner
            self.missing: list[str] = []

        def get(self, key: str) -> bytes:
            try:
                return self.inner.get(key)
            except (OSError, ValueError):
                self.missing.append(key)
                raise

        def write(self, name: str, data: Any) -> None:
            raise NotImplementedError("a mesh is only read")

        def namespaced(self, namespace: str) -> Any:
            return RecordingResolver(self.inner.namespaced(namespace))

        def keys(self) -> Any:
            return self.inner.keys()

    return RecordingResolver(FilePathResolver(str(path)))


@contextmanager
def _as_input_error(path: Path, resolver: Any) -> Iterator[None]:
    level = logging.getLogger("trimesh").level
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        yield
    # a damaged file makes trimesh raise whatever its parser stumbles over
    except Exception as error:
        if resolver.missing:
            return
        raise InputError(
            f"{path}: cannot be read as {path.suffix.lower()} "
            f"({type(error).__name__}: {error}); export the mesh again"
        ) from error
    finally:
        logging.getLogger("trimesh").setLevel(level)


def _read_part(geometry: Any, is_gltf: bool) -> MeshPart:
    # trimesh computes normals on demand; only those of the file are wanted
    has_normals = "vertex_normals" in geometry._cache
    part = MeshPart(
        np.array(geometry.vertices, np.float64),
        np.array(geometry.faces, np.int64),
        normals=np.array(geometry.vertex_normals) if has_normals else None,
    )
    if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
        raise ValueError(f"a face refers to a vertex beyond {len(part.vertices)}")
    visual = geometry.visual
    if visual.kind == "texture":
        return _with_material(part, visual, is_gltf)
    if visual.kind == "vertex":
        part = replace(part, vertex_colour=_linear(visual.vertex_colors, is_gltf))
        return replace(part, colour=(1.0, 1.0, 1.0))
    if visual.kind == "face":
        flat = part.faces.ravel()
        colours = np.repeat(_linear(visual.face_colors, is_gltf), 3, axis=0)
        return MeshPart(
            part.vertices[flat],
            np.arange(len(flat)).reshape(-1, 3),
            (1.0, 1.0, 1.0),
            None if part.normals is None else part.normals[flat],
            colours,
        )
    return part


def _linear(colour: Any, is_gltf: bool) -> np.ndarray:
    """Decode colours (..., 3 or 4), linear in glTF and sRGB elsewhere, to linear."""
    colour = np.asarray(colour)
    full = np.iinfo(colour.dtype).max if colour.dtype.kind == "u" else 1
    values = colour[..., :3].astype(np.float64) / full
    return values if is_gltf else srgb_to_linear_numpy(values)


def _with_material(part: MeshPart, visual: Any, is_gltf: bool) -> MeshPart:
    from trimesh.visual.material import PBRMaterial

    material = visual.material
    if isinstance(material, PBRMaterial):
        image, factor = material.baseColorTexture, material.baseColorFactor
        keeps_alpha = material.alphaMode in ("MASK", "BLEND")
    else:
        image, factor, keeps_alpha = material.image, material.diffuse, False
    colour = np.ones(3) if factor is None else _linear(factor, is_gltf)
    stored = visual.vertex_attributes.get("color")
    if stored is not None:
        part = replace(part, vertex_colour=_linear(stored, is_gltf))
    if image is not None and visual.uv is not None:
        texture = np.array(image.convert("RGBA" if keeps_alpha else "RGB"))
        if keeps_alpha and texture[..., 3].min() == 255:
            texture = texture[..., :3]
        part = replace(part, uv=np.array(visual.uv), texture=texture)
    return replace(part, colour=(float(colour[0]), float(colour[1]), float(colour[2])))


def _placed(part: MeshPart, matrix: np.ndarray, offset: np.ndarray) -> MeshPart:
    """Apply an affine map; a mirroring one turns the triangles around again."""
    normals = part.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(matrix)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.maximum(length, 1e-30)
    mirrors = np.linalg.det(matrix) < 0
    return replace(
        part,
        vertices=part.vertices @ matrix.T + offset,
        faces=part.faces[:, ::-1] if mirrors else part.faces,
        normals=normals,
    )


def _mitsuba_shape(part: MeshPart) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_material(part))
    properties["face_normals"] = part.normals is None
    mesh = mi.Mesh(
        "part",
        vertex_count=len(part.vertices),
        face_count=len(part.faces),
        has_vertex_normals=part.normals is not None,
        has_vertex_texcoords=part.uv is not None,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.float32(part.vertices.ravel()))
    parameters["faces"] = mi.UInt32(np.uint32(part.faces.ravel()))
    if part.normals is not None:
        parameters["vertex_normals"] = mi.Float(np.float32(part.normals.ravel()))
    if part.uv is not None:
        # Mitsuba's bitmaps have their origin at the top left
        uv = np.float32(part.uv * [1, -1] + [0, 1])
        parameters["vertex_texcoords"] = mi.Float(uv.ravel())
    parameters.update()
    if part.vertex_colour is not None:
        colour = part.vertex_colour * np.array(part.colour)
        mesh.add_attribute("vertex_color", 3, colour.ravel().tolist())
    return mesh


def _material(part: MeshPart) -> dict[str, Any]:
    reflectance: dict[str, Any]
    if part.texture is not None:
        reflectance = _bitmap(_tinted(part.texture[..., :3], part.colour), raw=False)
    elif part.vertex_colour is not None:
        reflectance = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        reflectance = {"type": "rgb", "value": list(part.colour)}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    if part.texture is None or part.texture.shape[2] == 3:
        return bsdf
    opacity = _bitmap(np.ascontiguousarray(part.texture[..., 3:]), raw=True)
    return {"type": "mask", "opacity": opacity, "bsdf": bsdf}


def _tinted(texture: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
    """Multiply an sRGB texture by a linear colour."""
    if colour == (1.0, 1.0, 1.0):
        return np.ascontiguousarray(texture)
    linear = srgb_to_linear_numpy(texture.astype(np.float32) / 255)
    product = linear_to_srgb_numpy(linear * np.array(colour, np.float32))
    return np.round(255 * product).astype(np.uint8)


def _bitmap(image: np.ndarray, raw: bool) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": raw}
