"""Small glTF meshes and 3D Gaussian splats made by hand."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from support.worlds.views import render_views

from mi_nerfattack.capture.mesh.mesh import TexturedMesh, mitsuba_shapes
from mi_nerfattack.fields.splats import Splats
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"f4": 5126, "u4": 5125, "u2": 5123, "i2": 5122, "u1": 5121}
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
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0}
        self.tree |= {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.tree |= {"meshes": [{"primitives": []}], "accessors": []}
        self.tree |= {"bufferViews": [], "materials": []}

    def view(self, data: bytes) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.tree["bufferViews"].append(view)
        self.blob += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Any, dtype: str = "f4", **extra: Any) -> int:
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
        data = io.BytesIO()
        image.save(data, "PNG")
        source = {"mimeType": "image/png", "bufferView": self.view(data.getvalue())}
        self.tree |= {"images": [source], "samplers": [sampler]}
        self.tree["textures"] = [{"source": 0, "sampler": 0}]
        return 0

    def material(self, **metallic: Any) -> dict[str, Any]:
        self.tree["materials"].append({"pbrMetallicRoughness": metallic})
        return self.tree["materials"][-1]

    def write(self, path: Path) -> Path:
        """Write .glb, or .gltf with its .bin beside."""
        if path.suffix == ".gltf":
            path.with_suffix(".bin").write_bytes(self.blob)
            buffer = {"uri": f"{path.stem}.bin", "byteLength": len(self.blob)}
            path.write_text(json.dumps(self.tree | {"buffers": [buffer]}))
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

    Attributes are of the corners bottom left, bottom right, top right, top left.
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


C0 = 0.5 / np.sqrt(np.pi)  # the harmonic of degree 0
NAMES = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
TAIL = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def splats(
    centers,
    colours=(0.8, 0.4, 0.2),
    opacities=0.6,
    scales=0.1,
    quaternions=(1.0, 0.0, 0.0, 0.0),
    bands=None,
) -> Splats:
    """Make splats; everything but the centres (n, 3) is broadcast to (n, ...).

    Colours are sRGB, quaternions w, x, y, z, and bands (n, k - 1, 3) more harmonics.
    """
    centers = np.atleast_2d(np.asarray(centers, np.float32))
    n = len(centers)
    harmonics = (np.broadcast_to(colours, (n, 3))[:, None] - 0.5) / C0
    if bands is not None:
        harmonics = np.concatenate([harmonics, bands], 1)
    turns = np.broadcast_to(np.asarray(quaternions, np.float32), (n, 4))
    turns = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    scales = np.asarray(scales, np.float32)
    scales = scales[:, None] if scales.ndim == 1 and len(scales) == n != 3 else scales
    return Splats(
        "splats",
        centers,
        np.array(np.broadcast_to(scales, (n, 3))),
        turns,
        np.array(np.broadcast_to(np.asarray(opacities, np.float32), n)),
        harmonics.astype(np.float32),
    )


def cloud(rng: np.random.Generator, count: int, giants: int = 0) -> Splats:
    """Make random splats of all shapes around the origin, some of them huge."""
    sizes = np.exp(rng.normal(-1.8, 0.7, (count, 3)))
    sizes[:giants] *= 12
    return splats(
        rng.uniform(-5, 5, (count, 3)),
        rng.uniform(0, 1, (count, 3)),
        rng.uniform(0.02, 0.6, count),
        sizes,
        rng.normal(size=(count, 4)),
    )


def wall(
    x: float, colour=(0.1, 0.3, 0.9), half: float = 6.0, step: float = 0.4
) -> Splats:
    """Make an opaque wall of splats across the x axis."""
    ticks = np.arange(-half, half + step / 2, step)
    y, z = np.meshgrid(ticks, ticks)
    places = np.stack([np.full(y.shape, x), y, z], -1).reshape(-1, 3)
    return splats(places, colour, 0.9999, [0.01, step, step])


def columns(item: Splats) -> dict[str, np.ndarray]:
    """Return what a trainer writes, by property, in its order."""
    n, k = item.harmonics.shape[:2]
    bands = item.harmonics[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    names = [*NAMES, *(f"f_rest_{i}" for i in range(3 * (k - 1))), *TAIL]
    logits = np.log(item.opacities) - np.log1p(-item.opacities)
    places = item.centers, np.zeros((n, 3)), item.harmonics[:, 0], bands
    shapes = logits[:, None], np.log(item.scales), item.quaternions
    return dict(zip(names, np.hstack([*places, *shapes]).T, strict=True))


def write_ply(
    path: Path,
    values: dict[str, np.ndarray],
    text: bool = False,
    types: dict[str, str] | None = None,
) -> Path:
    """Write properties as a PLY file of float, or of the types given."""
    types = types or {}
    codes = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    kinds = [(name, types.get(name, "float")) for name in values]
    count = len(next(iter(values.values())))
    head = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    head += ["comment made by hand", f"element vertex {count}"]
    head += [f"property {kind} {name}" for name, kind in kinds]
    start = ("\n".join([*head, "end_header"]) + "\n").encode()
    rows = np.zeros(count, [(name, codes[kind]) for name, kind in kinds])
    for name, value in values.items():
        rows[name] = value
    if text:
        lines = (" ".join(f"{float(v):.9g}" for v in row) for row in rows.tolist())
        body = ("\n".join(lines) + "\n").encode()
    else:
        body = rows.tobytes()
    path.write_bytes(start + body)
    return path


def reference(
    item: Splats, origin: np.ndarray, directions: np.ndarray, t_max: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay splats of degree 0 over each other in float64: sRGB, opacity, moment."""
    axes = Rotation.from_quat(item.quaternions[:, [1, 2, 3, 0]]).as_matrix()
    rows = axes.transpose(0, 2, 1) / item.scales[:, :, None].astype(float)
    colour = np.maximum(C0 * item.harmonics[:, 0].astype(float) + 0.5, 0)
    o = np.einsum("nij,nj->ni", rows, origin - item.centers.astype(float))
    colours, opacity, moment = [], [], []
    for direction in directions.astype(float):
        d = rows @ direction
        t = -(o * d).sum(1) / (d**2).sum(1)
        squared = ((o + t[:, None] * d) ** 2).sum(1)
        alpha = np.minimum(item.opacities * np.exp(-0.5 * squared), 0.9999)
        alpha[(squared > 9) | (t <= 0) | (t >= t_max)] = 0
        order = np.argsort(t)
        passed = np.cumprod(np.concatenate([[1.0], 1 - alpha[order]]))
        weight = passed[:-1] * alpha[order]
        colours.append(weight @ colour[order])
        opacity.append(1 - passed[-1])
        moment.append(weight @ t[order])
    return np.array(colours), np.array(opacity), np.array(moment)
