"""The closed loop and its adjoint."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
import torch

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def toy(variant):
    import toy_loop

    return toy_loop


INITIAL = np.array([[0.0, 0.35, 0.02]])


def objective(toy, loop, initial, horizon):
    from mi_nerfattack.rollout.adjoint import objective_value
    from mi_nerfattack.rollout.loop import simulate, to_state

    drive = simulate(loop, to_state(initial), horizon)
    return objective_value(drive, toy.square_error)


def gradient(toy, loop, initial, horizon, attached):
    from mi_nerfattack.rollout.adjoint import replay_gradient
    from mi_nerfattack.rollout.loop import simulate, to_state

    drive = simulate(loop, to_state(initial), horizon)
    return replay_gradient(loop, drive, toy.square_error, attached)


@pytest.mark.parametrize("horizon", [2, 5])
def test_attached_gradient_is_that_of_the_whole_loop(toy, horizon, rng):
    loop, item = toy.make_loop()
    found = gradient(toy, loop, INITIAL, horizon, True).textures[0].numpy().copy()
    base = toy.texture_of(item)
    along = found / np.linalg.norm(found)
    for direction in (along, along + 0.5 * _unit(rng.normal(size=base.shape))):
        direction = _unit(direction).astype(np.float32)
        values = []
        h = 0.3
        for sign in (1, -1):
            item.set_parameter("texture", base + np.float32(sign * h) * direction)
            values.append(objective(toy, loop, INITIAL, horizon))
        item.set_parameter("texture", base)
        difference = (values[0] - values[1]) / (2 * h)
        expected = float((found.astype(float) * direction).sum())
        assert difference == pytest.approx(expected, rel=1e-2)


def _unit(value):
    return value / np.linalg.norm(value)


def test_attached_gradient_by_the_initial_state(toy):
    loop, _ = toy.make_loop()
    found = np.array(gradient(toy, loop, INITIAL, 5, True).initial)[:, 0]
    for axis, h in ((0, 2e-2), (1, 2e-2), (2, 5e-3)):
        values = []
        for sign in (1, -1):
            moved = INITIAL.copy()
            moved[0, axis] += sign * h
            values.append(objective(toy, loop, moved, 5))
        difference = (values[0] - values[1]) / (2 * h)
        scale = np.abs(found).max()
        assert difference == pytest.approx(found[axis], rel=1e-2, abs=2e-3 * scale)


@pytest.mark.parametrize("horizon", [2, 5])
def test_detached_gradient_is_that_of_a_torch_loop_with_detach(toy, horizon):
    loop, item = toy.make_loop()
    found = gradient(toy, loop, INITIAL, horizon, False).textures[0].numpy()
    texture = torch.as_tensor(toy.texture_of(item).astype(np.float64))
    texture.requires_grad_(True)
    value = toy.torch_objective(loop, texture, INITIAL[0], horizon)
    value.backward()
    expected = texture.grad.numpy()
    assert objective(toy, loop, INITIAL, horizon) == pytest.approx(
        float(value.detach()), rel=1e-5
    )
    assert np.linalg.norm(expected) > 0
    error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert error < 1e-3


def test_euler_needs_two_steps_to_feel_a_control(toy):
    loop, _ = toy.make_loop()
    found = gradient(toy, loop, INITIAL, 1, True)
    assert not found.textures[0].numpy().any()
    assert found.costates.shape == (1, 1, 3)


def test_attached_and_detached_differ(toy):
    loop, _ = toy.make_loop()
    a = gradient(toy, loop, INITIAL, 5, True).textures[0].numpy().copy()
    b = gradient(toy, loop, INITIAL, 5, False).textures[0].numpy().copy()
    assert np.linalg.norm(a - b) > 1e-3 * np.linalg.norm(b)


@pytest.mark.parametrize("name", ["RK4", "ImplicitMidpoint"])
def test_other_integrators_against_differences(toy, name):
    from mi_nerfattack.vehicle import integrators

    loop, item = toy.make_loop(getattr(integrators, name)())
    found = gradient(toy, loop, INITIAL, 3, True).textures[0].numpy().copy()
    base, along = toy.texture_of(item), _unit(found)
    values = []
    for sign in (1, -1):
        item.set_parameter("texture", base + np.float32(0.3 * sign) * along)
        values.append(objective(toy, loop, INITIAL, 3))
    difference = (values[0] - values[1]) / 0.6
    assert difference == pytest.approx(np.linalg.norm(found), rel=1e-2)


def test_a_batch_is_the_mean_of_its_members(toy):
    loop, _ = toy.make_loop()
    both = np.array([[0.0, 0.35, 0.02], [0.1, -0.2, -0.05]])
    batch = gradient(toy, loop, both, 3, False).textures[0].numpy().copy()
    one = gradient(toy, loop, both[:1], 3, False).textures[0].numpy().copy()
    two = gradient(toy, loop, both[1:], 3, False).textures[0].numpy().copy()
    assert np.allclose(batch, 0.5 * (one + two), rtol=1e-3, atol=1e-7)


def test_jitter_is_replayed(toy):
    loop, _ = toy.make_loop(jitter_seed=7)
    from mi_nerfattack.rollout.loop import to_state

    state = to_state(INITIAL)
    a = loop.sensor.observe(state, 3).image.numpy()
    assert np.array_equal(a, loop.sensor.observe(state, 3).image.numpy())
    assert not np.array_equal(a, loop.sensor.observe(state, 4).image.numpy())


def test_nothing_is_compiled_after_the_first_steps(toy):
    from mi_nerfattack.rollout.adjoint import replay_gradient
    from mi_nerfattack.rollout.loop import simulate, to_state

    loop, _ = toy.make_loop()
    drive = simulate(loop, to_state(INITIAL), 3)
    replay_gradient(loop, drive, toy.square_error)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        drive = simulate(loop, to_state(INITIAL + 0.07), 4)
        replay_gradient(loop, drive, toy.square_error)
        history = dr.kernel_history()
    kernels = [entry for entry in history if "cache_hit" in entry]
    assert kernels
    assert all(entry["cache_hit"] for entry in kernels)


def test_memory_does_not_grow_with_the_horizon(toy):
    from mi_nerfattack.rollout.adjoint import replay_gradient
    from mi_nerfattack.rollout.loop import simulate, to_state

    loop, _ = toy.make_loop()
    backend = dr.backend_v(type(to_state(INITIAL)[0]))

    def peak(horizon):
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        drive = simulate(loop, to_state(INITIAL), horizon)
        replay_gradient(loop, drive, toy.square_error)
        dr.sync_thread()
        return dr.detail.malloc_watermark(backend)

    peak(4)
    assert peak(32) <= 1.05 * peak(8)


def test_a_sensor_without_derivatives_is_refused(toy):
    from dataclasses import replace

    from mi_nerfattack.rollout.adjoint import replay_gradient
    from mi_nerfattack.rollout.loop import simulate, to_state
    from mi_nerfattack.rollout.sensor import AbstractSensor

    loop, _ = toy.make_loop()
    drive = simulate(loop, to_state(INITIAL), 1)

    class Blind(AbstractSensor):
        def observe(self, state, step):
            raise NotImplementedError

    with pytest.raises(TypeError, match="Blind"):
        replay_gradient(replace(loop, sensor=Blind()), drive, toy.square_error)


def test_horizon_below_one_and_bad_states_are_refused(toy):
    from mi_nerfattack.rollout.loop import simulate, to_state

    loop, _ = toy.make_loop()
    with pytest.raises(ValueError, match="horizon"):
        simulate(loop, to_state(INITIAL), 0)
    with pytest.raises(ValueError, match="states"):
        to_state(np.array([[0.0, np.nan, 0.0]]))


def test_kept_frames_give_the_same_gradient(toy, single_thread):
    from mi_nerfattack.rollout.adjoint import replay_gradient
    from mi_nerfattack.rollout.loop import simulate, to_state

    loop, _ = toy.make_loop()
    start = to_state(INITIAL)
    kept = simulate(loop, start, 3, keep=True)
    assert len(kept.observations) == 3
    before = loop.sensor.renders
    found = replay_gradient(loop, kept, toy.square_error)
    assert loop.sensor.renders == before  # nothing was rendered again
    again = replay_gradient(loop, simulate(loop, start, 3), toy.square_error)
    expected = again.textures[0].numpy()
    assert np.abs(expected).max() > 0
    np.testing.assert_array_equal(found.textures[0].numpy(), expected)


def test_attached_gradient_through_the_interleaved_composite(toy):
    from dataclasses import replace

    from mi_nerfattack.render.interleaved import InterleavedComposite
    from mi_nerfattack.rollout.field_sensor import FieldSensor

    loop, item = toy.make_loop()
    old = loop.sensor
    sensor = FieldSensor(
        old.scene, old.objects, old.camera, old.mount, composite=InterleavedComposite()
    )
    loop = replace(loop, sensor=sensor)
    found = gradient(toy, loop, INITIAL, 3, True).textures[0].numpy().copy()
    base = toy.texture_of(item)
    direction = _unit(found).astype(np.float32)
    values = []
    for sign in (1, -1):
        item.set_parameter("texture", base + np.float32(sign * 0.3) * direction)
        values.append(objective(toy, loop, INITIAL, 3))
    expected = float((found.astype(float) * direction).sum())
    assert (values[0] - values[1]) / 0.6 == pytest.approx(expected, rel=1e-2)


def test_sensors_die_safely_while_others_record(toy):
    """Dr.Jit aborts when a recording is destroyed while another is made."""
    import gc

    before = gc.get_threshold()
    gc.set_threshold(1)
    try:
        for _ in range(4):
            loop, _ = toy.make_loop()
            loop.sensor.cycle = loop.sensor  # only the collector can free it
            gradient(toy, loop, INITIAL, 1, False)
    finally:
        gc.set_threshold(*before)
