"""The PyTorch peers see, learn, drive and differentiate what we do."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from support.worlds.fields import blob, small_ngp

from bench.ngp_data import NGPData
from bench.torch.fit import BELOW_WHITE, Pictures, TorchFit
from bench.torch.loop import TorchCamera, TorchLoop, TorchRoute, TorchVehicle, TorchView
from bench.torch.ngp import TorchNGP
from bench.torch.object import ObjectData, TorchObject
from mi_nerfattack.attack.objectives import CrossTrackDeviation
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import Occupancy
from mi_nerfattack.fit.loss import huber
from mi_nerfattack.policy.preprocess import Crop, Preprocess, Resize
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import Marches
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4
from mi_nerfattack.vehicle.route.route import Route

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]
STOP = 1e-3
IMAGES, PIXELS = 3, 40
WIDTH, HEIGHT, HORIZON = 24, 14, 4
CAMERA = from_fov(WIDTH, HEIGHT, 80.0)
MOUNT = CameraMount(1.2, 0.3, 4.0)
POSE = Pose.upright((5.5, 0.7, 1.1), 0.3, 1.3)
ROUTE = Route("bend", 0, np.array([[-9.0, 0.0], [1.0, 0.1], [9.0, 2.0]]))
STAGES = [Crop(2, 2, 0, 0), Resize(16, 8)]
INITIAL = np.array([[0.0, 0.1, 0.05], [0.4, -0.2, 0.0], [-0.2, 0.3, -0.1]])


@pytest.fixture(autouse=True)
def one_thread():
    """Let PyTorch's threads not wait for each other in tiny operations."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def relative(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(actual - expected) / np.linalg.norm(expected))


# The image


@pytest.fixture
def data(rng) -> NGPData:
    """Make a field with holes, a growing step, and densities up to opaque."""
    field = small_ngp(cone=1 / 64)
    octants = rng.integers(0, 256, (6, 5, 4), np.uint8)
    field.occupy(Occupancy(rng.random((6, 5, 4)) < 0.6, octants))
    data = NGPData.of(field)
    data.tensors["density_net.1"][0] *= 3
    return data


