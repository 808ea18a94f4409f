"""The closed loop through two cameras, and its adjoints."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch
from support.reference.derivatives import central_difference, nothing_compiled
from support.worlds import loops as toy

from mi_nerfattack.deploy.surrogate.scene import field_sensor, showing
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig, camera_seed
from mi_nerfattack.rollout.loop import CameraPath, ClosedLoop
from mi_nerfattack.rollout.variation import Variation
from mi_nerfattack.vehicle.dynamics import Dubins

pytestmark = pytest.mark.usefixtures("variant")

JITTER = 7
LEFT = CameraMount(1.0, 0.2, 8.0, left_m=0.5, yaw_deg=15.0)
LENSES = from_fov(toy.WIDTH, toy.HEIGHT, 70.0), from_fov(16, 12, 60.0)
RIG = Rig(("front", "left"), LENSES, (toy.MOUNT, LEFT))
DISTURBANCE = Disturbance(exposure_ev_sd=0.5, blur_px_sd=0.8, noise_sd=0.02, seed=3)
POSES = np.array([[0.0, 0.35, 0.02], [0.1, 0.2, -0.03]])


class TwoImages(torch.nn.Module):
    """A smooth functional of a frame, with a strong gain."""

    goals = 1

    def __init__(self) -> None:
        super().__init__()
        width, height = RIG.size
        generator = torch.Generator().manual_seed(5)
        coarse = torch.randn(1, 3, 3, 7, generator=generator)
        weight = torch.nn.functional.interpolate(coarse, (height, width))
        self.weight = torch.nn.Parameter(weight * 0.02)

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return torch.tanh(((image - 0.4) * self.weight).sum((1, 2, 3)))


def make_loop(jitter: int | None = JITTER, **changes) -> tuple[ClosedLoop, list]:
    """Return the loop of one camera with a second one, and the objects' fields."""
    one, item = toy.make_loop(jitter_seed=jitter)
    vehicle = Dubins(toy.SPEED, toy.LIMIT)
    policy = TorchPolicy(TwoImages())
    sensor = one.sensor.with_rig(RIG)
    loop = replace(one, sensor=sensor, policy=policy, dynamics=vehicle, **changes)
    return loop, item


def test_a_frame_is_the_images_of_cameras_alone():
    loop, _ = make_loop()
    state, sensor = loop.initial(POSES), loop.sensor
    frame = sensor.observe(state, 3).image.numpy()
    assert frame.shape == (2, 12, toy.WIDTH + 16, 3)
    images = RIG.split(frame)
    assert not frame[:, toy.HEIGHT :, : toy.WIDTH].any()
    first, _ = toy.make_loop(jitter_seed=JITTER)
    # fields of its own, all alike
    assert np.array_equal(images["front"], first.sensor.observe(state, 3).image.numpy())
    alone = field_sensor(
        sensor.layers[0],
        sensor.objects,
        LENSES[1],
        LEFT,
        camera_seed(JITTER, 1),
        0.0,
    )
    assert np.array_equal(images["left"], alone.observe(state, 3).image.numpy())
    for index, name in enumerate(RIG.names):
        part = sensor.through(index).observe(state, 3).image.numpy()
        assert np.array_equal(part, images[name])
    assert sensor.renders == 4  # two frames, and those of the first camera alone
    assert sensor.rig.names == RIG.names and sensor.rig.mounts == RIG.mounts


def test_a_sensor_of_other_objects_has_the_same_cameras():
    loop, _ = make_loop()
    state, varied = loop.initial(POSES), Variation(pitch_deg_sd=2.0, height_sd=0.1)
    sensor = loop.sensor.varied(varied).numbered(5)
    other = showing(sensor, sensor.objects).observe(state, 0).image.numpy()
    assert np.array_equal(other, sensor.observe(state, 0).image.numpy())
    moved = [replace(mount, left_m=1.0) for mount in RIG.mounts]
    moved = showing(sensor, sensor.objects, mounts=moved).observe(state, 0).image
    for change in RIG.split(other - moved.numpy()).values():
        assert np.abs(change).max() > 0.01


