"""The loop's derivatives in double precision, against autograd through time."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from support.reference import loop as analytic
from support.reference.derivatives import central_difference
from support.worlds.loops import (
    ADJOINTS,
    Wave,
    assert_close,
    expected_gradient,
    flat,
    wave_in_torch,
)

from mi_nerfattack.policy.preprocess import Preprocess
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.rollout.adjoint import Checkpointed
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import Worst
from mi_nerfattack.rollout.sensor import Observation
from mi_nerfattack.rollout.sweep import StepRecorder
from mi_nerfattack.rollout.variation import Variation, Varied
from mi_nerfattack.vehicle.dynamics import state_type, to_state

pytestmark = pytest.mark.usefixtures("variant")

GAINS = 0.4, 0.3, 0.5  # of the frames of a stack
OFFSETS = np.array(
    [[0.1, -0.2, 0.3, 0.05, 0.1, -0.15], [0.0, 0.2, -0.1, 0.3, 0.0, 0.1]]
)


@pytest.mark.parametrize("attached", [True, False])
def test_derivatives_by_images_are_autograd(attached):
    loop, twin = analytic.make_pair("ackermann_rate", "rk4", 3, 4)
    initial = loop.dynamics.extend(analytic.random_poses(2))
    rollout = Rollout(loop, Wave(), 6, attached=attached)
    drive = rollout.run(to_state(initial)).trajectory
    textures = [
        torch.tensor(texture.numpy(), requires_grad=True)
        for texture in loop.sensor.textures()
    ]
    states, _ = twin.drive(torch.tensor(initial), textures, 6, attached)
    value = wave_in_torch(states, twin.dt).mean()
    for steps in ({1, 3}, set(range(6)), set()):
        rendered = loop.sensor.renders
        by_step = rollout.by_images(drive, steps)
        assert set(by_step) == steps
        first = min(steps, default=6)
        periods = 6 - first if attached else len(steps)
        assert loop.sensor.renders - rendered == 2 * periods
        for step, by_image in by_step.items():
            image = twin.images[step]
            (expected,) = torch.autograd.grad(
                value, image, retain_graph=True, allow_unused=True
            )
            if expected is None:  # its control comes too late
                assert step > 3 and not by_image.any()
            else:
                assert_close([by_image], [expected.numpy()])


def test_derivatives_by_images_go_through_a_memory():
    """Against differences: the image of one period is changed."""
    loop, _ = analytic.make_pair()
    policy = TorchPolicy(StackPolicy(), preprocess=Preprocess(frames=3))
    loop = replace(loop, policy=policy)
    rollout = Rollout(loop, Wave(), 4, attached=True)
    initial = to_state(analytic.random_poses(1))
    drive = rollout.run(initial).trajectory
    rng, observe = np.random.default_rng(0), loop.sensor.observe
    for step, by_image in rollout.by_images(drive, {0, 2}).items():
        direction = rng.normal(0, 1, by_image.shape)

        def value(s, step=step, direction=direction):
            def nudged(state, index):
                observation = observe(state, index)
                change = analytic.tensor(s * direction * (index == step))
                return replace(observation, image=observation.image + change)

            loop.sensor.observe = nudged
            cost = rollout.run(initial).value
            loop.sensor.observe = observe
            return cost

        expected = central_difference(value, 1e-5)
        assert (by_image * direction).sum() == pytest.approx(expected, rel=1e-6)


class StackPolicy(torch.nn.Module):
    goals = 3

    def __init__(self):
        super().__init__()
        self.network = analytic.AnalyticPolicy()

    def forward(self, image, goal):
        images = image.split(3, dim=1)
        return sum(
            w * self.network(x, goal) for w, x in zip(GAINS, images, strict=True)
        )


def check(loop, twin, initial, horizon, reduce=torch.mean, tolerance=1e-8, **options):
    """Compare value and gradient of a rollout with autograd through the twin."""
    rollout = Rollout(loop, Wave(), horizon, **options)
    evaluation = rollout.run(to_state(initial))
    attached = options.get("attached", False)
    value, expected = expected_gradient(loop, twin, initial, horizon, attached, reduce)
    assert evaluation.value == pytest.approx(value, rel=1e-12)
    assert_close(flat(rollout.gradient(evaluation)), expected, tolerance)
    return evaluation


@pytest.mark.parametrize("name", ADJOINTS)
@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize(
    ("vehicle", "integrator", "substeps", "delay", "horizon"),
    [
        ("dubins", "rk4", 1, 0, 1),
        ("dubins", "euler", 1, 0, 10),
        ("ackermann_rate", "rk4", 3, 4, 5),
        ("bicycle", "implicit_midpoint", 2, 1, 5),
    ],
)
def test_adjoints_are_autograd(
    vehicle, integrator, substeps, delay, horizon, attached, name
):
    loop, twin = analytic.make_pair(vehicle, integrator, substeps, delay, 2)
    loop.sensor.set_parameters({"offsets": OFFSETS})
    initial = loop.dynamics.extend(analytic.random_poses(3))
    options = {"adjoint": ADJOINTS[name], "attached": attached}
    check(loop, twin, initial, horizon, **options)


@pytest.mark.parametrize("name", ADJOINTS)
@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize(("substeps", "delay"), [(1, 0), (3, 4)])
def test_each_drive_has_its_own_delay(substeps, delay, attached, name):
    """Also of a part of a step, and of several control periods."""
    loop, twin = analytic.make_pair("ackermann", "rk4", substeps, delay)
    variation = Variation(delay_s_sd=0.2, seed=8)
    extra_steps = variation.draws(0, 3).delay_s / loop.transition.dt
    assert (
        extra_steps.min() < substeps < extra_steps.max() / 2
        and (extra_steps % 1).min() > 0.1
    )
    vehicle = Varied(loop.dynamics, variation, loop.transition.dt)
    loop, twin.delay = (
        replace(loop, dynamics=vehicle),
        delay + torch.tensor(extra_steps),
    )
    initial = loop.dynamics.extend(analytic.random_poses(3))
    check(loop, twin, initial, 8, adjoint=ADJOINTS[name], attached=attached)


class Rounded(torch.nn.Module):
    """A policy behind a camera of eight bits, differentiated straight through."""

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, image, goal):
        rounded = (255 * image).round() / 255
        return self.policy(image + (rounded - image).detach(), goal)


@pytest.mark.parametrize("name", ADJOINTS)
def test_images_of_eight_bits_are_differentiated_straight_through(name):
    exact, twin = analytic.make_pair()
    loop, twin.module = replace(exact, eight_bit=True), Rounded(twin.module)
    initial = loop.dynamics.extend(analytic.random_poses(3))
    value = check(loop, twin, initial, 7, adjoint=ADJOINTS[name], attached=True).value
    unrounded = Rollout(exact, Wave(), 7).run(to_state(initial)).value
    assert abs(value - unrounded) > 1e-5  # the rounding is seen


@pytest.mark.parametrize("name", ADJOINTS)
def test_disturbed_drives_are_differentiated_as_they_were(name, rng):
    loop, _ = analytic.make_pair()
    loop = replace(loop, disturbance=Disturbance(0.4, 0.5, 0.03, seed=2))
    rollout = Rollout(loop, Wave(), 5, adjoint=ADJOINTS[name], attached=True)
    initial = analytic.random_poses(3)
    (base,), along = analytic.random_textures(), rng.normal(size=initial.shape)
    direction = rng.normal(size=base.shape)
    gradient = rollout.gradient(rollout.run(to_state(initial)))
    expected = (gradient.textures[0].numpy() * direction).sum()
    expected += (np.array(gradient.initial).T * along).sum()

    def value(s):
        loop.sensor.set_textures([base + s * direction])
        return rollout.run(to_state(initial + s * along)).value

    assert central_difference(value, 1e-5) == pytest.approx(expected, rel=1e-6)


def test_images_of_eight_bits_are_those_of_files():
    loop = replace(analytic.make_pair()[0], eight_bit=True)
    levels = np.arange(256, dtype=np.uint8)
    shifts = np.array([-0.49, 0.0, 0.49])[:, None] / 255
    image = mi.TensorXf((levels / 255 + shifts).astype(np.float32))
    shown = np.array(loop.shown(Observation(image), 0))
    assert (shown == np.divide(levels, 255, dtype=np.float32)).all()


def test_a_hundred_periods():
    loop, twin = analytic.make_pair("ackermann", "rk4", 1, 2)
    check(loop, twin, analytic.random_poses(2), 100, tolerance=1e-7, attached=True)


def test_costates_are_minus_the_derivative_by_the_states():
    loop, twin = analytic.make_pair("ackermann_rate", "rk4", 2, 1)
    initial = loop.initial(analytic.random_poses(2))
    rollout = Rollout(loop, Wave(), 6, attached=True)
    costates = rollout.gradient(rollout.run(initial)).costates
    textures = [torch.tensor(texture.numpy()) for texture in loop.sensor.textures()]
    start = torch.tensor(np.array(initial).T, requires_grad=True)
    states, _ = twin.drive(start, textures, 6, True)
    by_states = torch.autograd.grad(wave_in_torch(states, twin.dt).mean(), twin.states)
    assert_close(costates, [-value.numpy() for value in by_states[1:]])


def test_the_worst_drive_alone_is_differentiated():
    loop, twin = analytic.make_pair()
    poses = analytic.random_poses(4)
    evaluation = check(loop, twin, poses, 5, torch.max, reduction=Worst())
    assert evaluation.costs.shape == (4,)


def test_dr_backward_differentiates_the_function(rng):
    loop, twin = analytic.make_pair(objects=2)
    initial = analytic.random_poses(3)
    _, expected = expected_gradient(loop, twin, initial, 4, True)
    rollout = Rollout(loop, Wave(), 4, attached=True)
    textures, start = loop.sensor.textures(), to_state(initial)
    offsets = analytic.tensor(loop.sensor.offsets.numpy())
    dr.enable_grad(textures, start, offsets)
    value = rollout(named(textures, offsets), start)
    loop.sensor.set_textures([0 * t for t in dr.detach(textures)])  # another's use
    loop.sensor.set_parameters({"offsets": OFFSETS})
    dr.backward(3 * value)
    gradients = [dr.grad(texture).numpy() for texture in textures]
    gradients += [np.array(dr.grad(start)).T, dr.grad(offsets).numpy()]
    assert_close([value / 3 for value in gradients], expected)


def named(textures, offsets):
    return {f"texture{i}": t for i, t in enumerate(textures)} | {"offsets": offsets}


def test_torch_differentiates_the_function():
    """Of the textures and offsets that it was given, whatever the sensor has later."""
    loop, twin = analytic.make_pair(objects=2)
    loop.sensor.set_parameters({"offsets": OFFSETS})
    initial = analytic.random_poses(2)
    value, expected = expected_gradient(loop, twin, initial, 4, True)
    rollout = Rollout(loop, Wave(), 4, attached=True)

    @dr.wrap(source="torch", target="drjit")
    def function(textures, start, offsets):
        return rollout(named(textures, offsets), state_type()(start))

    values = [t.numpy() for t in loop.sensor.textures()] + [initial, OFFSETS]
    leaves = [torch.tensor(value, requires_grad=True) for value in values]
    *textures, start, offsets = leaves
    cost = function(textures, start.T, offsets)
    assert cost.item() == pytest.approx(value, rel=1e-12)
    loop.sensor.set_parameters({"offsets": 0 * OFFSETS})  # another's use
    (2 * cost).backward()
    assert_close([leaf.grad.numpy() / 2 for leaf in leaves], expected)


def test_the_gradient_comes_apart_by_periods(rng):
    loop, _ = analytic.make_pair(objects=2)
    initial = to_state(analytic.random_poses(2))
    rollout = Rollout(loop, Wave(), 6)
    directions = [rng.normal(size=t.shape) for t in loop.sensor.textures()]
    derivative = rollout.gradient(
        rollout.run(initial), recorder=StepRecorder(directions)
    )
    attribution = derivative.attribution
    assert attribution.norms.shape == attribution.along.shape == (6, 2)
    assert (attribution.norms > 0).all()
    periods = {}
    recorder = StepRecorder(on_period=periods.__setitem__)
    rollout.gradient(rollout.run(initial), recorder=recorder)
    for index, rows in periods.items():
        norms = [np.linalg.norm(row) for row in rows]
        np.testing.assert_allclose(norms, attribution.norms[index], rtol=1e-6)
    assert sorted(periods) == list(range(6))
    pairs = zip(derivative.textures, directions, strict=True)
    totals = [(gradient.numpy() * direction).sum() for gradient, direction in pairs]
    np.testing.assert_allclose(attribution.along.sum(0), totals, rtol=1e-5)


def test_what_cannot_be_differentiated_is_refused():
    loop, _ = analytic.make_pair()
    initial = to_state(analytic.random_poses(1))

    class Blind(type(loop.policy)):
        differentiable = False

    blind = replace(loop, policy=Blind(analytic.AnalyticPolicy()))
    rollout = Rollout(blind, Wave(), 2)
    with pytest.raises(TypeError, match="Blind: a black box has no derivatives"):
        rollout.gradient(rollout.run(initial))
    for make, message in (
        (lambda: Checkpointed(0), "segment: 0"),
        (lambda: replace(loop, delay=-1), "delay: -1"),
        (lambda: replace(loop, substeps=0), "substeps: 0"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_state_of_the_wrong_size_is_refused():
    loop, _ = analytic.make_pair("ackermann_rate")
    with pytest.raises(ValueError, match="3 rows; .* 4"):
        Rollout(loop, Wave(), 2).run(to_state(analytic.random_poses(1)))