def fan(rng: np.random.Generator, count: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Make rays from inside and outside of the box, in all directions."""
    origin = rng.uniform(-1.5, 1.5, (count, 3)).astype(np.float32)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin, direction.astype(np.float32)


def our_image(field, origin, direction):
    rays = Rays(mi.Point3f(origin.T.copy()), mi.Vector3f(direction.T.copy()))
    marches = InterleavedComposite().render([PosedField(field)], rays, STOP)
    behind = field.background(rays.direction)
    return (marches.total.radiance + (1 - marches.total.opacity) * behind).numpy().T


def test_the_peer_sees_the_same_image(rng, data):
    origin, direction = fan(rng)
    image = our_image(data.field(), origin, direction)
    peer = TorchNGP(data, STOP)
    peer_image = peer.render(torch.tensor(origin), torch.tensor(direction)).numpy()
    assert image.std() > 0.05
    assert np.abs(peer_image - image).max() < 1e-3


# The fit


@pytest.fixture
def pictures(rng) -> Pictures:
    direction = rng.normal(size=(IMAGES, PIXELS, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    return Pictures(
        rng.integers(0, 256, (IMAGES, PIXELS, 3), dtype=np.uint8),
        rng.uniform(-1.2, 1.2, (IMAGES, 3)).astype(np.float32),
        direction.astype(np.float32),
    )


def every_pixel(rng) -> tuple[torch.Tensor, torch.Tensor]:
    count = IMAGES * PIXELS
    jitter = torch.tensor(rng.random(count), dtype=torch.float32)
    return torch.arange(count), jitter


def test_the_peer_has_the_gradients_of_our_renderer(rng, data, pictures):
    """Ours: the exact composite, which no fit uses, and its replayed derivative."""
    index, jitter = every_pixel(rng)
    fit = TorchFit(data, pictures, len(index))
    loss = fit.gradients(index, jitter)

    field = data.field()
    names = ("table", "density_weights", "colour_weights", "sky")
    for name in names:
        dr.enable_grad(field.parameters()[name])
    rays = Rays(
        mi.Point3f(np.repeat(pictures.origin, PIXELS, axis=0).T.copy()),
        mi.Vector3f(pictures.direction.reshape(-1, 3).T.copy()),
        mi.Float(dr.inf),
        mi.Float(jitter.numpy().copy()),
    )
    posed, composite = [PosedField(field)], InterleavedComposite()
    marches = composite.render(posed, rays, STOP)
    radiance = mi.Color3f(marches.total.radiance)
    opacity = mi.Float(marches.total.opacity)
    dr.enable_grad(radiance, opacity)
    image = radiance + (1 - opacity) * field.background(rays.direction)
    target = mi.Color3f(pictures.colour.reshape(-1, 3).T.astype(np.float32) / 255)
    error = dr.linear_to_srgb(image * BELOW_WHITE) - target
    objective = dr.mean(sum(huber(channel, 0.1) for channel in error)) / 3
    dr.backward(objective)
    total = March(dr.grad(radiance), dr.grad(opacity), dr.zeros(mi.Float, len(index)))
    composite.backward(posed, rays, marches, Marches(total), STOP)

    assert loss == pytest.approx(float(objective[0]), rel=1e-3)
    ours = {name: dr.grad(field.parameters()[name]).numpy() for name in names}
    theirs = fit.model.parameters["table"].grad.numpy().ravel()
    assert relative(theirs, ours["table"]) < 1e-2
    assert relative(fit.model.sky.grad.numpy().ravel(), ours["sky"]) < 1e-2
    for net in ("density", "colour"):
        gradients = [
            value.grad.numpy().ravel()
            for key, value in fit.model.parameters.items()
            if key.startswith(net)
        ]
        packed = np.linalg.norm(ours[f"{net}_weights"])
        assert np.linalg.norm(np.concatenate(gradients)) == pytest.approx(
            packed, rel=1e-2
        )


def test_gradients_do_not_depend_on_the_chunk(rng, data, pictures):
    index, jitter = every_pixel(rng)
    fit = TorchFit(data, pictures, len(index))
    results = []
    for fit.chunk in (len(index), 30):
        loss = fit.gradients(index, jitter)
        results.append((loss, [leaf.grad.clone() for leaf in fit.leaves]))
    (loss, gradients), (other, expected) = results
    assert loss == pytest.approx(other, rel=1e-4)
    for gradient, one in zip(gradients, expected, strict=True):
        assert (gradient - one).norm() < 1e-3 * one.norm()


# The closed loop


class Gain(torch.nn.Module):
    goals = 1

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        weight = torch.randn(1, 3, 8, 16, generator=generator)
        self.weight = torch.nn.Parameter(0.05 * weight)

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return 1.4 * torch.tanh((image * self.weight).sum((1, 2, 3)))


@pytest.fixture
def scene() -> NGPData:
    """Return fog of many colours all around, some of it in front of the object."""
    data = NGPData.of(small_ngp(cone=1 / 64))
    data.tensors["density_net.1"][0] *= 12
    corner = np.array([20.0, 20.0, 6.0])
    return replace(data, lower=-corner, upper=corner, step_m=0.4)


def peer(scene: NGPData, item: ObjectData):
    torch_object = TorchObject(item, STOP)
    torch_object.texture.requires_grad_(True)
    ngp = TorchNGP(scene, STOP)
    view = TorchView(ngp, torch_object, TorchCamera(CAMERA, MOUNT), 100)
    vehicle, route = TorchVehicle(5.0, 1.5, 0.1), TorchRoute(ROUTE.points, 0.05)
    return TorchLoop(view, Gain(), STAGES, 0, vehicle, route)


def test_the_peer_drives_and_differentiates_as_we_do(rng, scene):
    item = PosedField(blob(rng, peak=4.0), POSE)
    sensor = field_sensor(PosedField(scene.field()), [item], CAMERA, MOUNT, stop=STOP)
    policy = TorchPolicy(Gain(), preprocess=Preprocess(STAGES))
    loop = ClosedLoop(sensor, policy, 0, Dubins(5.0, 1.5), RK4(), 0.1, eight_bit=False)
    rollout = Rollout(loop, StageSum(CrossTrackDeviation(ROUTE, 0.05)), HORIZON)
    evaluation = rollout.run(loop.initial(INITIAL))
    expected = rollout.gradient(evaluation).textures[0].numpy()

    other = peer(scene, ObjectData.of(item))
    states = other.drive(torch.tensor(INITIAL), HORIZON)
    cost = other.objective(states)
    cost.backward()
    ours = evaluation.trajectory.states_numpy()[:, 1:].transpose(1, 0, 2)
    assert np.ptp(ours[-1, :, 2] - INITIAL[:, 2]) > 1e-3  # the images do steer
    assert np.abs(states.detach().numpy() - ours).max() < 1e-3
    assert cost.item() == pytest.approx(evaluation.value, abs=1e-3)
    actual = other.view.item.texture.grad.numpy()
    assert np.linalg.norm(expected) > 1e-6
    assert np.linalg.norm(actual - expected) < 1e-2 * np.linalg.norm(expected)
