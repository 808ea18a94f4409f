"""The closed loop through fields, and its adjoints, in single precision."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import central_difference, nothing_compiled
from support.worlds import loops as toy
from support.worlds.loops import (
    ADJOINTS,
    INITIAL,
    OFFSET,
    along_texture,
    gradient,
    make_rollout,
    objective,
    texture_gradient,
    unit,
)

from mi_nerfattack.attack.base import offset_gradients
from mi_nerfattack.deploy.surrogate.scene import field_sensor, showing
from mi_nerfattack.render import composite, rays
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.rollout import sweep
from mi_nerfattack.rollout.loop import CameraPath
from mi_nerfattack.rollout.sensor import AbstractSensor
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.integrators import RK4, ImplicitMidpoint

pytestmark = pytest.mark.usefixtures("variant")

DISTURBANCE = Disturbance(exposure_ev_sd=0.5, blur_px_sd=0.8, noise_sd=0.02, seed=3)
POSES = np.array([[0.0, 0.35, 0.02], [0.1, 0.2, -0.03]])


@pytest.mark.parametrize(
    ("horizon", "changes"),
    [
        *((horizon, {"integrator": RK4()}) for horizon in (1, 2, 10)),
        (3, {"integrator": ImplicitMidpoint()}),
        (3, {"jitter_seed": 7}),
        (3, {"composite": "interleaved"}),
        (3, {"jitter_seed": 7, "disturbance": DISTURBANCE}),
    ],
)
def test_attached_gradient_is_that_of_the_whole_loop(horizon, changes, rng):
    loop, item = toy.make_loop(**changes)  # Euler feels a control after two steps
    rollout = make_rollout(loop, horizon, attached=True)
    derivative = texture_gradient(rollout)
    along = unit(derivative)
    for direction in (
        along,
        unit(along + 0.5 * unit(rng.normal(size=derivative.shape))),
    ):
        value = along_texture(rollout, item, direction)
        expected = float((derivative * direction).sum())
        assert central_difference(value, 0.2) == pytest.approx(expected, rel=1e-3)


def test_detached_gradient_of_disturbed_drives_holds_the_camera_path(rng):
    loop, item = toy.make_loop(jitter_seed=7, disturbance=DISTURBANCE)
    rollout = make_rollout(loop, 4)
    evaluation = rollout.run(loop.initial(POSES))
    derivative = rollout.gradient(evaluation).textures[0].numpy().astype(float)
    held = replace(rollout, camera_path=CameraPath(evaluation.trajectory.states))
    base, direction = toy.texture_of(item), unit(rng.normal(size=derivative.shape))
    direction = unit(unit(derivative) + 0.5 * direction)

    def value(s):
        loop.sensor.set_textures([(base + s * direction).astype(np.float32)])
        return objective(held, POSES)

    expected = float((derivative * direction).sum())
    assert central_difference(value, 0.2) == pytest.approx(expected, rel=1e-3)


def test_attached_gradient_by_the_initial_state():
    loop, _ = toy.make_loop()
    rollout = make_rollout(loop, 5, attached=True)
    by_start = np.array(gradient(rollout).initial)[:, 0]
    for axis, step in ((0, 4e-2), (1, 4e-2), (2, 1e-2)):

        def value(s, axis=axis):
            moved = INITIAL.copy()
            moved[0, axis] += s
            return objective(rollout, moved)

        expected = pytest.approx(
            by_start[axis], rel=1e-3, abs=1e-3 * np.abs(by_start).max()
        )
        assert central_difference(value, step) == expected


@pytest.mark.parametrize(
    ("composite", "axes"), [("depth", range(6)), ("interleaved", [2])]
)
def test_gradient_by_the_pose_of_an_object(composite, axes):
    loop, _ = toy.make_loop(composite=composite)
    rollout = make_rollout(loop, 4, attached=True)
    (item,) = loop.sensor.objects
    item.move(OFFSET[0])
    by_pose = offset_gradients(
        loop.sensor, gradient(rollout, extra_keys=loop.sensor.pose_keys)
    )
    for axis in axes:

        def value(s, axis=axis):
            item.move(OFFSET[0] + s * np.eye(6)[axis])
            return objective(rollout)

        # samples that cross the faces of cells, kinks of the field, cost accuracy, as
        # do the ends of the interval on the ray, which count as constants
        scale = np.abs(by_pose[0, 3 * (axis // 3) :][:3]).max()
        expected = pytest.approx(by_pose[0, axis], rel=2e-2, abs=2e-2 * scale)
        assert central_difference(value, 3e-3) == expected


def test_euler_needs_two_steps_to_feel_a_control():
    loop, _ = toy.make_loop()
    derivative = gradient(make_rollout(loop, 1, attached=True))
    assert not derivative.textures[0].numpy().any()
    assert derivative.costates.shape == (1, 1, 3)


def test_a_batch_is_one_sequence_of_launches():
    loop, _ = toy.make_loop()
    rollout = make_rollout(loop, 3, adjoint="kept")
    counts = []
    for size in (8, 16):  # fewer go through the policy with those of other periods
        poses = np.repeat(INITIAL, size, 0) + 0.01 * np.arange(size)[:, None]
        gradient(rollout, poses)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            gradient(rollout, poses + 0.003)
            history = dr.kernel_history((dr.KernelType.JIT,))
        counts.append(len(history))
    assert counts[0] == counts[1] > 0


def test_jitter_is_replayed():
    loop, _ = toy.make_loop(jitter_seed=7)
    state = loop.initial(INITIAL)
    a = loop.sensor.observe(state, 3).image.numpy()
    assert np.array_equal(a, loop.sensor.observe(state, 3).image.numpy())
    assert not np.array_equal(a, loop.sensor.observe(state, 4).image.numpy())


def test_adjoints_agree_and_compile_nothing_after_the_first_steps():
    loop, _ = toy.make_loop(jitter_seed=7, disturbance=DISTURBANCE)
    gradients = {}
    for adjoint in ADJOINTS:
        gradient(make_rollout(loop, 4, adjoint=adjoint), POSES)
        with nothing_compiled():
            rollout = make_rollout(loop, 4, adjoint=adjoint)
            gradients[adjoint] = texture_gradient(rollout, POSES + 0.07)
    for name in ("kept", "checkpointed"):
        error = np.linalg.norm(gradients[name] - gradients["replay"])
        assert error <= 1e-6 * np.linalg.norm(gradients["replay"])


def test_memory_does_not_grow_with_the_horizon(monkeypatch):
    monkeypatch.setattr(rays, "FIRST_RAYS", 64)  # wait for a launch, not more
    loop, _ = toy.make_loop(disturbance=DISTURBANCE)
    backend = dr.backend_v(mi.Float)

    def peak(horizon):
        gc.collect()  # what other tests left
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        gradient(make_rollout(loop, horizon))
        dr.sync_thread()
        return dr.detail.malloc_watermark(backend)

    peak(4)
    assert peak(32) <= 1.05 * peak(8)


def test_the_heap_is_released_after_each_derivative_of_the_policy(monkeypatch):
    calls = []
    monkeypatch.setattr(sweep, "release_heap", lambda: calls.append(None))
    gradient(make_rollout(toy.make_loop()[0], 2 * sweep.POLICY_BATCH + 1))
    assert len(calls) == 3


@pytest.mark.parametrize("adjoint", ADJOINTS)
@pytest.mark.parametrize(
    "changes",
    [{"jitter_seed": 7, "disturbance": DISTURBANCE}, {"composite": "interleaved"}],
)
def test_periods_together_give_the_gradient_of_periods_alone(
    adjoint, changes, monkeypatch
):
    """Rays that wait for a launch, and images for the policy, lose nothing."""
    loop, _ = toy.make_loop(**changes)
    rollout = make_rollout(loop, 11, adjoint=adjoint)
    together = texture_gradient(rollout, POSES)
    monkeypatch.setattr(sweep, "POLICY_BATCH", 1)
    monkeypatch.setattr(rays, "FIRST_RAYS", 1)
    alone = texture_gradient(rollout, POSES)
    assert np.linalg.norm(alone) > 0
    assert np.linalg.norm(together - alone) <= 1e-5 * np.linalg.norm(alone)


def test_a_sensor_without_derivatives_is_refused():
    loop, _ = toy.make_loop()

    class Blind(AbstractSensor):
        def observe(self, state, step):
            return loop.sensor.observe(state, step)

    with pytest.raises(TypeError, match="Blind: "):
        gradient(make_rollout(replace(loop, sensor=Blind()), 1))


def test_values_that_make_no_sense_are_refused():
    loop, _ = toy.make_loop()
    sensor = loop.sensor
    for call, message in (
        (lambda: objective(make_rollout(loop, 0)), "horizon"),
        (lambda: to_state(np.array([[0.0, np.nan, 0.0]])), "states"),
        (lambda: sensor.objects[0].move(np.full(6, np.nan)), "offset: .* 6 "),
        (
            lambda: field_sensor(
                sensor.layers[0], 2 * sensor.objects, sensor.intrinsics
            ),
            "share",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_another_mount_makes_another_image():
    loop, _ = toy.make_loop()
    state = loop.initial(INITIAL)
    before = loop.sensor.observe(state, 0).image.numpy().copy()
    mount = CameraMount(height_m=1.6, forward_m=0.3, pitch_deg=4.0)
    other = showing(loop.sensor, loop.sensor.objects, mounts=[mount])
    assert np.abs(other.observe(state, 0).image.numpy() - before).max() > 0.01


@pytest.mark.parametrize("attached", [False, True])
def test_sensors_see_the_pose_alone_of_longer_states(attached):
    sensor, outputs = toy.make_loop()[0].sensor, []
    # as many as make (n, 4) and (n, 3) the same number of values in some order
    poses = np.array([[0.0, 0.0, 0.1], [0.5, -0.3, 0.0], [0.2, 0.4, -0.2]])
    for states in (poses, np.c_[poses, [0.3, -0.2, 0.1]]):
        state = to_state(states)
        observation = sensor.observe(state, 0)
        weight = np.linspace(-1, 1, dr.width(observation.image.array), dtype=np.float32)
        sensor.start_gradient()
        d_image = mi.TensorXf(weight.reshape(observation.image.shape))
        by_pose = sensor.vjp(observation, state, d_image, attached)
        rows = by_pose.numpy()[:3] if attached else np.zeros(3)
        texture = sensor.texture_gradients()[0].numpy().copy()
        outputs.append((observation.image.numpy(), texture, rows))
    short, long = outputs
    np.testing.assert_array_equal(long[0], short[0])
    np.testing.assert_allclose(long[1], short[1], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(long[2], short[2], rtol=1e-4)


def test_kept_frames_are_not_rendered_again():
    loop, _ = toy.make_loop()
    rollout = make_rollout(loop, 3, adjoint="kept")
    evaluation = rollout.run(loop.initial(INITIAL))
    tape = evaluation.trajectory.tape
    samples = toy.WIDTH * toy.HEIGHT
    for scene, thing in (state.marches for (state,), _ in tape):
        met = dr.width(thing.index)  # by the object
        assert 0 < met < samples / 2 < samples == dr.width(scene) == thing.count
        assert dr.width(thing.march) == met
        assert dr.all(thing.march.opacity > 0)
    before = loop.sensor.renders
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(composite, "march", None)  # of fields, while a kernel is traced
        rollout.gradient(evaluation)
    assert loop.sensor.renders == before


def test_what_is_kept_gives_the_same_image_again():
    loop, _ = toy.make_loop()
    sensor, state = loop.sensor, loop.initial(INITIAL)
    observation = sensor.observe(state, 2)
    again = sensor.restore(state, 2, sensor.keep(observation))
    assert dr.all(observation.image.array == again.image.array)
    for one, other in zip(
        observation.integrator_state.marches.layers,
        again.integrator_state.marches.layers,
        strict=True,
    ):
        for name in ("radiance", "opacity", "moment"):
            assert dr.all(getattr(one, name) == getattr(other, name), axis=None)


def test_fields_die_with_their_last_reference():
    """Else a process that opens one world after another keeps gigabytes of them."""
    gc.collect()
    gc.disable()
    try:
        loop, _ = toy.make_loop()
        gradient(make_rollout(loop, 1, adjoint="kept"))
        alive = [weakref.ref(field) for field in loop.sensor.fields]
        assert alive and all(reference() is not None for reference in alive)
        loop.sensor.fields[0].colours.read()
        del loop, _
        assert [reference() for reference in alive] == [None] * len(alive)
    finally:
        gc.enable()


def test_sensors_die_safely_while_others_record():
    """Dr.Jit aborts when a recording is destroyed while another is made."""
    before = gc.get_threshold()
    gc.set_threshold(1)
    try:
        for _ in range(4):
            loop, _ = toy.make_loop()
            loop.sensor.cycle = loop.sensor  # only the collector can free it
            gradient(make_rollout(loop, 1))
    finally:
        gc.set_threshold(*before)
