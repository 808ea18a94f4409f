"""glTF files made ready for trimesh, and the features of glTF that trimesh ignores.

trimesh ignores samplers, second sets of texture coordinates, `KHR_texture_transform`,
sparse, normalised or quantised accessors, skins, instances and morphing. Where such a
feature changes the picture, this module does one of three things:

- It hands the feature on, as a `BaseColour`.
- It decodes the feature into plain accessors.
- It refuses the file and names the feature.

The module also refuses every unknown extension of nodes, meshes or their data, whether
the file requires the extension or only uses it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.mesh.accessors import Accessors
from mi_nerfattack.capture.mesh.nodes import INSTANCES, place_meshes
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import parse_json

MAX_BYTES = 1 << 30
#: Name under which the prepared JSON asks for the binary chunk of a .glb file.
BINARY_CHUNK = "<binary chunk>"

_GLB, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_FLOAT, _UBYTE, _USHORT, _UINT = 5126, 5121, 5123, 5125
#: Component types that trimesh reads; others are decoded.
_KINDS = {
    "POSITION": (_FLOAT,),
    "NORMAL": (_FLOAT,),
    "TEXCOORD_0": (_FLOAT,),
    "COLOR_0": (_FLOAT, _UBYTE, _USHORT),
    "indices": (_UBYTE, _USHORT, _UINT),
}
_GLOSS = "KHR_materials_pbrSpecularGlossiness"
_DRACO = "KHR_draco_mesh_compression"
_SUPPORTED = frozenset(
    {
        "EXT_texture_webp",
        _GLOSS,
        "KHR_texture_transform",
        # without these gloss, light or choices are lost, but no diffuse colour
        "EXT_instance_features",
        "EXT_mesh_features",
        "EXT_structural_metadata",
        "KHR_lights_punctual",
        "KHR_materials_anisotropy",
        "KHR_materials_clearcoat",
        "KHR_materials_dispersion",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_iridescence",
        "KHR_materials_sheen",
        "KHR_materials_specular",
        "KHR_materials_unlit",
        "KHR_materials_variants",
        "KHR_mesh_quantization",
        "KHR_xmp_json_ld",
        "MSFT_lod",
        _DRACO,
        INSTANCES,
    }
)
#: Where an extension may change geometry.
_GEOMETRY = ("nodes", "meshes", "accessors", "bufferViews", "buffers", "skins")
_WHITE = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}


@dataclass(frozen=True, eq=False)
class BaseColour:
    """How the base colour of a material is laid on.

    Attributes:
        has_texture: whether it names a texture.
        wrap: "repeat", "mirror" or "clamp" along u and v.
        matrix: (2, 3), applied to coordinates whose origin is at the top left.
        alpha_cutoff: opacity from which a MASK material is there.
        factor: (4,), linear, or None for what trimesh makes of an extension.
    """

    has_texture: bool
    wrap: tuple[str, str]
    matrix: np.ndarray
    alpha_cutoff: float
    factor: np.ndarray | None


@dataclass(frozen=True, eq=False)
class PreparedGltf:
    """A glTF file for trimesh.

    Attributes:
        data: the JSON; materials are named by their index, and every primitive has
            one, whose base colour reads the texture coordinates of set 0.
        base_colours: one for each material.
    """

    data: bytes
    base_colours: tuple[BaseColour, ...]


def prepare(
    path: Path, chunks: dict[str, bytes], load: Callable[[str], bytes]
) -> PreparedGltf:
    """Read a .glb or .gltf file as JSON and check the features that trimesh ignores.

    Args:
        path: the file.
        chunks: gets binary data by the name that the JSON gives it.
        load: returns the bytes of one of `chunks`, or of a file in the folder of
            `path` or below, by its name.

    Raises:
        FileNotFoundError: by `load`.
        InputError: the file is not glTF 2.0, is damaged, or uses a feature that is
            not supported; the message names the feature.
    """
    raw = files.read_bytes(path, MAX_BYTES)
    if path.suffix.lower() == ".glb":
        raw, binary = _chunks(path, raw)
        if binary is not None:
            chunks[BINARY_CHUNK] = binary
    try:
        tree = parse_json(path, raw.decode("utf-8-sig"))
        accessors = Accessors(tree, load, chunks)
        colours = _prepare_tree(path, tree, bool(chunks), accessors=accessors)
        place_meshes(path, tree, accessors)
        data = json.dumps(tree).encode()
    except (InputError, SetupError, FileNotFoundError):
        raise
    # a damaged tree makes raise whatever is missing or of another type
    except Exception as error:
        raise InputError(
            f"{path}: not a valid glTF file ({type(error).__name__}: {error}); "
            "export the mesh again"
        ) from error
    return PreparedGltf(data, colours)


def _chunks(path: Path, raw: bytes) -> tuple[bytes, bytes | None]:
    """Split a .glb file into its JSON and its binary chunk."""
    version, length = np.frombuffer(raw[4:12].ljust(8, b"\0"), "<u4").tolist()
    if raw[:4] != _GLB or version != 2:
        raise InputError(f"{path}: not a binary glTF 2.0 file; export the mesh again")
    if length != len(raw):
        raise InputError(
            f"{path}: {len(raw)} bytes, but its header says {length}; the file is "
            "damaged or truncated, copy or export it again"
        )
    chunks: list[tuple[bytes, bytes]] = []
    start = 12
    while start + 8 <= length:
        size = int.from_bytes(raw[start : start + 4], "little")
        chunks.append((raw[start + 4 : start + 8], raw[start + 8 : start + 8 + size]))
        start += 8 + size
    if not chunks or chunks[0][0] != _JSON or start > length:
        raise InputError(f"{path}: its chunks are damaged; export the mesh again")
    is_binary = len(chunks) > 1 and chunks[1][0] == _BIN
    return chunks[0][1], chunks[1][1] if is_binary else None


def _prepare_tree(
    path: Path, tree: Any, has_chunk: bool, accessors: Accessors
) -> tuple[BaseColour, ...]:
    if not str(tree["asset"]["version"]).startswith("2"):
        raise InputError(
            f"{path}: asset.version is {tree['asset']['version']}; only glTF 2 is read"
        )
    used = set(tree.get("extensionsRequired", ()))
    for item in (x for key in _GEOMETRY for x in tree.get(key, ())):
        for part in (item, *item.get("primitives", ())):
            used |= set(part.get("extensions", ()))
    if unknown := used - _SUPPORTED:
        raise InputError(
            f"{path}: uses {', '.join(sorted(unknown))}, which is not supported and "
            "may change what it shows; export the mesh without it (uncompressed)"
        )
    for i, buffer in enumerate(tree.get("buffers", ())):
        if "uri" in buffer:
            continue
        if i > 0 or not has_chunk:
            raise InputError(f"{path}: buffers[{i}] has no data; export the mesh again")
        buffer["uri"] = BINARY_CHUNK
    materials = tree.setdefault("materials", [])
    materials.append(dict(_WHITE))
    colours = tuple(_base_colour(path, tree, i) for i in range(len(materials)))
    for i, mesh in enumerate(tree.get("meshes", ())):
        for j, primitive in enumerate(mesh["primitives"]):
            where = f"{path}: meshes[{i}].primitives[{j}]"
            _prepare_primitive(
                where, tree, primitive, colours=colours, accessors=accessors
            )
    for i, material in enumerate(materials):
        material["name"] = str(i)
    return colours


def _base_colour(path: Path, tree: Any, index: int) -> BaseColour:
    material = tree["materials"][index]
    info, factor = _base_texture(material), None
    if _GLOSS not in material.get("extensions", {}):
        metallic = material.get("pbrMetallicRoughness", {})
        factor = np.reshape(metallic.get("baseColorFactor", (1.0,) * 4), 4)
    cutoff = float(material.get("alphaCutoff", 0.5))
    if info is None:
        plain = ("repeat", "repeat")
        return BaseColour(
            False, plain, np.eye(2, 3), alpha_cutoff=cutoff, factor=factor
        )
    texture = tree["textures"][info["index"]]
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    if webp.get("source", texture.get("source")) is None:
        raise InputError(
            f"{path}: textures[{info['index']}] has no PNG, JPEG or WebP image; "
            "export the mesh with one of these"
        )
    sampler = tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
    wrap = [_WRAPS[sampler.get(name, 10497)] for name in ("wrapS", "wrapT")]
    return BaseColour(
        True, (wrap[0], wrap[1]), _matrix(info), alpha_cutoff=cutoff, factor=factor
    )


def _base_texture(material: Any) -> Any:
    """Return what says how the base colour's texture is laid on; None without one."""
    gloss = material.get("extensions", {}).get(_GLOSS)
    if gloss is not None:
        return gloss.get("diffuseTexture")
    return material.get("pbrMetallicRoughness", {}).get("baseColorTexture")


