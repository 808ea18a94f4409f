"""Read textured triangle meshes from glTF, OBJ and PLY files, with trimesh."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from PIL import Image

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.gltf import MAX_BYTES, BaseColour, prepare
from mi_nerfattack.capture.mesh.mesh import MeshPart, TexturedMesh
from mi_nerfattack.capture.mesh.texture import flat_texture, laid_out
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
_FARTHEST = 1e12
#: Farther from the origin, single precision moves vertices by 1/1000 of the mesh.
_EXTENTS = 1e4
#: Rotations that bring an axis of a file to z; "y" keeps x and makes +z our -y.
_TO_Z_UP = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}


def load_mesh(path: str | Path, up: str | None = None) -> TexturedMesh:
    """Read glTF (.glb, .gltf), OBJ or PLY with its diffuse colours.

    Node transforms are applied, and meshes with a skin or instances lie where their
    joints or instances put them, without animation. Colours of glTF materials and
    vertices are linear, colours of OBJ and PLY are sRGB, and textures are always sRGB.
    Where glTF says MASK or BLEND, the opacity of material and texture counts, but the
    opacity of vertices does not. Metal, gloss and emission are ignored.

    Args:
        path: the mesh; textures lie where it says, in its folder or below.
        up: the file's axis that points up, "x", "y", "z", "-x", "-y" or "-z"; None
            for y in glTF and OBJ, z in PLY.

    Raises:
        InputError: the file is missing, unreadable or damaged, or has an unknown
            suffix. Also where no triangle has an area, a value is not finite, the
            mesh uses a feature that is not supported, or a texture, buffer or
            material file is missing.
    """
    trimesh = load_extra("trimesh", f"{path}: a mesh")
    path = Path(path)
    suffix = path.suffix.lower()
    with files.reported(path):
        path.stat()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown suffix; use {', '.join(SUFFIXES)}")
    turn = up_matrix(up or ("z" if suffix == ".ply" else "y"))
    base_colours: tuple[BaseColour, ...] = ()
    coloured: frozenset[str] = frozenset()
    chunks: dict[str, bytes] = {}
    resolver = _recording_resolver(path, chunks)
    if suffix in (".glb", ".gltf"):
        try:
            prepared = prepare(path, chunks, resolver.get)
        except FileNotFoundError:
            _refuse_missing(path, resolver)
            raise
        data, kind, base_colours = prepared.data, "gltf", prepared.base_colours
    else:
        data, kind = files.read_bytes(path, MAX_BYTES), suffix[1:]
    if kind == "obj":
        data = _as_utf8(data)
        coloured = _check_materials(path, data, resolver)
    with _as_input_error(path, resolver):
        scene = trimesh.load_scene(
            io.BytesIO(data), file_type=kind, resolver=resolver, process=False
        )
    _refuse_missing(path, resolver)
    submeshes = []
    with _as_input_error(path, resolver):
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            geometry = scene.geometry[name]
            if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
                part = _read_part(geometry, base_colours, coloured)
                matrix, offset = turn @ transform[:3, :3], turn @ transform[:3, 3]
                submeshes.append(part.placed(matrix, offset))
    return _checked(path, tuple(submeshes))


def up_matrix(axis: str) -> np.ndarray:
    """Return the rotation (3, 3) that brings an axis to z.

    Args:
        axis: "x", "y", "z", "-x", "-y" or "-z". For y, x stays and z becomes -y.
    """
    if axis not in _TO_Z_UP:
        raise InputError(f"up: {axis!r}; allowed: {', '.join(_TO_Z_UP)}")
    return np.array(_TO_Z_UP[axis], np.float64)


def _checked(path: Path, submeshes: tuple[MeshPart, ...]) -> TexturedMesh:
    if not submeshes:
        raise InputError(f"{path}: contains no triangle; export a triangle mesh")
    mesh = TexturedMesh(path.name, submeshes)
    if not np.all(np.abs(mesh.bounds) < _FARTHEST):  # also where it is NaN
        raise InputError(f"{path}: a vertex is NaN, infinite or beyond {_FARTHEST:g}")
    require_near(path, mesh.bounds, _EXTENTS)  # of any unit: it is scaled and centred
    if mesh.area <= 0:
        raise InputError(
            f"{path}: all its triangles are degenerate (without area); export a "
            "solid mesh"
        )
    return mesh


def _recording_resolver(path: Path, chunks: Mapping[str, bytes]) -> Any:
    """Make a trimesh resolver that remembers what it did not find.

    It finds `chunks` by name, and files in the folder of `path` and below. Images of
    OBJ and PLY that cannot be read are remembered too.
    """
    resolvers = load_extra("trimesh.resolvers", f"{path}: a mesh")
    Resolver: Any = resolvers.Resolver
    folder = resolvers.FilePathResolver(str(path))

    class RecordingResolver(Resolver):
        def __init__(self) -> None:
            self.missing: list[str] = []
            self.damaged: list[str] = []

        def get(self, key: str) -> bytes:
            if key in chunks:
                return chunks[key]
            name = key.strip().replace("\\", "/")
            for candidate in (name, unquote(name), name.rpartition("/")[2]):
                try:
                    file_path = folder.absolute(candidate)
                except ValueError:  # outside of the folder
                    continue
                if os.path.isfile(file_path):
                    data = files.read_bytes(file_path, MAX_BYTES)
                    if file_path.suffix.lower() == ".mtl":
                        return _as_utf8(data)
                    if path.suffix.lower() in (".obj", ".ply"):
                        self._check_image(key, data)
                    return data
            self.missing.append(key)
            raise FileNotFoundError(key)

        def _check_image(self, key: str, data: bytes) -> None:
            """Remember images that trimesh would pass over in silence."""
            try:
                Image.open(io.BytesIO(data)).close()
            except (OSError, ValueError, Image.DecompressionBombError):
                self.damaged.append(key)

        def write(self, name: str, data: Any) -> None:
            raise NotImplementedError("a mesh is only read")

        def namespaced(self, namespace: str) -> Any:
            raise NotImplementedError("files lie beside the mesh")

        def keys(self) -> Any:
            return folder.keys()

    return RecordingResolver()


def _as_utf8(data: bytes) -> bytes:
    """Encode text of OBJ as UTF-8; the format names no encoding, so Latin-1 else."""
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode("utf-8")
    return data


def _refuse_missing(path: Path, resolver: Any) -> None:
    if resolver.missing:
        raise InputError(
            f"{path}: refers to the missing file {resolver.missing[0]!r}; put it "
            "beside the mesh or remove the reference"
        )
    if resolver.damaged:
        raise InputError(
            f"{path}: its texture {resolver.damaged[0]!r} cannot be read as an image; "
            "use PNG or JPEG"
        )


@contextmanager
def _as_input_error(path: Path, resolver: Any) -> Iterator[None]:
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    # a damaged file makes trimesh raise whatever its parser stumbles over
    except Exception as error:
        _refuse_missing(path, resolver)
        raise InputError(
            f"{path}: cannot be read as {path.suffix.lower()} "
            f"({type(error).__name__}: {error}); export the mesh again"
        ) from error
    finally:
        logger.setLevel(level)


def _check_materials(path: Path, data: bytes, resolver: Any) -> frozenset[str]:
    """Check that an OBJ's material library is there and defines what is used.

    Returns:
        names of the materials with a colour (Kd).
    """
    lines = data.decode("utf-8", "replace").splitlines()
    words = [line.split(None, 1) for line in lines if line[:3] in ("mtl", "use")]
    named = [(word[0], word[1].strip()) for word in words if len(word) == 2]
    libraries = sorted({name for key, name in named if key == "mtllib"})
    used = {name for key, name in named if key == "usemtl"}
    if len(libraries) > 1:
        raise InputError(
            f"{path}: names several material libraries ({', '.join(libraries)}); "
            "merge them into one"
        )
    defined: set[str] = set()
    coloured: set[str] = set()
    if libraries:
        try:
            text = resolver.get(libraries[0]).decode("utf-8", "replace")
        except FileNotFoundError:
            _refuse_missing(path, resolver)
        else:
            name = ""
            for row in filter(None, (line.split() for line in text.splitlines())):
                if row[0].lower() == "newmtl":
                    name = " ".join(row[1:])
                    defined.add(name)
                elif row[0].lower() == "kd":
                    coloured.add(name)
    unknown = sorted(used - defined)
    if unknown:
        where = libraries[0] if libraries else "any library (it names none)"
        raise InputError(
            f"{path}: usemtl {unknown[0]!r} is not defined in {where}; add the "
            "material, or remove the usemtl lines for a grey object"
        )
    return frozenset(coloured)


def _read_part(
    geometry: Any, base_colours: tuple[BaseColour, ...], coloured: frozenset[str]
) -> MeshPart:
    # trimesh computes normals on demand; only those of the file are wanted, and its
    # cache alone tells which they are (its own glTF exporter asks there too)
    has_normals = "vertex_normals" in geometry._cache
    part = MeshPart(
        np.array(geometry.vertices, np.float64),
        np.array(geometry.faces, np.int64),
        normals=np.array(geometry.vertex_normals) if has_normals else None,
    )
    if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
        raise InputError(f"a face refers to a vertex beyond {len(part.vertices)}")
    visual = geometry.visual
    if base_colours:
        return _with_base_colour(part, visual, base_colours[int(visual.material.name)])
    if visual.kind == "texture":
        return _with_simple_material(part, visual, coloured)
    if visual.kind == "vertex":
        colours = srgb_to_linear_numpy(_unit(visual.vertex_colors))[:, :3]
        return replace(part, vertex_colour=colours, colour=(1.0, 1.0, 1.0))
    if visual.kind == "face":
        flat = part.faces.ravel()
        colours = srgb_to_linear_numpy(_unit(visual.face_colors))[:, :3]
        return MeshPart(
            part.vertices[flat],
            np.arange(len(flat)).reshape(-1, 3),
            (1.0, 1.0, 1.0),
            normals=None if part.normals is None else part.normals[flat],
            vertex_colour=np.repeat(colours, 3, axis=0),
        )
    return part


def _unit(colour: Any) -> np.ndarray:
    """Bring stored colours to [0, 1], float64."""
    colour = np.asarray(colour)
    full = np.iinfo(colour.dtype).max if colour.dtype.kind == "u" else 1
    return colour.astype(np.float64) / full


def _with_simple_material(
    part: MeshPart, visual: Any, coloured: frozenset[str]
) -> MeshPart:
    """Lay on a material of OBJ or PLY, whose colour is sRGB.

    A texture has its own colours, unless the file gives a colour that tints it.
    """
    material = visual.material
    factor = srgb_to_linear_numpy(_unit(material.diffuse))
    if material.image is not None and material.name not in coloured:
        factor = np.ones(3)
    part = replace(part, colour=tuple(map(float, factor[:3])))
    if material.image is None:
        return part
    if visual.uv is None:
        raise InputError(
            f"a face with the texture of material {material.name!r} has no texture "
            "coordinates (vt); give it coordinates, or a material without a texture"
        )
    texture, uv, wrap = laid_out(
        flat_texture(material.image, "RGB"), np.array(visual.uv), ("repeat", "repeat")
    )
    return replace(part, texture=texture, uv=uv, wrap=wrap)


def _with_base_colour(part: MeshPart, visual: Any, base: BaseColour) -> MeshPart:
    """Lay on a material of glTF, whose colour is linear."""
    material = visual.material
    factor = np.ones(4)
    if base.factor is not None:
        factor = base.factor
    elif material.baseColorFactor is not None:
        factor = _unit(material.baseColorFactor)
    stored = visual.vertex_attributes.get("color")
    if stored is not None:
        part = replace(part, vertex_colour=_unit(stored)[:, :3])
    part = replace(part, colour=tuple(map(float, factor[:3])))
    is_solid = material.alphaMode not in ("MASK", "BLEND")
    opacity = 1.0 if is_solid else float(factor[3])
    if not base.has_texture:
        if material.alphaMode == "MASK":
            opacity = float(opacity >= base.alpha_cutoff)
        return replace(part, opacity=opacity)
    if material.baseColorTexture is None:
        raise InputError(
            f"the texture of materials[{material.name}] is missing or cannot be read "
            "as an image; use PNG, JPEG or WebP"
        )
    texture = flat_texture(material.baseColorTexture, "RGB" if is_solid else "RGBA")
    if not is_solid:
        alpha = opacity * (texture[..., 3] / 255)
        if material.alphaMode == "MASK":
            alpha = (alpha >= base.alpha_cutoff).astype(np.float64)
        texture[..., 3] = np.round(255 * alpha)
        texture = texture if alpha.min() < 1 else texture[..., :3]
    # set 0 of trimesh has its origin at the bottom left
    uv = np.array(visual.uv, np.float64) * [1, -1] + [0, 1]
    uv = (uv @ base.matrix[:, :2].T + base.matrix[:, 2]) * [1, -1] + [0, 1]
    texture, uv, wrap = laid_out(texture, uv, base.wrap)
    return replace(part, texture=texture, uv=uv, wrap=wrap)
