"""Attacked textures on real geometry, lit and shadowed by the environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.capture.mesh import MeshPart, TexturedMesh, mitsuba_shapes
from mi_nerfattack.render.posed import Pose


@dataclass(frozen=True, eq=False)
class BuiltInObject:
    """Triangles with a baked texture, at a pose.

    Attributes:
        vertices: (n, 3) float64, metres in the object's frame; no two triangles
            share one, so that every triangle has texels of its own.
        faces: (m, 3) integer, counter-clockwise from outside.
        uv: (n, 2) in [0, 1], origin at the bottom left of the image.
        image: (h, w, 3) uint8, sRGB albedo; row 0 is the top.
        pose: object to world.
        normals: (n, 3) unit vectors in the object's frame; None for flat triangles.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    image: np.ndarray
    pose: Pose
    normals: np.ndarray | None = None

    @property
    def world_vertices(self) -> np.ndarray:
        """Vertices (n, 3) in the world, metres."""
        pose = self.pose
        return pose.scale * self.vertices @ pose.rotation.T + pose.translation


def built_in_shapes(objects: Sequence[BuiltInObject]) -> dict[str, Any]:
    """Make Mitsuba meshes, diffuse on both sides, for `load_scene(..., shapes=...)`.

    Args:
        objects: may be empty.

    Returns:
        one `mi.Shape` an object by name, "built_in_000" and so on; all of the active
        variant.
    """
    shapes = {}
    for index, item in enumerate(objects):
        part = MeshPart(
            item.vertices,
            item.faces,
            (1.0, 1.0, 1.0),
            normals=item.normals,
            uv=item.uv,
            texture=item.image,
            wrap="clamp",
        )
        pose = item.pose
        placed = part.placed(pose.scale * pose.rotation, pose.translation)
        found = mitsuba_shapes(TexturedMesh("built-in object", (placed,)))
        shapes[f"built_in_{index:03d}"] = found["part_000"]
    return shapes
