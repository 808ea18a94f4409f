"""What sparse points tell of views."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.coverage import nearest_points, view_gaps
from mi_nerfattack.capture.photographs.quality import (
    assess,
    median_gap,
    quality_table,
    retake,
)
from mi_nerfattack.io import files
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
    others = np.array([True, False, False, True])
    gaps = view_gaps(cameras, poses, POINT, others)
    assert gaps == pytest.approx([65, 10, 25, 65])
    for points in (POINT, POINT[:0]):  # nothing in common
        gaps = view_gaps(cameras[:1], poses[:1], points)
        assert gaps == pytest.approx([180])


def test_a_view_that_looks_away_is_no_neighbour():
    cameras, poses = around(0, 10, 30)
    poses[1, :3, :2] *= -1  # rolled by 180 degrees: sees it still
    assert view_gaps(cameras, poses, POINT)[0] == pytest.approx(10)
    poses[1] = look_at(poses[1, :3, 3], 2 * poses[1, :3, 3])
    assert view_gaps(cameras, poses, POINT) == pytest.approx([30, 180, 30])


def test_the_middle_one_of_the_points_counts():
    cameras, poses = around(0, 20)
    near, far = [0.0, 0, 0], [-98.0, 0, 0]  # 20 and about 0.4 degrees
    for count, gap in ((1, 20), (3, 0.4)):
        points = np.array([near] * 2 + [far] * count)
        assert view_gaps(cameras, poses, points)[0] == pytest.approx(gap, abs=0.1)


def test_where_the_points_of_a_picture_begin():
    cameras, poses = around(0, 90)
    along = np.linspace(1.0, -1, 201)
    points = np.stack([along, 0 * along, 0 * along], axis=1)
    # 1 to 3 m before the first camera
    distances = nearest_points(cameras, poses, points)
    assert distances[0] == pytest.approx(1.02, abs=0.01)  # but for 1 %
    assert distances[1] == pytest.approx(2, abs=0.01)
    assert nearest_points(cameras, poses, points[::3]).tolist() == [0, 0]


LENS = from_fov(120, 90, 60.0)
COUNT, BLURRED, LOST, BARE, ALONE = 12, 4, 7, 9, 11


@pytest.fixture
def taken(tmp_path):
    """Twelve photographs: one blurred, one that was not placed, one of few features."""
    rng = np.random.default_rng(1)
    names = [f"{i:02d}.png" for i in range(COUNT)]
    for i, name in enumerate(names):
        grey = rng.integers(0, 256, (90, 120)).astype(float)
        grey = ndimage.gaussian_filter(grey, 3.0) if i == BLURRED else grey
        image = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
        files.write_image(tmp_path / name, image)
    placed = [i for i in range(COUNT) if i != LOST]
    angles = [i / 12 + 0.6 * (i == ALONE) for i in placed]
    poses = [look_at([np.cos(a), np.sin(a), 1.0], [0, 0, 0]) for a in angles]
    structure = Structure(
        tuple(names[i] for i in placed),
        np.stack(poses),
        (LENS,) * len(placed),
        rng.normal(size=(50, 3)),
        0.6,
        tuple(40 if i == BARE else 900 for i in placed),
        tuple(0.1 * i for i in placed),
        {name: 120 if i == BARE else 2000 for i, name in enumerate(names)},
    )
    return tmp_path, names, structure


def test_what_to_take_again(taken):
    folder, names, structure = taken
    qualities = assess(folder, names, structure)
    again = retake(qualities)
    assert list(again) == [names[i] for i in (BLURRED, LOST, BARE, ALONE)]
    reasons = [why.partition(" ")[0] for why in again.values()]
    assert reasons == ["blurred", "not", "few", "alone,"]
    assert "120" in again[names[BARE]] and "40" in again[names[BARE]]
    gaps = [quality.gap_deg for quality in qualities]
    assert gaps.pop(LOST) is None and gaps[-1] == max(gaps)
    assert qualities[3].error_px == pytest.approx(0.3)
    assert qualities[LOST].error_px is None and qualities[LOST].features == 2000
    table = quality_table(structure, qualities, {"metres_per_unit": None})
    assert (table["photographs"], table["placed"]) == (COUNT, COUNT - 1)
    assert table["placed_share"] == pytest.approx((COUNT - 1) / COUNT)
    assert table["frames"][BARE]["points"] == 40 and table["retake"] == again
    assert table["gap_deg"] == median_gap(qualities) == pytest.approx(np.median(gaps))
