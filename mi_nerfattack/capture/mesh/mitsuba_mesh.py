"""Mitsuba's meshes from and to arrays.

No other module names the class and its parameters: Mitsuba 3.10 renames the parameters
and wants tensors when a mesh is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np


@dataclass(frozen=True, eq=False)
class MeshArrays:
    """Triangles as Mitsuba holds them.

    Args:
        vertices: (n, 3), metres in the world.
        faces: (m, 3), integer, counter-clockwise from outside.
        normals: (n, 3), unit vectors; None for flat triangles.
        uv: (n, 2), v = 0 is the first row of a texture; None for no coordinates.
        colour: (n, 3), linear, the attribute `vertex_color`; None for no attribute.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None
    colour: np.ndarray | None = None


def make_mesh(name: str, arrays: MeshArrays, bsdf: Any = None) -> Any:
    """Make a Mitsuba shape; values are rounded to float32.

    Args:
        name: of the shape.
        arrays: what it is made of.
        bsdf: an object of Mitsuba; None for Mitsuba's default.
    """
    properties = mi.Properties()
    properties["face_normals"] = arrays.normals is None
    if bsdf is not None:
        properties["bsdf"] = bsdf
    mesh = mi.Mesh(
        name,
        vertex_count=len(arrays.vertices),
        face_count=len(arrays.faces),
        has_vertex_normals=arrays.normals is not None,
        has_vertex_texcoords=arrays.uv is not None,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(np.uint32(arrays.faces.ravel()))
    for key, values in (
        ("vertex_positions", arrays.vertices),
        ("vertex_normals", arrays.normals),
        ("vertex_texcoords", arrays.uv),
    ):
        if values is not None:
            parameters[key] = mi.Float(np.float32(values.ravel()))
    parameters.update()
    if arrays.colour is not None:
        mesh.add_attribute("vertex_color", 3, arrays.colour.ravel().tolist())
    return mesh


def read_mesh(shape: Any) -> MeshArrays:
    """Return the arrays of a Mitsuba mesh, float64 and int64, without its colours."""
    parameters = mi.traverse(shape)

    def rows(key: str, width: int) -> np.ndarray:
        return np.array(parameters[key], np.float64).reshape(-1, width)

    is_smooth = shape.has_vertex_normals() and not shape.has_face_normals()
    return MeshArrays(
        rows("vertex_positions", 3),
        rows("faces", 3).astype(np.int64),
        rows("vertex_normals", 3) if is_smooth else None,
        uv=rows("vertex_texcoords", 2) if shape.has_vertex_texcoords() else None,
    )
