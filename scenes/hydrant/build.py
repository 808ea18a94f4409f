"""Write hydrant.glb: a fire hydrant 0.75 m tall, made of closed primitives.

Run ``python -m mi_nerfattack.scenes.hydrant.build [--out FILE]``. The file holds one
mesh with colours per vertex. As glTF asks, its y axis points up; `world_mesh` holds the
same parts with z up, metres, the foot's centre at the origin.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..solids import Part, cylinder, merged, trimesh, write_glb

HEIGHT = 0.75
_RED, _WHITE = (190, 30, 28, 255), (232, 230, 222, 255)
_YELLOW, _GREY = (236, 186, 30, 255), (95, 98, 102, 255)


def _nozzle(angle: float, height: float, radius: float, reach: float) -> list[Part]:
    """Return a side outlet with flange, cap and nut along a horizontal direction."""
    rings = [
        cylinder(radius, 0.06, reach - 0.035, _RED, 24),
        cylinder(1.25 * radius, reach - 0.035, reach - 0.015, _RED, 24),
        cylinder(1.12 * radius, reach - 0.018, reach + 0.02, _YELLOW, 24),
        cylinder(0.4 * radius, reach + 0.015, reach + 0.045, _YELLOW, 5),
    ]
    turn = trimesh.transformations.rotation_matrix(0.5 * np.pi, [0, 1, 0])
    spin = trimesh.transformations.rotation_matrix(angle, [0, 0, 1])
    for mesh, _ in rings:
        mesh.apply_transform(turn)
        mesh.apply_transform(spin)
        mesh.apply_translation([0, 0, height])
    return rings


def _bonnet(low: float, radius: float, rise: float) -> Part:
    """Return the closed dome on top of the barrel."""
    angle = np.linspace(0.0, 0.5 * np.pi, 9)
    profile = np.stack([radius * np.cos(angle), low + rise * np.sin(angle)], axis=1)
    profile[-1, 0] = 0.0
    profile = np.concatenate([[[0.0, low]], profile])
    return trimesh.creation.revolve(profile, sections=32), _WHITE


def coloured_meshes() -> list[Part]:
    """Return closed meshes with their colours, metres, z up, foot at the origin."""
    result = [
        cylinder(0.165, 0.0, 0.035, _GREY),
        cylinder(0.12, 0.03, 0.075, _RED),
        cylinder(0.105, 0.07, 0.50, _RED),
        cylinder(0.118, 0.24, 0.265, _WHITE),
        cylinder(0.145, 0.49, 0.535, _RED),
        _bonnet(0.53, 0.125, 0.14),
        cylinder(0.05, 0.65, 0.69, _WHITE),
        cylinder(0.035, 0.68, HEIGHT, _YELLOW, 5),
    ]
    for k in range(8):
        bolt, colour = cylinder(0.014, 0.03, 0.055, _YELLOW, 6)
        angle = 2 * np.pi * (k + 0.5) / 8
        bolt.apply_translation([0.143 * np.cos(angle), 0.143 * np.sin(angle), 0])
        result.append((bolt, colour))
    result += _nozzle(0.0, 0.40, 0.068, 0.175)
    result += _nozzle(0.5 * np.pi, 0.41, 0.05, 0.165)
    result += _nozzle(-0.5 * np.pi, 0.41, 0.05, 0.165)
    return result


def world_mesh() -> trimesh.Trimesh:
    """Return all parts as one mesh with colours per vertex, metres, z up."""
    return merged(coloured_meshes())


def build(path: Path) -> None:
    """Write the hydrant as binary glTF."""
    write_glb(path, "hydrant", world_mesh())


def main() -> None:
    """Parse the arguments and build."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parent / "hydrant.glb"
    parser.add_argument("--out", type=Path, default=default)
    path = parser.parse_args().out
    build(path)
    print(path)


if __name__ == "__main__":
    main()