@pytest.mark.parametrize("adjoint", toy.ADJOINTS)
def test_detached_gradient_holds_the_cameras_paths(adjoint, rng):
    loop, item = make_loop(disturbance=DISTURBANCE)
    rollout = toy.make_rollout(loop, 4, adjoint=adjoint)
    evaluation = rollout.run(loop.initial(POSES))
    gradient = rollout.gradient(evaluation).textures[0].numpy().astype(float)
    held = replace(rollout, camera_path=CameraPath(evaluation.trajectory.states))
    base = toy.texture_of(item)
    direction = toy.unit(
        toy.unit(gradient) + 0.5 * toy.unit(rng.normal(size=gradient.shape))
    )

    def value(s: float) -> float:
        loop.sensor.set_textures([(base + s * direction).astype(np.float32)])
        return toy.objective(held, POSES)

    expected = float((gradient * direction).sum())
    assert central_difference(value, 0.2) == pytest.approx(expected, rel=1e-3)


def test_attached_gradient_by_the_initial_state():
    loop, _ = make_loop(jitter=None)
    rollout = toy.make_rollout(loop, 5, attached=True)
    by_start = np.array(toy.gradient(rollout).initial)[:, 0]
    # near things cross the left camera's image: a heading's steps are short
    for axis, step in ((0, 4e-2), (1, 4e-2), (2, 4e-3)):

        def value(s: float, axis: int = axis) -> float:
            moved = toy.INITIAL.copy()
            moved[0, axis] += s
            return toy.objective(rollout, moved)

        expected = pytest.approx(
            by_start[axis], rel=1e-3, abs=1e-3 * np.abs(by_start).max()
        )
        assert central_difference(value, step) == expected


def test_the_derivative_by_the_state_is_the_sum_over_cameras(rng):
    sensor, state = make_loop()[0].sensor, make_loop()[0].initial(POSES)
    observation = sensor.observe(state, 1)
    d_image = rng.normal(size=observation.image.shape).astype(np.float32)
    sensor.start_gradient()
    together = np.array(sensor.vjp(observation, state, mi.TensorXf(d_image), True))
    total = np.zeros_like(together)
    for index, part in enumerate(RIG.split(d_image).values()):
        alone = sensor.through(index)
        d_part = mi.TensorXf(np.ascontiguousarray(part))
        total += np.array(alone.vjp(alone.observe(state, 1), state, d_part, True))
    sensor.stop_gradient()
    np.testing.assert_allclose(together, total, rtol=1e-5, atol=1e-6)


def test_adjoints_agree_and_compile_nothing_after_the_first_steps():
    loop, _ = make_loop(disturbance=DISTURBANCE)
    gradients = {}
    for adjoint in toy.ADJOINTS:
        toy.gradient(toy.make_rollout(loop, 4, adjoint=adjoint), POSES)
        with nothing_compiled():
            rollout = toy.make_rollout(loop, 4, adjoint=adjoint)
            gradients[adjoint] = toy.texture_gradient(rollout, POSES + 0.07)
    for name in ("kept", "checkpointed"):
        error = np.linalg.norm(gradients[name] - gradients["replay"])
        assert error <= 1e-6 * np.linalg.norm(gradients["replay"])


def test_light_varies_alike_in_all_images():
    loop, _ = make_loop()
    state = loop.initial(POSES)
    sensor = loop.sensor.varied(Variation(light_ev_sd=1.0, seed=2))
    bright, plain = (s.observe(state, 0).image.numpy() for s in (sensor, loop.sensor))
    for part in RIG.split(bright - plain).values():
        assert np.abs(part).max() > 0.01
    first = loop.sensor.through(0).varied(Variation(light_ev_sd=1.0, seed=2))
    alone = first.observe(state, 0).image.numpy()
    assert np.array_equal(RIG.split(bright)["front"], alone)
