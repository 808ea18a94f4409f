"""What sparse points tell of views."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.capture.coverage import nearest_points, view_gaps
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at

CAMERA = from_fov(40, 30, 60.0)
POINT = np.zeros((1, 3))


def around(*degrees):
    """Cameras on a circle of radius 2 about the origin, which they look at."""
    angles = np.radians(degrees)
    eyes = [[2 * np.cos(a), 2 * np.sin(a), 0] for a in angles]
    return [CAMERA] * len(eyes), np.stack([look_at(eye, [0, 0, 0]) for eye in eyes])


def test_angle_to_the_nearest_other_view():
    cameras, poses = around(0, 10, 25, 65)
    assert view_gaps(cameras, poses, POINT) == pytest.approx([10, 10, 15, 40])


def test_only_to_the_views_asked_for():
    cameras, poses = around(0, 10, 25, 65)
    others = np.array([True, False, False, True])
    gaps = view_gaps(cameras, poses, POINT, others)
    assert gaps == pytest.approx([65, 10, 25, 65])


def test_scale_and_frame_do_not_matter():
    cameras, poses = around(0, 10, 25, 65)
    points = np.random.default_rng(0).normal(size=(40, 3)) * 0.2
    gaps = view_gaps(cameras, poses, points)
    turned = look_at([1.0, 2, 3], [0, -1, 0])
    moved = poses.copy()
    moved[:, :3, 3] *= 7
    far = 7 * points @ turned[:3, :3].T + turned[:3, 3]
    assert view_gaps(cameras, turned @ moved, far) == pytest.approx(gaps)


def test_a_view_that_looks_away_is_no_neighbour():
    cameras, poses = around(0, 10, 30)
    poses[1, :3, :2] *= -1  # rolled by 180 degrees: sees it still
    assert view_gaps(cameras, poses, POINT)[0] == pytest.approx(10)
    poses[1] = look_at(poses[1, :3, 3], 2 * poses[1, :3, 3])
    assert view_gaps(cameras, poses, POINT) == pytest.approx([30, 180, 30])


def test_nothing_in_common():
    cameras, poses = around(0)
    assert view_gaps(cameras, poses, POINT) == pytest.approx([180])
    assert view_gaps(cameras, poses, np.zeros((0, 3))) == pytest.approx([180])


def test_the_middle_one_of_the_points_counts():
    cameras, poses = around(0, 20)
    near, far = [0.0, 0, 0], [-98.0, 0, 0]  # 20 and about 0.4 degrees
    for count, least, most in ((1, 19.9, 20.1), (3, 0.1, 0.8)):
        points = np.array([near] * 2 + [far] * count)
        gap = view_gaps(cameras, poses, points)[0]
        assert least < gap < most


def test_where_the_points_of_a_picture_begin():
    cameras, poses = around(0, 90)
    along = np.linspace(1.0, -1, 201)
    points = np.stack([along, 0 * along, 0 * along], axis=1)
    found = nearest_points(cameras, poses, points)  # 1 to 3 m before the first camera
    assert found[0] == pytest.approx(1.02, abs=0.01)  # but for 1 %
    assert found[1] == pytest.approx(2, abs=0.01)
    assert nearest_points(cameras, poses, points[::3]).tolist() == [0, 0]
