"""Solids of plain colours, of which scripts make the meshes of bundled objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_nerfattack.extras import missing

try:
    import trimesh
except ImportError as error:
    raise missing("trimesh", "the builder of a bundled mesh", error) from error

_Z_UP_TO_Y_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]]
)

#: Red, green, blue and alpha as glTF has them at vertices: linear, 0 to 255.
Colour = tuple[int, int, int, int]
#: A closed mesh, metres, z up, and its colour, or (faces, 4) those of its faces.
Part = tuple[trimesh.Trimesh, Colour | np.ndarray]


def cylinder(
    radius: float, low: float, high: float, colour: Colour, sides: int = 32
) -> Part:
    """Return an upright cylinder between two heights, metres."""
    mesh = trimesh.creation.cylinder(radius, high - low, sections=sides)
    mesh.apply_translation([0, 0, 0.5 * (low + high)])
    return mesh, colour


def box(
    middle: tuple[float, float, float],
    size: tuple[float, float, float],
    colour: Colour,
) -> Part:
    """Return a box along the axes, metres."""
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(middle)
    return mesh, colour


def loft(
    rings: np.ndarray, colours: Sequence[Sequence[Colour]], ends: Sequence[Colour]
) -> Part:
    """Return the closed surface through convex rings of points, capped at its ends.

    Args:
        rings: (m, k, 3), metres, m rings of k points, counter-clockwise as seen from
            the last ring.
        colours: of the faces between rings i and i + 1, points j and j + 1:
            m - 1 times k.
        ends: of the first and the last ring.
    """
    m, k = rings.shape[:2]
    number = np.arange(m * k).reshape(m, k)
    after = np.roll(number, -1, axis=1)
    quads = np.stack([number[:-1], after[:-1], after[1:], number[1:]], -1)
    sides = quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    fan = np.array([[0, j, j + 1] for j in range(1, k - 1)])
    caps = [fan[:, ::-1], fan + number[-1, 0]]
    paint = np.array(colours, np.uint8).reshape(-1, 4).repeat(2, axis=0)
    lids = np.array(ends, np.uint8).repeat(len(fan), axis=0)
    mesh = trimesh.Trimesh(
        rings.reshape(-1, 3), np.concatenate([sides, *caps]), process=False
    )
    return mesh, np.concatenate([paint, lids])


def merged(meshes: Sequence[Part]) -> trimesh.Trimesh:
    """Return all parts as one mesh with colours per vertex, metres, z up.

    Every face has vertices of its own, therefore it is shaded flat.
    """
    corners = np.concatenate([np.asarray(mesh.triangles) for mesh, _ in meshes])
    colours = [
        np.broadcast_to(np.array(colour, np.uint8), (len(mesh.faces), 4))
        for mesh, colour in meshes
    ]
    vertices = corners.reshape(-1, 3)
    return trimesh.Trimesh(
        vertices=vertices,
        faces=np.arange(len(vertices)).reshape(-1, 3),
        vertex_colors=np.concatenate(colours).repeat(3, axis=0),
        process=False,
    )


def write_glb(path: Path, name: str, mesh: trimesh.Trimesh) -> None:
    """Write a mesh as binary glTF, whose y axis points up."""
    data = trimesh.Scene({name: mesh.copy().apply_transform(_Z_UP_TO_Y_UP)}).export(
        file_type="glb"
    )
    assert isinstance(data, bytes)
    path.write_bytes(data)
