"""The film: the room with printed markers on its floor, blurred as by a shutter."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from bench.phone.light import LitRoom, lit
from bench.phone.walk import SHUTTER_S, Walk, phone
from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.capture.mesh.mesh import MeshPart, TexturedMesh, mitsuba_shapes
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.system.extras import load_extra

ROOM = Path(__file__).parents[2] / "scenes/room/scene.xml"
MARKER_M = 0.25
FAMILY = "apriltag_36h11"
PLACES = ((0.75, 0.45), (-0.7, 0.6), (-0.8, -0.5), (0.6, -0.65), (0.0, 0.05))
"""Middles of the markers on the floor by their ids, metres; each is turned more."""
_CELLS, _BORDER = 8, 1  # of a marker of 36 bits, white around it
_PRINT = (230, 55)  # sRGB of white and black
_FINE = 16  # texels of a cell
_ABOVE_M = 0.002
_TEXEL_M, _MARKER_TEXEL_M, _PATHS = 0.012, 0.002, 64


def light_room(
    folder: Path, camera: Camera, rays: int, progress: Callable[[str, int, int], None]
) -> LitRoom:
    """Load the bundled room with markers, and light it.

    Args:
        folder: that keeps the light.
        camera: intrinsics.
        rays: through each pixel of a frame.
        progress: called with stage, done and total.
    """
    markers = {f"marker_{i}": _marker(i) for i in range(len(PLACES))}
    scene = load_scene(ROOM, shapes=markers)
    others = [shape for shape in scene.shapes() if shape.id() not in markers]
    groups = {
        "room": (others, _TEXEL_M),
        "markers": (list(markers.values()), _MARKER_TEXEL_M),
    }
    return LitRoom(lit(folder, scene, groups, _PATHS, progress), camera, rays)


def marker_corners(number: int) -> np.ndarray:
    """Return the corners (4, 3) of a marker's black square as detectors order them."""
    half = 0.5 * MARKER_M
    square = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
    angle = _angle(number)
    cos, sin = math.cos(angle), math.sin(angle)
    turned = square @ np.array([[cos, sin], [-sin, cos]]) + PLACES[number]
    return np.column_stack([turned, np.full(4, _ABOVE_M)])


def _angle(number: int) -> float:
    return 0.4 * number


def _marker(number: int) -> Any:
    """Return a printed marker on the floor, as a mesh."""
    cv2 = load_extra("cv2", "markers", "a capture with markers")
    dictionary = cv2.aruco.getPredefinedDictionary(
        getattr(cv2.aruco, f"DICT_{FAMILY.upper()}")
    )
    cells = cv2.aruco.generateImageMarker(dictionary, number, _CELLS, borderBits=1)
    paper = np.pad(cells > 0, _BORDER, constant_values=True)
    grey = np.where(np.kron(paper, np.ones((_FINE, _FINE))), *_PRINT).astype(np.uint8)
    middle = np.array([*PLACES[number], _ABOVE_M])
    corners = middle + (1 + 2 * _BORDER / _CELLS) * (marker_corners(number) - middle)
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    texture = np.repeat(grey[..., None], 3, axis=2)
    faces = np.array([[0, 3, 2], [0, 2, 1]])  # seen from above
    part = MeshPart(corners, faces, uv=uv, texture=texture, wrap="clamp")
    [shape] = mitsuba_shapes(TexturedMesh(f"marker {number}", (part,))).values()
    return shape


def shoot(
    folder: Path,
    walk: Walk,
    fps: float,
    rays: int,
    progress: Callable[[str, int, int], None],
) -> Path:
    """Render the frames of a film that are not there yet, and encode them.

    Args:
        folder: gets `frames`, `truth.json` with their poses, and `film.mp4`.
        walk: where the phone is.
        fps: frames per second.
        rays: through each pixel, spread over the time that the shutter is open.
        progress: called with stage, done and total.

    Returns:
        path of the film.
    """
    film, stills = folder / "film.mp4", files.make_folder(folder / "frames")
    times = np.arange(round(walk.seconds * fps)) / fps
    if film.is_file():
        return film
    middle = [walk.pose(time + 0.5 * SHUTTER_S).tolist() for time in times]
    exposure = [walk.exposure(time) for time in times]
    truth = {"fps": fps, "camera_to_world": middle, "exposure": exposure}
    files.write_json(folder / "truth.json", truth)
    paths = [stills / f"{i:05d}.png" for i in range(len(times))]
    lit_room = light_room(folder, phone(), rays, progress)
    open_s = (np.arange(rays) + 0.5) / rays * SHUTTER_S
    for i, (time, path) in enumerate(zip(times, paths, strict=True)):
        progress("film", i, len(times))
        if not path.is_file():
            poses = np.stack([walk.pose(time + after) for after in open_s])
            image = exposure[i] * lit_room.picture(poses)
            files.write_image(path, linear_to_uint8(image))
    progress("film", len(times), len(times))
    write_video(film, (files.read_image(path) for path in paths), fps)
    return film