def _matrix(info: Any) -> np.ndarray:
    """Return the affine map of `KHR_texture_transform`, (2, 3)."""
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    turn = float(transform.get("rotation", 0.0))
    # Counter-clockwise on the image, where v points down: what its text says and all
    # viewers do; the matrix printed with it has the opposite sense.
    rotation = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    scale = np.reshape(transform.get("scale", (1.0, 1.0)), 2)
    offset = np.reshape(transform.get("offset", (0.0, 0.0)), (2, 1))
    return np.hstack([rotation * scale, offset]).astype(np.float64)


def _prepare_primitive(
    where: str,
    tree: Any,
    primitive: Any,
    colours: tuple[BaseColour, ...],
    accessors: Accessors,
) -> None:
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _FAN:
        raise InputError(f"{where}: is a triangle fan; export plain triangles")
    if mode not in (_TRIANGLES, _STRIP):
        return
    material = primitive.setdefault("material", len(colours) - 1)
    attributes = primitive["attributes"]
    if colours[material].has_texture:
        name = f"TEXCOORD_{_coordinate_set(tree['materials'][material])}"
        if name not in attributes:
            raise InputError(
                f"{where}: has no {name}, which its texture needs; export the mesh "
                "with texture coordinates"
            )
        attributes["TEXCOORD_0"] = attributes[name]
    if _is_draco(where, tree, primitive):
        return  # trimesh decodes it
    for name, kinds in _KINDS.items():
        holder = primitive if name == "indices" else attributes
        if name in holder:
            accessor = tree["accessors"][holder[name]]
            if "sparse" in accessor or accessor["componentType"] not in kinds:
                rows = accessors.read(holder[name])
                holder[name] = accessors.add(rows, is_whole=name == "indices")


def _is_draco(where: str, tree: Any, primitive: Any) -> bool:
    """Tell whether a primitive has only compressed data, which can be read."""
    used = [*primitive["attributes"].values()]
    used += [primitive["indices"]] if "indices" in primitive else []
    stored = [{"bufferView", "sparse"} & {*tree["accessors"][i]} for i in used]
    extensions = primitive.get("extensions", {})
    if _DRACO not in extensions or all(stored):
        extensions.pop(_DRACO, None)
        if not all(stored):
            raise InputError(f"{where}: has no data; export the mesh again")
        return False
    what = f"{where}: compression by {_DRACO}"
    load_extra("DracoPy", what, "export the mesh uncompressed")
    return True


def _coordinate_set(material: Any) -> int:
    info = _base_texture(material)
    transform = info.get("extensions", {}).get("KHR_texture_transform", {})
    return int(transform.get("texCoord", info.get("texCoord", 0)))
