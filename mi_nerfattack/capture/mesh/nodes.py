"""The tree of a glTF file's nodes, replaced by its meshes where they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.errors import InputError

MAX_MESHES = 10_000
MAX_CORNERS = 1 << 26  # of triangles, of all meshes as often as they are placed


def place_meshes(path: Path, tree: Any) -> None:
    """Replace the nodes of a glTF tree by one for each mesh of the scene.

    Args:
        path: of the file, for messages.
        tree: its JSON; changed.

    Raises:
        InputError: a node has two parents, or is above itself; more than `MAX_MESHES`
            meshes or `MAX_CORNERS` corners are placed.
    """
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    roots = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else []
    left, seen, corners = [(index, np.eye(4)) for index in roots], set(), 0
    placed: list[dict[str, Any]] = []
    while left:
        index, above = left.pop()
        if index in seen:
            raise InputError(
                f"{path}: nodes[{index}] has two parents or contains itself; export "
                "the mesh again"
            )
        seen.add(index)
        node = nodes[index]
        with np.errstate(all="ignore"):  # what is not finite is told of the vertices
            matrix = above @ _matrix(node)
        left += [(child, matrix) for child in node.get("children", ())]
        if "mesh" in node:
            corners += _corners(tree, node["mesh"])
            placed.append({"mesh": node["mesh"], "matrix": matrix.T.ravel().tolist()})
        if len(placed) > MAX_MESHES or corners > MAX_CORNERS:
            raise InputError(
                f"{path}: {len(placed)} meshes or more, with {corners} corners of "
                f"triangles; at most {MAX_MESHES} and {MAX_CORNERS} are read: join or "
                "simplify them"
            )
    tree["nodes"], tree["scene"] = placed, 0
    tree["scenes"] = [{"nodes": list(range(len(placed)))}]


def _matrix(node: Any) -> np.ndarray:
    """Return a node's transform into its parent's frame, (4, 4)."""
    result = np.reshape(np.array(node.get("matrix", np.eye(4)), np.float64), (4, 4)).T
    local = np.eye(4)
    if "rotation" in node:
        local[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
    local[:3, :3] *= np.reshape(node.get("scale", (1.0, 1.0, 1.0)), 3)
    local[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return result @ local


def _corners(tree: Any, mesh: int) -> int:
    count = 0
    for primitive in tree["meshes"][mesh]["primitives"]:
        index = primitive.get("indices", primitive["attributes"].get("POSITION"))
        count += tree["accessors"][index]["count"] if index is not None else 0
    return count
