"""The tree of a glTF file's nodes, replaced by its meshes where they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.mesh.accessors import Accessors
from mi_nerfattack.errors import InputError

INSTANCES = "EXT_mesh_gpu_instancing"
_INSTANCE = {"TRANSLATION": "translation", "ROTATION": "rotation", "SCALE": "scale"}
MAX_MESHES = 10_000
MAX_CORNERS = 1 << 26  # of triangles, of all meshes as often as they are placed


def place_meshes(path: Path, tree: Any, accessors: Accessors) -> None:
    """Replace the nodes of a glTF tree by one for each mesh of the scene.

    Args:
        path: of the file, for messages.
        tree: its JSON, with plain accessors; changed.
        accessors: of the tree.

    Raises:
        InputError: a node has two parents, or is above itself; more than `MAX_MESHES`
            meshes or `MAX_CORNERS` corners are placed; a mesh is morphed.
    """
    nodes, world = tree.get("nodes", []), _world_matrices(path, tree)
    placed: list[dict[str, Any]] = []
    corners = 0
    for index, matrix in world.items():
        node = nodes[index]
        if "mesh" not in node:
            continue
        mesh = tree["meshes"][node["mesh"]]
        if any(node.get("weights", mesh.get("weights", ()))):
            raise InputError(
                f"{path}: nodes[{index}]: its mesh is morphed, which is not supported; "
                "apply its shape keys and export it again"
            )
        copies = _instances(node, tree, accessors)
        corners += _corners(tree, node["mesh"]) * len(copies)
        if len(placed) + len(copies) > MAX_MESHES or corners > MAX_CORNERS:
            raise InputError(
                f"{path}: {len(placed) + len(copies)} meshes or more, with {corners} "
                f"corners of triangles; at most {MAX_MESHES} and {MAX_CORNERS} are "
                "read: join or simplify them"
            )
        number = node["mesh"]
        if "skin" in node:  # then the node's own place does not count
            skin = tree["skins"][node["skin"]]
            number = _add_skinned(
                tree, mesh, _joints(skin, world, accessors), accessors=accessors
            )
            matrix = np.eye(4)
        placed += [
            {"mesh": number, "matrix": (matrix @ copy).T.ravel().tolist()}
            for copy in copies
        ]
    tree["nodes"], tree["scene"] = placed, 0
    tree["scenes"] = [{"nodes": list(range(len(placed)))}]


def _world_matrices(path: Path, tree: Any) -> dict[int, np.ndarray]:
    """Return the transforms (4, 4) to the world of all nodes of the scene."""
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    roots = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else []
    left, world = [(index, np.eye(4)) for index in roots], {}
    while left:
        index, above = left.pop()
        if index in world:
            raise InputError(
                f"{path}: nodes[{index}] has two parents or contains itself; export "
                "the mesh again"
            )
        with np.errstate(all="ignore"):  # what is not finite is told of the vertices
            world[index] = above @ _matrix(nodes[index])
        left += [(child, world[index]) for child in nodes[index].get("children", ())]
    return world


def _instances(node: Any, tree: Any, accessors: Accessors) -> list[np.ndarray]:
    """Return where a node repeats its mesh, (4, 4) each; one without instances."""
    attributes = node.get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
    used = {name: index for name, index in attributes.items() if name in _INSTANCE}
    counts = {tree["accessors"][index]["count"] for index in used.values()}
    if not used:
        return [np.eye(4)]
    (count,) = counts
    if count > MAX_MESHES:
        raise ValueError(f"{INSTANCES}: {count} instances; at most {MAX_MESHES}")
    rows = {_INSTANCE[name]: accessors.read(index) for name, index in used.items()}
    return [_matrix({key: row[i] for key, row in rows.items()}) for i in range(count)]


def _joints(skin: Any, world: Any, accessors: Accessors) -> np.ndarray:
    """Return what a skin's joints do to stored vertices, (joints, 4, 4)."""
    places = np.stack([world[index] for index in skin["joints"]])
    if "inverseBindMatrices" not in skin:
        return places
    inverse = accessors.read(skin["inverseBindMatrices"])[: len(places)]
    return places @ inverse.reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns


def _add_skinned(tree: Any, mesh: Any, joints: np.ndarray, accessors: Accessors) -> int:
    """Append a mesh as its joints pose it, and return its index."""
    primitives = []
    for primitive in mesh["primitives"]:
        attributes = dict(primitive["attributes"])
        blend: Any = 0.0
        for name, index in primitive["attributes"].items():
            if name.startswith("JOINTS_"):
                weights = accessors.read(attributes["WEIGHTS_" + name[7:]])
                used = accessors.read(index)
                for k in range(weights.shape[1]):
                    blend = blend + weights[:, k, None, None] * joints[used[:, k]]
        if isinstance(blend, float):
            raise ValueError("a mesh with a skin has no JOINTS_0")
        total = blend[:, 3:, 3:]  # the sum of the weights, 1 except for rounding
        if not (total > 0).all():
            raise ValueError("a vertex hangs on no joint")
        linear, shift = blend[:, :3, :3] / total, blend[:, :3, 3] / total[:, 0]
        stored = accessors.read(attributes["POSITION"])
        moved = (linear @ stored[:, :, None])[:, :, 0] + shift
        attributes["POSITION"] = accessors.add(moved)
        if "NORMAL" in attributes:
            columns = np.moveaxis(linear, 2, 0)
            crosses = [np.cross(columns[i - 2], columns[i - 1]) for i in range(3)]
            normal = accessors.read(attributes["NORMAL"])
            turned = np.einsum("vi,ivk->vk", normal, np.stack(crosses))
            length = np.linalg.norm(turned, axis=1, keepdims=True)
            attributes["NORMAL"] = accessors.add(turned / np.maximum(length, 1e-30))
        primitives.append({**primitive, "attributes": attributes})
    tree["meshes"].append({"primitives": primitives})
    return len(tree["meshes"]) - 1


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
