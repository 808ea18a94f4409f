"""Errors of where objects stand, and of how the camera is mounted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_nerfattack.deploy.stress.pose_error import PoseError
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount

GIVEN = np.array([[0.1, -0.2, 0.3, 0.0, 0.4, 0.0], [0.0, 0.0, 0.0, 0.1, 0.2, 0.3]])


def test_objects_move_on_the_ground_and_turn_about_the_vertical():
    found = PoseError(placement_m=0.1, turn_deg=5.0).offsets(GIVEN, 7)
    moved = found[:, :3] - GIVEN[:, :3]
    assert (moved[:, :2] != 0).all() and (moved[:, 2] == 0).all()
    own, new = (Rotation.from_rotvec(item[:, 3:]) for item in (GIVEN, found))
    turns = (new * own.inv()).as_rotvec()
    assert (abs(turns[:, 2]) > 1e-3).all()
    np.testing.assert_allclose(turns[:, :2], 0, atol=1e-12)


def test_the_spread_is_as_given():
    error, zero = PoseError(0.2, 8.0, 3.0), np.zeros((1, 6))
    drawn = np.array([error.offsets(zero, seed)[0] for seed in range(800)])
    mount = CameraMount()
    pitches = [error.mount(mount, seed).pitch_deg for seed in range(800)]
    np.testing.assert_allclose(drawn[:, :2].std(0), 0.2, rtol=0.1)
    assert np.degrees(drawn[:, 5].std()) == pytest.approx(8.0, rel=0.1)
    assert np.std(pitches) == pytest.approx(3.0, rel=0.1)
    everything = [*drawn.T[[0, 1, 5]], np.array(pitches)]
    correlations = np.corrcoef(everything) - np.eye(4)
    assert abs(correlations).max() < 0.15
    assert abs(np.mean(everything[:2])) < 0.03


def test_the_seed_decides_and_a_further_object_moves_no_other():
    error = PoseError(0.1, 5.0, 1.0)
    np.testing.assert_array_equal(error.offsets(GIVEN, 3), error.offsets(GIVEN, 3))
    assert not np.array_equal(error.offsets(GIVEN, 3), error.offsets(GIVEN, 4))
    first = error.offsets(GIVEN[:1], 3)
    np.testing.assert_array_equal(error.offsets(GIVEN, 3)[:1], first)
    assert error.mount(CameraMount(), 3) == error.mount(CameraMount(), 3)


def test_without_errors_everything_is_what_it_was():
    mount = CameraMount()
    assert PoseError().offsets(GIVEN, 3) is GIVEN
    assert PoseError().mount(mount, 3) is mount
    # each is the same whether the others are there or not
    alone, both = PoseError(placement_m=0.1), PoseError(0.1, 5.0, 1.0)
    shifts = [item.offsets(GIVEN, 3)[:, :3] for item in (alone, both)]
    np.testing.assert_array_equal(*shifts)
    assert not PoseError(pitch_deg=1.0).moves_objects


def test_negative_spreads_are_refused():
    with pytest.raises(InputError, match="PoseError.turn_deg: -1.0"):
        PoseError(turn_deg=-1.0)
