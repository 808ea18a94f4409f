"""Late and lost frames, late controls: what a policy sees, and what the car does."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.roadside import Grey, PaintedEnvironment, straight

from mi_nerfattack.deploy.driving import drive
from mi_nerfattack.deploy.stress.timing import DroppedFrames, LateControls, LateFrames
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov

pytestmark = pytest.mark.usefixtures("variant")

CONTROLS = (0.3, -0.2, 0.5, 0.1, -0.4, 0.0, 0.2, 0.6)
START = np.array([1.0, 0.3, 0.1])


class ByTheImage(AbstractPolicy):
    """Gives the mean of the image, so that what is seen decides."""

    def initial_memory(self, count):
        del count
        return ()

    def step(self, image, goal, memory):
        del goal
        value = float(image.numpy().mean(dtype=np.float64)) - 0.5
        return dr.opaque(mi.Float, value, 1), memory

    def control(self, image, goal):
        raise AssertionError("a policy is asked for steps")

    def vjp(self, image, goal, cotangent):
        raise AssertionError("a drive needs no derivative")


def environment() -> PaintedEnvironment:
    return PaintedEnvironment(from_fov(4, 2, 90.0), Grey())


def run(around, seed=3):
    """Return what is seen of a drive with given controls, and the states."""
    frames = [around.reset(straight(), START, seed)]
    states = [around.state.copy()]
    for control in CONTROLS:
        frames.append(around.step(control))
        states.append(around.state.copy())
    return [frame.image[0, 0] for frame in frames], states


@pytest.mark.parametrize("periods", [1, 3])
def test_late_frames_are_those_of_so_many_periods_before(periods):
    plain, plain_states = run(environment())
    seen, states = run(LateFrames(environment(), periods))
    np.testing.assert_array_equal(states, plain_states)
    expected = [plain[max(0, k - periods)] for k in range(len(plain))]
    np.testing.assert_array_equal(seen, expected)


def test_a_lost_frame_repeats_the_last_one_and_the_car_goes_on():
    plain, plain_states = run(environment())
    lossy = DroppedFrames(environment(), 0.5)
    seen, states = run(lossy)
    np.testing.assert_array_equal(states, plain_states)
    lost = 0
    for k in range(1, len(seen)):
        if not np.array_equal(seen[k], plain[k]):
            np.testing.assert_array_equal(seen[k], seen[k - 1])
            lost += 1
    assert 0 < lost < len(CONTROLS)
    # the seed of the drive decides which, whatever was driven before
    again, _ = run(lossy)
    np.testing.assert_array_equal(again, seen)
    other = [run(lossy, seed)[0] for seed in range(4, 9)]
    assert any(not np.array_equal(item, seen) for item in other)
    nothing, _ = run(DroppedFrames(environment(), 1.0))
    assert all(np.array_equal(item, plain[0]) for item in nothing)


@pytest.mark.parametrize("periods", [1, 3])
def test_late_controls_are_those_of_so_many_periods_before(periods):
    inside = environment()
    _, states = run(LateControls(inside, periods))
    held = np.diff([state[2] for state in states]) / inside.period
    expected = [0.0] * periods + list(CONTROLS[: len(CONTROLS) - periods])
    np.testing.assert_allclose(held, expected, atol=1e-12)
    _, again = run(LateControls(inside, periods))
    np.testing.assert_array_equal(again, states)


def test_around_each_other_each_does_its_part():
    """Frames two periods late of a car whose controls come one period late."""
    plain, _ = run(LateControls(environment(), 1))
    seen, _ = run(LateFrames(LateControls(environment(), 1), 2))
    expected = [plain[max(0, k - 2)] for k in range(len(plain))]
    np.testing.assert_array_equal(seen, expected)


def test_without_strength_drives_are_bit_equal():
    plain = environment()
    around = LateControls(LateFrames(DroppedFrames(environment(), 0.0), 0), 0)
    drives = [
        drive(item, ByTheImage(), straight(), START, 5, 20) for item in (plain, around)
    ]
    for name, array in drives[0].arrays().items():
        np.testing.assert_array_equal(drives[1].arrays()[name], array)
    assert drives[0].controls.std() > 0
    assert around.camera == plain.camera and around.name == plain.name
    late = drive(LateFrames(plain, 1), ByTheImage(), straight(), START, 5, 20)
    assert not np.array_equal(late.controls, drives[0].controls)


def test_what_is_shown_is_shown_inside():
    inside = environment()
    around = LateFrames(DroppedFrames(LateControls(inside, 1), 0.5), 1)
    around.show(["object"])
    assert inside.objects == ["object"]
    assert not around.is_over
    around.reset(straight(), START)
    around.advance(0.1)
    assert len(inside.states) >= 1
    np.testing.assert_array_equal(around.state, inside.state)


@pytest.mark.parametrize(
    ("make", "value", "message"),
    [
        (LateFrames, -1, "late: -1; a whole number of control periods"),
        (LateControls, 0.5, "latency: 0.5; a whole number"),
        (DroppedFrames, 1.5, r"dropped: 1.5; a share of frames in \[0, 1\]"),
    ],
)
def test_other_strengths_are_refused(make, value, message):
    with pytest.raises(InputError, match=message):
        make(environment(), value)


def test_a_control_that_is_not_finite_is_refused_at_once():
    around = LateControls(environment(), 3)
    around.reset(straight(), START)
    with pytest.raises(InputError, match="control: nan"):
        around.step(float("nan"))
    with pytest.raises(InputError, match="step comes after reset"):
        DroppedFrames(environment(), 0.1).step(0.0)
