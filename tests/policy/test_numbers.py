"""Policies that are told speed, route and time, and give several controls or a path."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from torch import nn

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.action import Action, Trajectory
from mi_nerfattack.policy.base import Numbers
from mi_nerfattack.policy.black_box import CallablePolicy
from mi_nerfattack.policy.inputs import Inputs, IntegerGoal, NoGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy

pytestmark = pytest.mark.usefixtures("variant")

NUMBERS = Numbers(speed=True, route_m=(5.0, 10.0), time=True)
VIEWS = {
    "front": (slice(0, 4), slice(0, 6)),
    "left": (slice(0, 3), slice(6, 10)),
}


class Wide(nn.Module):
    """Takes two images of different sizes, speed, route, goal; gives two controls."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(3)
        self.front = nn.Linear(72, 2)
        self.left = nn.Linear(36, 2)
        self.numbers = nn.Linear(5, 2)

    def forward(self, left, speed, front, route, goal):
        assert left.shape[1:] == (3, 3, 4) and front.shape[1:] == (3, 4, 6)
        numbers = torch.cat([speed, route.flatten(1)], 1)
        images = self.front(front.flatten(1)) + self.left(left.flatten(1))
        return torch.tanh(images + self.numbers(numbers) + 0.1 * goal[:, None])


def wide():
    inputs = Inputs(("left", "speed", "front", "route", "goal"), NUMBERS, VIEWS)
    action = Action((1, 0), (2.0, -1.0))
    return TorchPolicy(Wide().double(), IntegerGoal(3), action=action, inputs=inputs)


def test_order_and_derivatives_of_all_that_is_given(rng):
    frame, numbers = (
        rng.uniform(0, 1, (2, 4, 10, 3)),
        rng.normal(size=(2, NUMBERS.size)),
    )
    frame = mi.TensorXf(frame.astype(np.float32))
    numbers = mi.TensorXf(numbers.astype(np.float32))
    policy = wide()
    control, memory = policy.step(frame, 2, (), numbers)
    assert memory == () and np.array(control).shape == (2, 2)  # k rows of n
    numbers64 = torch.from_numpy(numbers.numpy()).double().requires_grad_()
    image = torch.from_numpy(frame.numpy()).double().requires_grad_()
    outputs = policy.module(
        image[:, :3, 6:].permute(0, 3, 1, 2),
        numbers64[:, :1],
        image[:, :4, :6].permute(0, 3, 1, 2),
        numbers64[:, 1:5].reshape(2, 2, 2),
        torch.tensor([2, 2]),
    )
    expected = torch.stack([2 * outputs[:, 1], -outputs[:, 0]], 1)
    np.testing.assert_allclose(np.array(control).T, expected.detach(), rtol=1e-6)

    weight = rng.normal(size=(2, 2))  # k rows
    rows = type(control)(*map(mi.Float, weight.astype(np.float32).tolist()))
    d_image, _, d_numbers = policy.step_vjp(frame, 2, (), rows, (), numbers)
    (expected * torch.from_numpy(weight.T)).sum().backward()
    np.testing.assert_allclose(d_image.numpy(), image.grad, atol=1e-6)
    np.testing.assert_allclose(d_numbers.numpy(), numbers64.grad, atol=1e-6)
    assert not d_numbers.numpy()[:, -1].any()  # the network does not take the time


def test_stacks_of_frames_are_kept_camera_by_camera(rng):
    from mi_nerfattack.policy.preprocess import Preprocess

    class Sum(nn.Module):
        def forward(self, front, left):
            assert front.shape[1:] == (6, 4, 6) and left.shape[1:] == (6, 3, 4)
            return front[:, :3].mean((1, 2, 3)) + 10 * left[:, 3:].mean((1, 2, 3))

    policy = TorchPolicy(
        Sum(), NoGoal(), Preprocess(frames=2), inputs=Inputs(views=VIEWS)
    )
    frames = [rng.uniform(0, 1, (1, 4, 10, 3)).astype(np.float32) for _ in range(2)]
    memory = policy.initial_memory(1)
    for frame in frames:
        control, memory = policy.step(mi.TensorXf(frame), 0, memory)
    expected = frames[0][0, :4, :6].mean() + 10 * frames[1][0, :3, 6:].mean()
    assert float(control[0]) == pytest.approx(expected, rel=1e-5)


def test_a_frame_of_other_cameras_is_refused(rng):
    frame = mi.TensorXf(rng.uniform(0, 1, (1, 4, 9, 3)).astype(np.float32))
    numbers = mi.TensorXf(np.ones((1, NUMBERS.size), np.float32))
    with pytest.raises(InputError, match="9 x 4 px; .* have 10 x 4 px"):
        wide().step(frame, 0, (), numbers)


def test_functions_get_what_they_name(rng):
    arguments = {}

    def drive(route, front, step):
        arguments.update(route=route, front=front, step=step)
        return route[:, 0, 1]

    inputs = Inputs(("route", "front"), NUMBERS, VIEWS)
    policy = CallablePolicy(drive, "mine.py:drive", inputs=inputs)
    numbers = rng.normal(size=(1, NUMBERS.size)).astype(np.float32)
    frame = mi.TensorXf(rng.uniform(0, 1, (1, 4, 10, 3)).astype(np.float32))
    memory = policy.initial_memory(1)
    for step in range(2):
        control, memory = policy.step(frame, 0, memory, mi.TensorXf(numbers))
        assert arguments["step"] == step and arguments["front"].shape == (1, 3, 4, 6)
    np.testing.assert_array_equal(arguments["route"].ravel(), numbers[0, 1:5])
    assert float(control[0]) == numbers[0, 2]
    with pytest.raises(InputError, match="it asks for speed, route, time, 6 numbers"):
        policy.step(frame, 0, memory)


