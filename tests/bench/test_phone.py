"""The made phone video: its path, its markers and the light that is computed once."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from bench.phone.chain import exposed_as
from bench.phone.film import FAMILY, PLACES, SHUTTER_S, _marker, marker_corners
from bench.phone.light import LitRoom, lit
from bench.phone.walk import Walk, phone
from mi_nerfattack.capture.mesh.mesh import MeshPart, TexturedMesh, mitsuba_shapes
from mi_nerfattack.capture.photographs.markers import detect_markers
from mi_nerfattack.render.camera.intrinsics import look_at
from scenes.room.layout import LENGTH, WIDTH

pytestmark = pytest.mark.usefixtures("variant")


def test_a_walk_stays_in_the_room_and_is_of_its_seed():
    walk, other = Walk(60.0, 1), Walk(60.0, 2)
    poses = np.stack([walk.pose(time) for time in np.arange(0, 60, 0.25)])
    eyes, turns = poses[:, :3, 3], poses[:, :3, :3]
    assert (np.abs(eyes[:, :2]) < [LENGTH / 2 - 0.5, WIDTH / 2 - 0.5]).all()
    np.testing.assert_allclose(
        turns.swapaxes(1, 2) @ turns, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-9
    )
    rolls = np.degrees(np.arcsin(turns[:, 2, 0]))
    assert 3 < rolls.std() < 12  # the picture's right against the horizon
    exposures = np.log2([walk.exposure(time) for time in np.arange(0, 60, 0.25)])
    assert 0.1 < exposures.std() < 0.5
    np.testing.assert_array_equal(Walk(60.0, 1).pose(7.0), walk.pose(7.0))
    assert np.abs(other.pose(7.0) - walk.pose(7.0)).max() > 1e-3


def test_a_picture_is_blurred_by_pixels_not_by_dozens():
    walk, camera = Walk(60.0, 1), phone()
    moved = []
    for time in np.arange(0, 60, 0.5):
        before, after = walk.pose(time), walk.pose(time + SHUTTER_S)
        point = after[:3, :3].T @ (before[:3, :3] @ [0, 0, 3] + before[:3, 3])
        point -= after[:3, :3].T @ after[:3, 3]
        moved.append(camera.fx * np.linalg.norm(point[:2] / point[2]))
    assert 0.5 < np.median(moved) < 4 and np.max(moved) < 15


def floor() -> mi.Shape:
    corners = np.array([[-2.0, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
    part = MeshPart(corners, np.array([[0, 1, 2], [0, 2, 3]]), (0.5, 0.4, 0.3))
    [shape] = mitsuba_shapes(TexturedMesh("floor", (part,))).values()
    return shape


def test_markers_are_where_they_are_said_to_be(tmp_path):
    pytest.importorskip("cv2")
    ground, markers = floor(), [_marker(number) for number in range(len(PLACES))]
    named = {f"marker_{number}": marker for number, marker in enumerate(markers)}
    sky, path = {"type": "constant"}, {"type": "path", "max_depth": 2}
    scene = mi.load_dict(
        {"type": "scene", "integrator": path, "sky": sky, "floor": ground, **named}
    )
    groups = {"floor": ([ground], 0.05), "markers": (markers, 0.002)}
    shapes = lit(tmp_path, scene, groups, 64, lambda *_: None)
    camera = phone()
    pose = look_at(np.array([0.2, -1.8, 2.2]), np.array([0.0, 0.0, 0.0]))
    image = LitRoom(shapes, camera, 4).picture(np.tile(pose, (4, 1, 1)))
    grey = np.round(255 * image.mean(2).clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    found = detect_markers(grey, FAMILY)
    assert sorted(found) == list(range(len(PLACES)))
    off = []
    for number, pixels in found.items():
        local = (marker_corners(number) - pose[:3, 3]) @ pose[:3, :3]
        wanted = local[:, :2] / local[:, 2:] * camera.fx + [camera.cx, camera.cy]
        off.append(pixels - wanted)
    # OpenCV misses single corners of small markers by a pixel
    assert np.median(np.abs(off)) < 0.3 and np.abs(np.median(off, (0, 1))).max() < 0.15
    # under an even sky a matt floor shows its reflectance
    np.testing.assert_allclose(image[-1, 0], [0.5, 0.4, 0.3], rtol=0.03)
    again = lit(tmp_path, scene, groups, 64, lambda *_: pytest.fail("lit again"))
    assert len(again) == 2


def test_exposure_of_each_channel_is_taken_over():
    image = np.random.default_rng(3).uniform(0.05, 0.6, (20, 30, 3))
    linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    brighter = linear * [1.3, 0.8, 1.1]
    wanted = np.where(
        brighter <= 0.0031308, 12.92 * brighter, 1.055 * brighter ** (1 / 2.4) - 0.055
    )
    np.testing.assert_allclose(exposed_as(image, wanted), wanted, atol=1e-4)
