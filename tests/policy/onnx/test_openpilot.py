"""Pairs of openpilot's form: against onnxruntime, differences, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import onnxruntime as runtime
import pytest
import torch
from support.faults.refusals import refusals
from support.files.openpilot import FLOAT, HALF, SPEED, TIMES, Pair
from support.reference.derivatives import central_difference

from mi_nerfattack.policy.action import Trajectory
from mi_nerfattack.policy.onnx.network import OnnxNetwork
from mi_nerfattack.policy.onnx.openpilot import Openpilot, PackYuv
from mi_nerfattack.scenario.policy.kinds import PolicySection
from mi_nerfattack.scenario.section import read_section

NEW = Pair(size=(8, 12), width=24, count=4)
OLD = replace(NEW, older=True, images=FLOAT)
VIEWS = {
    "road": (slice(0, 16), slice(0, 24)),
    "wide": (slice(2, 18), slice(20, 44)),
}


def packed(image: np.ndarray) -> np.ndarray:
    """Planes (6, h / 2, w / 2) of sRGB (h, w, 3), pixel by pixel."""
    red, green, blue = 255 * np.moveaxis(image.astype(float), -1, 0)
    y = 16 + 0.257 * red + 0.504 * green + 0.098 * blue
    u = 128 - 0.148 * red - 0.291 * green + 0.439 * blue
    v = 128 + 0.439 * red - 0.368 * green - 0.071 * blue
    rows, columns = y.shape
    planes = np.zeros((6, rows // 2, columns // 2))
    for i in range(rows // 2):
        for j in range(columns // 2):
            block = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
            planes[:4, i, j] = y[block].T.ravel()  # column by column
            planes[4, i, j], planes[5, i, j] = u[block].mean(), v[block].mean()
    return planes


def test_images_are_packed(rng):
    image = rng.random((2, 6, 8, 3))
    planes = torch.tensor(image.transpose(0, 3, 1, 2), requires_grad=True)
    actual = PackYuv().apply(planes)
    expected = [packed(one) for one in image]
    np.testing.assert_allclose(actual.detach(), expected, atol=1e-9)
    assert torch.autograd.gradcheck(PackYuv().apply, planes)
    white = PackYuv().apply(torch.ones(1, 3, 2, 2, dtype=torch.float64))
    np.testing.assert_allclose(white.flatten(), [235] * 4 + [128] * 2, atol=0.1)


class Runtime:
    """A pair in onnxruntime, with its queues, for one vehicle."""

    def __init__(self, pair: Pair, stride: int, frame_stride: int, traffic, delay):
        self.pair, self.stride, self.traffic = pair, stride, traffic
        self.frame_stride, self.delay = frame_stride, delay
        self.vision, self.policy = (
            runtime.InferenceSession(made.SerializeToString()) for made in pair.models()
        )
        self.frames = []
        self.features = [np.zeros(pair.width)] * 200

    def step(self, frame: np.ndarray, speed: float) -> np.ndarray:
        """Return positions (32, 2), forward and left."""
        pair, older = self.pair, max(0, len(self.frames) - self.frame_stride)
        self.frames.append(frame)
        images = []
        for part in VIEWS.values():
            two = [packed(self.frames[k][part]) for k in (older, -1)]
            images.append(np.concatenate(two)[None])
        kind = {FLOAT: "f4", HALF: "f2"}.get(pair.images)
        images = [i.astype(kind) if kind else i.round().astype("u1") for i in images]
        names = [item.name for item in self.vision.get_inputs()]
        (vector,) = self.vision.run(None, dict(zip(names, images, strict=True)))
        self.features.append(vector[0, slice(*pair.features)])
        chosen = self.features[:: -self.stride][: pair.count][::-1]
        shapes = {item.name: item.shape for item in self.policy.get_inputs()}
        inputs = {name: np.zeros(shape, "f4") for name, shape in shapes.items()}
        inputs["features_buffer"] = np.float32(chosen)[None]
        inputs["traffic_convention"] = np.float32([self.traffic])
        if "lateral_control_params" in inputs:
            inputs["lateral_control_params"] = np.float32([[speed, self.delay]])
        (vector,) = self.policy.run(None, inputs)
        plan = vector[0, slice(*pair.plan)]
        if pair.hypotheses:
            rows = plan.reshape(pair.hypotheses, 991)
            plan = rows[rows[:, 990].argmax()]
        return plan[:495].reshape(33, 15)[1:, :2] * [1, -1]


@pytest.mark.parametrize(
    ("pair", "keys"),
    [
        (NEW, {}),
        (replace(NEW, hypotheses=5), {"stride": 2, "traffic": "left"}),
        (OLD, {"frame_stride": 1, "steering_delay_s": 0.35}),
        (replace(NEW, images=HALF), {"stride": 1}),
    ],
)
def test_drives_are_those_of_onnxruntime(pair, keys, tmp_path, rng, variant):
    pair.save(tmp_path)
    keys = {"kind": "openpilot", "file": "driving_policy.onnx", **keys}
    keys |= {"vision_file": "driving_vision.onnx", "features": pair.features}
    keys |= {"plan": pair.plan}
    policy = read_section("policy", PolicySection, keys, tmp_path).build(VIEWS)
    follow = Trajectory(tuple(TIMES[1:]))
    traffic = [0, 1] if keys.get("traffic") == "left" else [1, 0]
    order = keys.get("stride", 4), keys.get("frame_stride", 4)
    delay = keys.get("steering_delay_s", 0.2)
    twins = [Runtime(pair, *order, traffic, delay) for _ in range(2)]
    memory, controls = policy.initial_memory(2), []
    for _ in range(7):
        frame = rng.integers(0, 256, (2, 18, 44, 3)).astype("f4") / 255
        speed = np.array([6.0, 9.0])
        numbers = mi.TensorXf(speed[:, None])
        control, memory = policy.step(mi.TensorXf(frame), 0, memory, numbers)
        points = [t.step(f, v) for t, f, v in zip(twins, frame, speed, strict=True)]
        expected = follow.follow(torch.tensor(np.array(points)), torch.tensor(speed))
        np.testing.assert_allclose(control, expected, rtol=2e-3, atol=2e-3)
        controls.append(np.array(control))
    assert np.std(controls) > 0.02  # which images change


def test_shapes_of_the_real_files(rng):
    module = Pair(hypotheses=5).module()
    assert module.recurrent == ((-1, 96, 512),) and module.batch == 1
    images = (torch.rand(1, 12, 128, 256) * 255 for _ in range(2))
    with torch.no_grad():
        positions, after = module(*images, torch.ones(1, 1), torch.zeros(1, 96, 512))
    assert positions.shape == (1, 32, 2) and after.shape == (1, 96, 512)
    assert after[0, -1].abs().max() > 0 and not after[0, :-1].any()
    assert 0.5 * SPEED < positions[0, -1, 0] / 10 < 1.5 * SPEED


def leaves(module: Openpilot, rng, rows: int, columns: int) -> list[torch.Tensor]:
    (_, length, width), *_ = module.recurrent
    shapes = [(1, 12, rows, columns)] * 2 + [(1, 1), (1, length, width)]
    scales = 255, 255, 8, 1
    pairs = zip(shapes, scales, strict=True)
    return [torch.tensor(scale * rng.random(shape)) for shape, scale in pairs]


@pytest.mark.parametrize("part", range(4))
def test_derivatives_by_each_argument_through_the_history(part, rng):
    module = OLD.module(stride=1).double()
    start = leaves(module, rng, *OLD.size)
    way = torch.tensor(rng.normal(size=start[part].shape))
    weight = torch.tensor(rng.normal(size=(3, 32, 2)))

    def value(step, leaf=None):
        arguments = list(start)
        arguments[part] = (start[part] if leaf is None else leaf) + step * way
        *pictures, history = arguments
        total = 0
        for period in range(3):
            positions, history = module(*pictures, history)
            total = total + (weight[period] * positions).sum()
        return total

    leaf = start[part].clone().requires_grad_()
    value(0.0, leaf).backward()
    slope = central_difference(lambda s: float(value(s)), 1e-4)
    assert (leaf.grad * way).sum().item() == pytest.approx(slope, rel=1e-6)


def test_bytes_are_rounded_straight_through(rng):
    start = leaves(NEW.module(), rng, *NEW.size)
    rounded, exact = [], []
    for pair, answers in ((NEW, rounded), (replace(NEW, images=FLOAT), exact)):
        module = pair.module().double()
        pictures = [x.round() if pair.images == FLOAT else x.clone() for x in start[:2]]
        pictures = [x.requires_grad_() for x in pictures]
        positions, _ = module(*pictures, *start[2:])
        positions.sum().backward()
        answers += [positions.detach(), *(x.grad for x in pictures)]
    for one, other in zip(rounded, exact, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
        assert one.abs().max() > 0


def renamed(pair: Pair, old: str, new: str, **slices):
    """Make a module of files in which an input has another name."""
    networks = []
    for made in pair.models():
        for item in made.graph.input:
            item.name = new if item.name == old else item.name
        for part in made.graph.node:
            part.input[:] = [new if name == old else name for name in part.input]
        networks.append(OnnxNetwork(made, "driving.onnx", rounds=True))
    slices = {"features": pair.features, "plan": pair.plan} | slices
    return Openpilot(*networks, **slices)


def evaluated(**slices):
    module = renamed(NEW, "", "", **slices)
    return module(*[x.float() for x in leaves(module, np.random.default_rng(0), 8, 12)])


def section(folder, **keys):
    NEW.save(folder)
    keys = {"kind": "openpilot", "file": "driving_policy.onnx", **keys}
    keys = {"vision_file": "driving_vision.onnx", "features": (7, 31)} | keys
    return read_section("policy", PolicySection, {"plan": (7, 997)} | keys, folder)


test_refused = refusals(
    (lambda: PackYuv().apply(torch.zeros(1, 3, 5, 4)), r"even height.*\(3, 5, 4\)"),
    (lambda: PackYuv().apply(torch.zeros(1, 1, 4, 4)), r"3 channels.*\(1, 4, 4\)"),
    (lambda: renamed(NEW, "big_img", "radar"), "'radar' is not known.*big_img"),
    (lambda: renamed(NEW, "big_img", "input_imgs"), "lacks an image"),
    (lambda: renamed(NEW, "desire_pulse", "nav"), "'nav' is not known.*desire_pulse"),
    (lambda: renamed(NEW, "features_buffer", "desire"), "no input 'features_buffer'"),
    (lambda: renamed(NEW, "", "", features=(0, 23)), "23 numbers.*of 4 times 24"),
    (lambda: renamed(NEW, "", "", plan=(0, 991 * 2 + 1)), "1983 numbers; 990 of one"),
    (lambda: evaluated(features=(30, 54)), r"features: \[30, 54\].* has 36 numbers"),
    (lambda: evaluated(plan=(100, 1090)), r"plan: \[100, 1090\].* has 1002 numbers"),
    (lambda folder: section(folder).build(), r"road and wide.*\[\[cameras\]\]"),
    (lambda folder: section(folder).build({"road": VIEWS["road"]}), "gets road"),
    (lambda folder: section(folder, inputs=["image"]), "inputs: .*leave it out"),
    (lambda folder: section(folder, trajectory={"times_s": [1.0]}), "its own times"),
    (lambda folder: section(folder, trajectory={"speed_s": 11.0}), "at most 10"),
    (lambda folder: section(folder, trajectory={"axes": "left_forward"}), "axes"),
    (lambda folder: section(folder, preprocess={"frames": 3}), "preprocess.frames"),
    (lambda folder: section(folder, traffic="up"), "traffic"),
    (
        lambda folder: read_section(
            "policy", PolicySection, {"file": "a.onnx", "trajectory": {}}, folder
        ),
        "trajectory.times_s: is missing",
    ),
)