@pytest.mark.parametrize(
    "names", [("image",), ("front", "sonar"), ("speed",), ("front", "front")]
)
def test_unknown_inputs_are_refused(names):
    with pytest.raises(InputError, match="each of front, left, .* once|no image"):
        Inputs(names, NUMBERS, VIEWS)


def test_what_contradicts_itself_is_refused():
    with pytest.raises(InputError, match="cameras: speed is another input"):
        Inputs((), NUMBERS, {"speed": VIEWS["front"]})
    with pytest.raises(InputError, match="let both have a goal, or none"):
        TorchPolicy(nn.Flatten(), IntegerGoal(3), inputs=Inputs(("image",)))
    with pytest.raises(InputError, match="a column stands twice"):
        Action((0, 0))
    with pytest.raises(InputError, match="4 points of two numbers"):
        CAR.follow(torch.zeros(1, 2, 4), torch.ones(1))


def test_one_column_in_a_list_is_one_control():
    policy = TorchPolicy(nn.Flatten(), action=Action((1,)))
    image = mi.TensorXf([0.1, 0.2, 0.3], (1, 1, 1, 3))
    control, _ = policy.step(image, 0, ())
    d_image, _, _ = policy.step_vjp(image, 0, (), 0 * control + 1, ())
    assert control[0] == pytest.approx(0.2)
    np.testing.assert_array_equal(d_image.numpy().ravel(), [0, 1, 0])


def test_a_server_gets_the_numbers_that_are_named():
    from mi_nerfattack.policy.http.policy import HttpPolicy

    inputs = Inputs(("image", "time"), Numbers(speed=True, time=True))
    assert HttpPolicy("http://localhost", inputs=inputs).sent == ("time",)


CAR = Trajectory(
    (0.5, 1.0, 1.5, 2.0), ("steering", "acceleration"), 2.5, 3.0, 0.5, 1.5, 0.8
)


def arc(curvature, speed, times):
    """Positions on a circle, (1, k, 2): metres forward and to the left."""
    way = speed * np.array(times)
    if curvature == 0:
        return torch.tensor(np.stack([way, 0 * way], 1))[None]
    turn = curvature * way
    points = np.stack([np.sin(turn), 1 - np.cos(turn)], 1) / curvature
    return torch.tensor(points)[None]


@pytest.mark.parametrize("curvature", [0.0, 0.05, -0.12])
def test_a_circle_is_followed_with_its_own_curvature(curvature):
    speed = torch.tensor([6.0], dtype=torch.float64)
    times = tuple(0.05 * k for k in range(1, 41))
    fine = Trajectory(times, ("steering", "acceleration"), 2.5, 3.0, 0.5, 2.0, 0.8)
    steer, pull = fine.follow(arc(curvature, 6.0, times), speed)[0].tolist()
    assert steer == pytest.approx(np.arctan(2.5 * curvature), abs=2e-4)
    assert pull == pytest.approx(0.0, abs=0.01)  # chords are a little shorter
    faster = fine.follow(arc(curvature, 7.0, times), speed)[0, 1].item()
    assert faster == pytest.approx(0.8, abs=0.02)
    rate = Trajectory(times, ("heading_rate",), look_ahead_s=0.5)
    turn = rate.follow(arc(curvature, 6.0, times), speed).item()
    assert turn == pytest.approx(6 * curvature, abs=2e-3)


def test_axes_and_flat_positions():
    points, speed = arc(0.08, 5.0, CAR.times_s), torch.tensor([5.0]).double()
    expected = CAR.follow(points, speed)
    mirrored = torch.stack([-points[..., 1], points[..., 0]], 2)
    right = Trajectory(**{**vars(CAR), "axes": "right_forward"})
    np.testing.assert_allclose(right.follow(mirrored.flatten(1), speed), expected)
    with pytest.raises(InputError, match="4 points of two numbers"):
        CAR.follow(points[:, :3], speed)


def test_derivatives_of_following(rng):
    points = torch.tensor(rng.normal(0, 0.3, (3, 4, 2))).cumsum(1) + arc(
        0.05, 5.0, CAR.times_s
    )
    speed = torch.tensor([4.0, 5.0, 7.0], dtype=torch.float64)
    leaves = points.requires_grad_(), speed.requires_grad_()
    assert torch.autograd.gradcheck(CAR.follow, leaves)
    standing = torch.zeros(1, 4, 2, dtype=torch.float64, requires_grad=True)
    control = CAR.follow(standing, torch.zeros(1).double())
    control.sum().backward()
    assert control.isfinite().all() and standing.grad.isfinite().all()


def test_a_path_is_followed_at_the_vehicles_speed():
    class Path(nn.Module):
        def forward(self, image):
            points = arc(0.1, 8.0, CAR.times_s).to(image)
            return points + 0 * image.mean((1, 2, 3))[:, None, None]

    policy = TorchPolicy(
        Path(),
        NoGoal(),
        action=Action(trajectory=CAR),
        inputs=Inputs(numbers=Numbers(speed=True)),
    )
    image = mi.TensorXf(np.zeros((1, 2, 2, 3), np.float32))
    control, _ = policy.step(image, 0, (), mi.TensorXf([6.0], (1, 1)))
    steer, pull = (row[0] for row in np.array(control))
    assert 0.2 < steer < np.arctan(2.5 * 0.1) + 0.02 and 1.4 < pull < 1.6
    assert dr.width(control) == 1
    with pytest.raises(InputError, match="beside output"):
        Action(0, trajectory=CAR)
