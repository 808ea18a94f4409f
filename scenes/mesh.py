"""Triangle meshes with texture coordinates and their PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np


class MeshBuilder:
    """Collects triangles of one material.

    Faces that must be shaded flat get vertices of their own; faces that share
    vertices are shaded smoothly, because the renderer computes vertex normals.
    Texture coordinates have v = 0 at the top row of the image.
    """

    def __init__(self) -> None:
        self._vertices: list[np.ndarray] = []
        self._uvs: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._count = 0

    def add(self, vertices: np.ndarray, uvs: np.ndarray, faces: np.ndarray) -> None:
        """Append vertices (n, 3), metres, uvs (n, 2) and faces (m, 3)."""
        assert len(vertices) == len(uvs)
        self._vertices.append(np.asarray(vertices, dtype=np.float64))
        self._uvs.append(np.asarray(uvs, dtype=np.float64))
        self._faces.append(np.asarray(faces, dtype=np.int64) + self._count)
        self._count += len(vertices)

    def quad(self, corners: np.ndarray, uvs: np.ndarray) -> None:
        """Append a quadrilateral: corners (4, 3) counter-clockwise, uvs (4, 2)."""
        self.add(corners, uvs, np.array([[0, 1, 2], [0, 2, 3]]))

    def polygon(self, corners: np.ndarray, uvs: np.ndarray) -> None:
        """Append a convex polygon: corners (n, 3) counter-clockwise, uvs (n, 2)."""
        n = len(corners)
        self.add(corners, uvs, np.array([[0, i, i + 1] for i in range(1, n - 1)]))

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (n, 3), uvs (n, 2) and faces (m, 3)."""
        return (
            np.concatenate(self._vertices),
            np.concatenate(self._uvs),
            np.concatenate(self._faces),
        )

    def write_ply(self, path: Path) -> None:
        """Write a binary little-endian PLY with x, y, z, u, v per vertex."""
        vertices, uvs, faces = self.arrays()
        header = "\n".join(
            [
                "ply",
                "format binary_little_endian 1.0",
                f"element vertex {len(vertices)}",
                *(f"property float {name}" for name in "xyzuv"),
                f"element face {len(faces)}",
                "property list uchar int vertex_indices",
                "end_header\n",
            ]
        )
        rows = np.empty(len(faces), dtype=[("n", "u1"), ("i", "<i4", (3,))])
        rows["n"], rows["i"] = 3, faces
        body = np.hstack([vertices, uvs]).astype("<f4")
        path.write_bytes(header.encode("ascii") + body.tobytes() + rows.tobytes())


def level(x0: float, x1: float, y0: float, y1: float) -> MeshBuilder:
    """Return a rectangle at z = 0 that faces up and shows its image once, metres."""
    mesh = MeshBuilder()
    corners = [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]
    mesh.quad(np.array(corners), np.array([(0, 1), (1, 1), (1, 0), (0, 0)]))
    return mesh


def rotate_z(points: np.ndarray, angle: float) -> np.ndarray:
    """Rotate points (n, 3) about the z axis by angle, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def box_faces(low: np.ndarray, high: np.ndarray) -> dict[str, np.ndarray]:
    """Return the corners (4, 3) of a box's faces, by the direction they face.

    Corners run counter-clockwise seen from outside, beginning at the bottom left.
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    corners = {
        "south": [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        "east": [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        "north": [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        "west": [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        "top": [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
    }
    return {name: np.array(value) for name, value in corners.items()}


def prism(
    radii: list[float], heights: list[float], sides: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smooth side wall of a solid of revolution: vertices, faces.

    Args:
        radii: radius of each ring, metres.
        heights: z of each ring, metres, increasing.
        sides: number of vertices of a ring.
    """
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [
            np.column_stack([r * ring, np.full(sides, z)])
            for r, z in zip(radii, heights, strict=True)
        ]
    )
    faces = []
    for k in range(len(radii) - 1):
        for i in range(sides):
            a, b = k * sides + i, k * sides + (i + 1) % sides
            faces += [[a, b, b + sides], [a, b + sides, a + sides]]
    return vertices, np.array(faces)
