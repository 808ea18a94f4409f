"""Write a mesh with colours at its vertices as binary glTF."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.mesh.surface import ColouredMesh
from mi_nerfattack.io import files

_FLOAT, _UINT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963


def write_glb(path: str | Path, mesh: ColouredMesh) -> None:
    """Write a mesh atomically; see :func:`glb_bytes`.

    Args:
        path: of the .glb file.
        mesh: z up.
    """
    files.write_bytes(path, glb_bytes(mesh, Path(path).stem))


def glb_bytes(mesh: ColouredMesh, name: str) -> bytes:
    """Return a mesh as a .glb file, in metres and with glTF's y up.

    Colours stay linear and floating point, as glTF wants them. The material is unlit
    (`KHR_materials_unlit`), since the colours hold the light of the capture already.

    Args:
        mesh: z up; x stays, z becomes y, and y becomes -z.
        name: of the mesh.
    """
    blob, views, accessors = b"", [], []
    for array, kind, target in (
        (_y_up(mesh.vertices), "VEC3", _ARRAY_BUFFER),
        (_y_up(mesh.normals), "VEC3", _ARRAY_BUFFER),
        (mesh.colours.astype(np.float32), "VEC3", _ARRAY_BUFFER),
        (mesh.faces.ravel().astype(np.uint32), "SCALAR", _ELEMENT_BUFFER),
    ):
        data = np.ascontiguousarray(array).tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": _FLOAT if kind == "VEC3" else _UINT,
            "count": len(array),
            "type": kind,
        }
        if not accessors:  # glTF asks for the extent of positions
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        view = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)}
        views.append(view | {"target": target})
        accessors.append(accessor)
        blob += data
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    tree = {
        "asset": {"version": "2.0", "generator": "mi-nerfattack"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [
            {"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}
        ],
        "materials": [
            {
                "name": "radiance",
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return _glb(json.dumps(tree, separators=(",", ":")), blob)


def _y_up(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    return np.stack([x, z, -y], axis=1).astype(np.float32)


def _glb(text: str, blob: bytes) -> bytes:
    encoded = text.encode()
    encoded += b" " * (-len(encoded) % 4)
    blob += b"\0" * (-len(blob) % 4)
    body = b"".join(
        len(data).to_bytes(4, "little") + kind + data
        for kind, data in ((b"JSON", encoded), (b"BIN\0", blob))
    )
    return b"glTF" + np.array([2, 12 + len(body)], "<u4").tobytes() + body
