"""Small glTF files made by hand, and pictures of meshes from the front."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from helpers.posed_folders import render_views
from PIL import Image

from mi_nerfattack.capture.mesh.mesh import TexturedMesh, mitsuba_shapes
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
#: What `four_colours` shows: top left, top right, bottom left, bottom right.
CORNERS = np.array([[[200, 0, 0], [0, 200, 0]], [[0, 0, 200], [200, 200, 200]]])


def four_colours(size: int = 8) -> Image.Image:
    """Red, green over blue, white: tells every mirroring and turning apart."""
    picture = CORNERS.astype(np.uint8).repeat(size // 2, 0).repeat(size // 2, 1)
    return Image.fromarray(picture)


class Gltf:
    """A glTF file in the making: add arrays, then change `tree` as a test likes."""

    def __init__(self) -> None:
        self.blob = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
            "materials": [],
        }

    def view(self, data: bytes) -> int:
        """Append bytes, and return the index of their view."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.tree["bufferViews"].append(view)
        self.blob += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Any, dtype: str = "f4", **extra: Any) -> int:
        """Append an array, and return the index of its accessor."""
        array = np.asarray(values, dtype)
        accessor = {
            "bufferView": self.view(array.tobytes()),
            "componentType": _COMPONENTS[dtype],
            "count": len(array),
            "type": _TYPES[1 if array.ndim == 1 else array.shape[1]],
            **extra,
        }
        self.tree["accessors"].append(accessor)
        return len(self.tree["accessors"]) - 1

    def texture(self, image: Image.Image, **sampler: int) -> int:
        """Embed an image, and return the index of its texture."""
        data = io.BytesIO()
        image.save(data, "PNG")
        source = {"mimeType": "image/png", "bufferView": self.view(data.getvalue())}
        for name, entry in (
            ("images", source),
            ("samplers", sampler),
            ("textures", {"source": 0, "sampler": 0}),
        ):
            self.tree[name] = [entry]
        return 0

    def material(self, **metallic: Any) -> dict[str, Any]:
        """Append a material, and return it."""
        self.tree["materials"].append({"pbrMetallicRoughness": metallic})
        return self.tree["materials"][-1]

    def write(self, path: Path) -> Path:
        """Write .glb, or .gltf with its .bin beside."""
        if path.suffix == ".gltf":
            bin_path = path.with_suffix(".bin")
            bin_path.write_bytes(self.blob)
            self.tree["buffers"] = [
                {"uri": bin_path.name, "byteLength": len(self.blob)}
            ]
            path.write_text(json.dumps(self.tree))
            return path
        self.tree["buffers"] = [{"byteLength": len(self.blob)}]
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        body = len(text).to_bytes(4, "little") + b"JSON" + text
        body += len(blob).to_bytes(4, "little") + b"BIN\0" + blob
        size = (len(body) + 12).to_bytes(4, "little")
        path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + size + body)
        return path


def plate(uv_scale: float = 1.0, **attributes: Any) -> Gltf:
    """A plate 2 wide and 1 high in glTF's axes, facing +z, of material 0.

    Args:
        uv_scale: its texture coordinates reach from 0 to this.
        attributes: more attributes of the corners: bottom left, bottom right, top
            right, top left.
    """
    gltf = Gltf()
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    uv = uv_scale * np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    used = {"POSITION": corners, "TEXCOORD_0": uv, **attributes}
    primitive = {
        "attributes": {name: gltf.array(value) for name, value in used.items()},
        "indices": gltf.array([0, 1, 2, 0, 2, 3], "u2"),
        "material": 0,
    }
    gltf.tree["meshes"][0]["primitives"].append(primitive)
    return gltf


def seen_from(mesh: TexturedMesh, side: tuple[float, float, float]) -> np.ndarray:
    """Render a mesh from a side under constant white light: (64, 64, 4), linear.

    The plate of `plate`, seen from its front, fills the picture's width.
    """
    middle = mesh.bounds.mean(0)
    pose = look_at(middle + 4 * np.array(side), middle)
    scene = mi.load_dict(
        {"type": "scene", "l": {"type": "constant"}, **mitsuba_shapes(mesh)},
        parallel=False,
    )
    path = mi.load_dict({"type": "path", "max_depth": 8, "hide_emitters": True})
    camera = from_fov(64, 64, 2 * np.degrees(np.arctan(0.25)))
    rgb, alpha, _ = render_views(scene, camera, pose[None], 256, 0, path)
    return np.concatenate([rgb[0], alpha[0][..., None]], axis=2)


def cells(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Pick the middles of a grid of cells over the front of `plate`, (r, c, ...)."""
    y = 16 + 32 * (np.arange(rows) + 0.5) / rows
    x = 64 * (np.arange(columns) + 0.5) / columns
    return image[np.ix_(y.astype(int), x.astype(int))]
