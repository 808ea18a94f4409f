"""Late and lost frames, late controls: what a policy sees, and what the car does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.faults.refusals import refusals
from support.worlds.places import Grey, PaintedEnvironment, straight

from mi_nerfattack.deploy.stress.pose_error import PoseError
from mi_nerfattack.deploy.stress.timing import DroppedFrames, LateControls, LateFrames
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov

pytestmark = pytest.mark.usefixtures("variant")

CONTROLS = (0.3, -0.2, 0.5, 0.1, -0.4, 0.0, 0.2, 0.6)
START = np.array([1.0, 0.3, 0.1])


def environment() -> PaintedEnvironment:
    return PaintedEnvironment(from_fov(4, 2, 90.0), Grey())


def run(around, seed=3, control=None):
    """Return what is seen of a drive with given controls, and the states."""
    frames = [around.reset(straight(), START, seed)]
    states = [around.state.copy()]
    for own in CONTROLS:
        frames.append(around.step(own if control is None else control))
        states.append(around.state.copy())
    return [frame.image[0, 0] for frame in frames], states


@pytest.mark.parametrize(
    ("frames", "controls"), [(0, 0), (1, 0), (0, 3), (3, 1), (1, 3)]
)
def test_frames_and_controls_come_so_many_periods_late(frames, controls):
    """Also around each other, and in a second drive."""
    inside = environment()
    plain, _ = run(LateControls(environment(), controls))
    around = LateFrames(LateControls(DroppedFrames(inside, 0.0), controls), frames)
    assert around.camera == inside.camera and around.name == inside.name
    for _ in range(2):
        images, states = run(around)
        held = np.diff([state[2] for state in states]) / inside.period
        expected = [0.0] * controls + list(CONTROLS[: len(CONTROLS) - controls])
        np.testing.assert_allclose(held, expected, atol=1e-12)
        expected = [plain[max(0, k - frames)] for k in range(len(plain))]
        np.testing.assert_array_equal(images, expected)
    around.show(["object"])
    assert inside.objects == ["object"] and not around.is_over
    around.reset(straight(), START)
    around.advance(0.1)
    np.testing.assert_array_equal(around.state, inside.state)


test_what_is_refused = refusals(
    (lambda: LateFrames(environment(), -1), "late: -1"),
    (lambda: LateControls(environment(), 0.5), "latency: 0.5"),
    (lambda: DroppedFrames(environment(), 1.5), "dropped: 1.5"),
    (lambda: run(LateControls(environment(), 3), control=np.nan), "control: nan"),
    (lambda: DroppedFrames(environment(), 0.1).step(0.0), "step comes after reset"),
    (lambda: PoseError(turn_deg=-1.0), "PoseError.turn_deg: -1.0"),
)


def test_a_lost_frame_repeats_the_last_one_and_the_car_goes_on():
    plain, plain_states = run(environment())
    lossy = DroppedFrames(environment(), 0.5)
    images, states = run(lossy)
    np.testing.assert_array_equal(states, plain_states)
    lost = 0
    for k in range(1, len(images)):
        if not np.array_equal(images[k], plain[k]):
            np.testing.assert_array_equal(images[k], images[k - 1])
            lost += 1
    assert 0 < lost < len(CONTROLS)
    # the seed of the drive decides which, whatever was driven before
    np.testing.assert_array_equal(run(lossy)[0], images)
    assert any(not np.array_equal(run(lossy, s)[0], images) for s in range(4, 9))
    nothing, _ = run(DroppedFrames(environment(), 1.0))
    assert all(np.array_equal(item, plain[0]) for item in nothing)


OFFSETS = np.array([[0.1, -0.2, 0.3, 0.0, 0.4, 0.0], [0.0, 0.0, 0.0, 0.1, 0.2, 0.3]])


def test_objects_move_on_the_ground_and_turn_about_the_vertical():
    offsets = PoseError(placement_m=0.1, turn_deg=5.0).offsets(OFFSETS, 7)
    moved = offsets[:, :3] - OFFSETS[:, :3]
    assert (moved[:, :2] != 0).all() and (moved[:, 2] == 0).all()
    own, new = (Rotation.from_rotvec(item[:, 3:]) for item in (OFFSETS, offsets))
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


def test_each_error_is_drawn_by_the_seed_alone():
    """Whatever other errors and further objects there are; none changes nothing."""
    error, mount = PoseError(0.1, 5.0, 1.0), CameraMount()
    offsets = error.offsets(OFFSETS, 3)
    np.testing.assert_array_equal(error.offsets(OFFSETS, 3), offsets)
    assert not np.array_equal(error.offsets(OFFSETS, 4), offsets)
    np.testing.assert_array_equal(error.offsets(OFFSETS[:1], 3), offsets[:1])
    alone = PoseError(placement_m=0.1).offsets(OFFSETS, 3)
    np.testing.assert_array_equal(alone[:, :3], offsets[:, :3])
    assert error.mount(mount, 3) == error.mount(mount, 3)
    assert PoseError().offsets(OFFSETS, 3) is OFFSETS
    assert PoseError().mount(mount, 3) is mount
    assert not PoseError(pitch_deg=1.0).moves_objects
