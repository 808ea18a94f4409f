"""Ground of the scene: road surface, kerbs with pavement, lawn."""

from __future__ import annotations

import numpy as np

from ..mesh import MeshBuilder, level
from .layout import (
    KERB_HEIGHT,
    KERB_RADIUS,
    LANE_WIDTH,
    PAVEMENT_WIDTH,
    ROAD_END,
    corner_kerb,
)
from .paint import SIDE_ROAD_TOP

EXTENT = 400.0
_LAWN_IMAGE = 80.0
_REPEAT = 16.0
_TURN_STEPS = 12


def roads() -> dict[str, MeshBuilder]:
    """Return the meshes of the two road images; they share the edge at the seam."""
    return {
        "road_main": level(-ROAD_END, ROAD_END, SIDE_ROAD_TOP, LANE_WIDTH),
        "road_side": level(-LANE_WIDTH, LANE_WIDTH, -ROAD_END, SIDE_ROAD_TOP),
    }


def _normals(line: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 2) to the left of an open polyline."""
    step = np.diff(line, axis=0)
    step = step / np.linalg.norm(step, axis=1)[:, None]
    tangent = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    tangent = tangent / np.linalg.norm(tangent, axis=1)[:, None]
    # A mitre keeps the offset of both neighbouring segments.
    scale = np.concatenate([[1.0], np.sum(tangent[1:-1] * step[1:], axis=1), [1.0]])
    return np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / scale[:, None]


def kerb_strip(mesh: MeshBuilder, line: np.ndarray) -> None:
    """Append a kerb and its pavement to the left of a line (n, 2), metres."""
    normal = _normals(line)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(length)]) / _REPEAT
    total = KERB_HEIGHT + PAVEMENT_WIDTH
    section = [(0.0, 0.0, 0.0), (0.0, KERB_HEIGHT, KERB_HEIGHT)]
    section += [(PAVEMENT_WIDTH, KERB_HEIGHT, total)]
    for (o0, z0, v0), (o1, z1, v1) in zip(section, section[1:], strict=False):
        for k in range(len(line) - 1):
            corners, uvs = [], []
            for i, o, z, v in (
                (k, o0, z0, v0),
                (k + 1, o0, z0, v0),
                (k + 1, o1, z1, v1),
                (k, o1, z1, v1),
            ):
                corners.append([*(line[i] + o * normal[i]), z])
                uvs.append([s[i], v / total])
            mesh.quad(np.array(corners), np.array(uvs))


def pavement() -> MeshBuilder:
    """Return all kerbs and pavements as one mesh."""
    mesh = MeshBuilder()
    half, end = LANE_WIDTH, ROAD_END
    inner = half + PAVEMENT_WIDTH
    kerb_strip(mesh, np.array([[-end, half], [end, half]]))
    kerb_strip(mesh, corner_kerb(-1, _TURN_STEPS)[::-1])
    kerb_strip(mesh, corner_kerb(1, _TURN_STEPS))
    kerb_strip(mesh, np.array([[end, inner], [end, -inner]]))
    kerb_strip(mesh, np.array([[-end, -inner], [-end, inner]]))
    kerb_strip(mesh, np.array([[inner, -end], [-inner, -end]]))
    return mesh


def grass() -> MeshBuilder:
    """Return the lawn beyond the pavements at the pavements' height."""
    mesh = MeshBuilder()
    inner = LANE_WIDTH + PAVEMENT_WIDTH
    end = ROAD_END + PAVEMENT_WIDTH
    centre, radius = LANE_WIDTH + KERB_RADIUS, KERB_RADIUS - PAVEMENT_WIDTH
    angle = np.linspace(0.0, np.pi / 2, _TURN_STEPS + 1)
    arc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1) - centre
    west = [[-EXTENT, -EXTENT], [-inner, -EXTENT], *arc, [-EXTENT, -inner]]
    regions = [
        np.array(west),
        (np.array(west) * [-1, 1])[::-1],
        np.array(
            [[-EXTENT, inner], [EXTENT, inner], [EXTENT, EXTENT], [-EXTENT, EXTENT]]
        ),
        np.array([[end, -inner], [EXTENT, -inner], [EXTENT, inner], [end, inner]]),
        np.array([[-EXTENT, -inner], [-end, -inner], [-end, inner], [-EXTENT, inner]]),
        np.array([[-inner, -EXTENT], [inner, -EXTENT], [inner, -end], [-inner, -end]]),
    ]
    side = 2 * _LAWN_IMAGE
    for region in regions:
        corners = np.column_stack([region, np.full(len(region), KERB_HEIGHT)])
        uv = np.column_stack([0.5 + region[:, 0] / side, 0.5 - region[:, 1] / side])
        mesh.polygon(corners, uv)
    return mesh
