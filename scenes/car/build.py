"""Write car.glb: a saloon, 4.2 m long, 1.8 m wide and 1.45 m tall, of no make.

Run ``python -m mi_nerfattack.scenes.car.build [--out FILE]``. The file holds one mesh
with colours per vertex. As glTF asks, its y axis points up; `world_mesh` holds the same
parts with z up, metres, the middle between the wheels' feet at the origin, and the
front towards +x.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ..solids import Colour, Part, box, cylinder, loft, merged, trimesh, write_glb

HEIGHT = 1.45
_PAINT, _TRIM, _RUBBER = (12, 54, 140, 255), (9, 10, 11, 255), (4, 4, 5, 255)
_GLASS, _ALLOY, _WHITE = (16, 24, 32, 255), (130, 134, 138, 255), (215, 215, 205, 255)
_LAMP, _TAIL, _AMBER = (235, 230, 200, 255), (130, 4, 6, 255), (205, 70, 4, 255)

# x, lower edge, sill, waist and upper edge in z, half width at the waist and above
_SECTIONS = [
    (-2.09, 0.34, 0.42, 0.70, 0.84, 0.74, 0.66),
    (-2.02, 0.24, 0.34, 0.72, 0.92, 0.83, 0.74),
    (-1.70, 0.20, 0.30, 0.74, 0.96, 0.88, 0.78),
    (-1.20, 0.18, 0.28, 0.74, 0.97, 0.90, 0.80),
    (0.70, 0.18, 0.28, 0.72, 0.93, 0.90, 0.80),
    (1.30, 0.20, 0.30, 0.70, 0.87, 0.89, 0.78),
    (1.80, 0.22, 0.32, 0.66, 0.77, 0.86, 0.74),
    (2.02, 0.26, 0.36, 0.58, 0.68, 0.78, 0.66),
    (2.09, 0.32, 0.40, 0.52, 0.58, 0.68, 0.58),
]
# z, rear and front in x, half width of the cabin
_CABIN = [
    (0.92, -1.72, 0.98, 0.82),
    (0.96, -1.62, 0.90, 0.80),
    (1.34, -1.08, 0.26, 0.64),
    (1.41, -0.94, 0.14, 0.60),
    (HEIGHT, -0.74, -0.06, 0.46),
]
# along a side from the rear to the front, and along the front or rear: edges of glass
_SIDE_GLASS = [(0.13, 0.30), (0.34, 0.62), (0.66, 0.93)]
_END_GLASS = [(0.06, 0.94)]
_AXLES, _WHEEL_RADIUS = (-1.28, 1.28), 0.31


def _body() -> Part:
    """Return the lower body, with sills of another colour."""
    rings = []
    for x, low, sill, waist, top, wide, narrow in _SECTIONS:
        half = [(0.86 * wide, low), (0.97 * wide, sill), (wide, waist), (narrow, top)]
        mirrored = [(-y, z) for y, z in reversed(half)]
        rings.append([(x, y, z) for y, z in half + mirrored])
    around = [_TRIM, *[_PAINT] * 5, _TRIM, _TRIM]
    return loft(np.array(rings), [around] * (len(rings) - 1), (_PAINT, _PAINT))


def _glazed(edges: list[tuple[float, float]]) -> tuple[list[float], list[Colour]]:
    """Return where an edge of length 1 is divided, and the colours between."""
    marks, colours = [0.0], []
    for first, last in edges:
        marks += [first, last]
        colours += [_PAINT, _GLASS]
    return marks, [*colours, _PAINT]


def _cabin() -> Part:
    """Return windows, pillars and roof."""
    (along, side), (across, end) = _glazed(_SIDE_GLASS), _glazed(_END_GLASS)
    rings = []
    for z, rear, front, half in _CABIN:
        corners = [(rear, -half), (front, -half), (front, half), (rear, half)]
        marks = [along, across, [0.0, *(1 - s for s in along[:0:-1])], across]
        ring = []
        for (x, y), (u, v), places in zip(
            corners, corners[1:] + corners[:1], marks, strict=True
        ):
            ring += [(x + s * (u - x), y + s * (v - y), z) for s in places]
        rings.append(ring)
    glazed = [*side, *end, *reversed(side), *end]
    plain: list[Colour] = [_PAINT] * len(glazed)
    return loft(np.array(rings), [plain, glazed, plain, plain], (_PAINT, _PAINT))


def _wheel(x: float, side: int) -> list[Part]:
    """Return arch, tyre, rim and hub of a wheel."""
    angle = np.linspace(0.0, np.pi, 17)
    arch = 0.375 * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    rings = [[(*point, z) for point in arch[::-1]] for z in (0.60, 0.88)]
    discs = [
        loft(np.array(rings), [[_TRIM] * len(angle)], (_TRIM, _TRIM)),
        cylinder(_WHEEL_RADIUS, 0.66, 0.885, _RUBBER),
        cylinder(0.21, 0.80, 0.89, _ALLOY),
        cylinder(0.15, 0.80, 0.893, _TRIM),
        cylinder(0.06, 0.80, 0.90, _ALLOY, 12),
    ]
    for k in range(5):
        spoke, colour = box((0, 0.1, 0.85), (0.05, 0.2, 0.09), _ALLOY)
        spin = trimesh.transformations.rotation_matrix(0.4 * np.pi * k, [0, 0, 1])
        discs.append((spoke.apply_transform(spin), colour))
    # the axis of side -1 points to -y, of side 1 to +y; what was -y points up
    turn = trimesh.transformations.rotation_matrix(-0.5 * np.pi, [1, 0, 0])
    spin = trimesh.transformations.rotation_matrix(0.5 * np.pi * (1 - side), [0, 0, 1])
    for mesh, _ in discs:
        mesh.apply_transform(spin @ turn)
        mesh.apply_translation([x, 0, _WHEEL_RADIUS])
    return discs


def _details() -> list[Part]:
    """Return bumpers, lamps, grille, number plates, mirrors, handles and seams."""
    details = [
        box((2.03, 0, 0.37), (0.13, 1.42, 0.13), _TRIM),
        box((-2.03, 0, 0.39), (0.13, 1.54, 0.15), _TRIM),
        box((2.05, 0, 0.51), (0.09, 0.74, 0.08), _TRIM),
        box((2.085, 0, 0.38), (0.03, 0.46, 0.10), _WHITE),
        box((-2.085, 0, 0.60), (0.03, 0.46, 0.11), _WHITE),
    ]
    for side in (-1, 1):
        details += [
            box((2.00, 0.56 * side, 0.585), (0.14, 0.26, 0.11), _LAMP),
            box((1.94, 0.73 * side, 0.58), (0.14, 0.10, 0.09), _AMBER),
            box((-2.05, 0.60 * side, 0.77), (0.10, 0.24, 0.13), _TAIL),
            box((-1.99, 0.77 * side, 0.76), (0.14, 0.10, 0.12), _TAIL),
            box((0.62, 0.85 * side, 1.00), (0.12, 0.10, 0.12), _PAINT),
        ]
        for x in (0.60, -0.32, -1.02):
            details.append(box((x, 0.885 * side, 0.56), (0.03, 0.03, 0.40), _TRIM))
        for x in (-0.12, -0.86):
            details.append(box((x, 0.885 * side, 0.72), (0.16, 0.035, 0.04), _ALLOY))
    return details


def coloured_meshes() -> list[Part]:
    """Return closed meshes with their colours, metres, z up, front towards +x."""
    wheels = [part for x in _AXLES for side in (-1, 1) for part in _wheel(x, side)]
    return [_body(), _cabin(), *wheels, *_details()]


def world_mesh() -> trimesh.Trimesh:
    """Return all parts as one mesh with colours per vertex, metres, z up."""
    return merged(coloured_meshes())


def build(path: Path) -> None:
    """Write the car as binary glTF."""
    write_glb(path, "car", world_mesh())


def main() -> None:
    """Parse the arguments and build."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path(__file__).parent / "car.glb"
    parser.add_argument("--out", type=Path, default=default)
    path = parser.parse_args().out
    build(path)
    print(path)


if __name__ == "__main__":
    main()
