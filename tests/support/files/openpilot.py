"""Synthetic pairs of ONNX files with the interface of openpilot's, and their twin."""

from __future__ import annotations

import base64
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper
from support.files.policies import model

from mi_nerfattack.policy.onnx.network import OnnxNetwork
from mi_nerfattack.policy.onnx.openpilot import Openpilot

UINT8, HALF, FLOAT = TensorProto.UINT8, TensorProto.FLOAT16, TensorProto.FLOAT
TIMES = 10 * (np.arange(33) / 32) ** 2
BEFORE, AFTER = 7, 5  # numbers of an output beside the slice
SPEED = 8.0  # metres per second, of the plan without images


@dataclass(frozen=True)
class Pair:
    """Models of a vision and a policy network, and the slices of their outputs.

    Args:
        older: float images, the names of older files, and two more inputs.
        size: rows and columns of a plane.
        width: numbers of the features.
        count: features of the policy's input.
        hypotheses: plans in the output, 0 for one without a logit.
        images: element type of the images.
        gain: of the plan by the features.
    """

    older: bool = False
    size: tuple[int, int] = (128, 256)
    width: int = 512
    count: int = 25
    hypotheses: int = 0
    images: int = UINT8
    gain: float = 1.0

    @property
    def features(self) -> tuple[int, int]:
        return BEFORE, BEFORE + self.width

    @property
    def plan(self) -> tuple[int, int]:
        size = 990 if self.hypotheses == 0 else 991 * self.hypotheses
        return BEFORE, BEFORE + size

    def networks(self) -> tuple[OnnxNetwork, OnnxNetwork]:
        vision, policy = self.models()
        return OnnxNetwork(vision, "vision", rounds=True), OnnxNetwork(policy, "policy")

    def module(self, **options) -> Openpilot:
        return Openpilot(*self.networks(), self.features, self.plan, **options)

    def models(self) -> tuple[onnx.ModelProto, onnx.ModelProto]:
        rng = np.random.default_rng(3)
        return self._vision(rng), self._policy(rng)

    def save(self, folder: Path) -> None:
        for name, made in zip(("vision", "policy"), self.models(), strict=True):
            onnx.save(made, folder / f"driving_{name}.onnx")

    def _vision(self, rng: np.random.Generator) -> onnx.ModelProto:
        """Convolve both images, then a layer with a tanh."""
        rows, columns = self.size
        first, second = (8, 4) if rows >= 32 else (2, 1)
        places = rows // (first * second) * (columns // (first * second))
        names = ("input_imgs", "big_input_imgs") if self.older else ("img", "big_img")
        values = {
            "w0": normal(rng, 8, 24, first, first),
            "w1": normal(rng, 16, 8, second, second),
            "w2": normal(rng, 16 * places, self.width + BEFORE + AFTER),
            "middle": np.float32(128),
            "root": np.float32(np.sqrt(2)),
            "half": np.float32(0.5),
            "one": np.float32(1),
            "scale": np.float32(1 / 64),
        }
        nodes = [
            node("Cast", names[0], "road", to=FLOAT),
            node("Cast", names[1], "wide", to=FLOAT),
            node("Concat", "road wide", "bytes", axis=1),
            node("Sub", "bytes middle", "centred"),
            node("Mul", "centred scale", "image"),
            node("Conv", "image w0", "a", strides=[first] * 2),
            node("Div", "a root", "b"),  # Gelu, as exporters write it
            node("Erf", "b", "c"),
            node("Add", "c one", "d"),
            node("Mul", "a d", "e"),
            node("Mul", "e half", "f"),
            node("Conv", "f w1", "g", strides=[second] * 2),
            node("Flatten", "g", "h"),
            node("Gemm", "h w2", "i"),
            node("Tanh", "i", "outputs"),
        ]
        kind = (self.images, [1, 12, *self.size])
        return described(nodes, dict.fromkeys(names, kind), values, self.features, True)

    def _policy(self, rng: np.random.Generator) -> onnx.ModelProto:
        """Attend to the features, add what else is given, and bend a plan."""
        start, stop = self.plan
        total, inner = stop + AFTER, 16
        bias = np.zeros(total, "f4")
        step = 990 + bool(self.hypotheses)
        for first in range(start, stop, step):
            means = bias[first : first + 495].reshape(33, 15)
            means[:, 0] = SPEED * TIMES
        bend = normal(rng, inner, total)
        for first in range(start, stop, step):
            bend[:, first : first + 495] *= np.repeat(self.gain * TIMES, 15)
        inputs = {"desire" if self.older else "desire_pulse": (1, self.count, 8)}
        inputs |= {"traffic_convention": (1, 2)}
        if self.older:
            inputs |= {"lateral_control_params": (1, 2)}
            inputs |= {"prev_desired_curv": (1, self.count, 1)}
        inputs |= {"features_buffer": (1, self.count, self.width)}
        values = {name: normal(rng, self.width, inner) for name in ("q", "k", "v")}
        values |= {"bend": bend, "bias": bias, "size": np.float32(0.25)}
        values |= {"ones": np.ones(inner, "f4"), "nought": np.zeros(inner, "f4")}
        values |= {"last": np.array(-1)}
        nodes = [
            node("MatMul", "features_buffer q", "queries"),
            node("MatMul", "features_buffer k", "keys"),
            node("MatMul", "features_buffer v", "values"),
            node("Transpose", "keys", "turned", perm=[0, 2, 1]),
            node("MatMul", "queries turned", "products"),
            node("Mul", "products size", "scores"),
            node("Softmax", "scores", "weights", axis=-1),
            node("MatMul", "weights values", "attended"),
            node("Add", "attended values", "sum0"),
            node("LayerNormalization", "sum0 ones nought", "normal"),
            node("Gather", "normal last", "sum1", axis=1),
        ]
        others = [name for name in inputs if name != "features_buffer"]
        for i, name in enumerate(others):
            values[f"m{i}"] = normal(rng, int(np.prod(inputs[name])), inner)
            nodes += [
                node("Flatten", name, f"flat{i}"),
                node("MatMul", f"flat{i} m{i}", f"part{i}"),
                node("Add", f"sum{i + 1} part{i}", f"sum{i + 2}"),
            ]
        nodes.append(node("Gemm", f"sum{len(others) + 1} bend bias", "outputs"))
        named = {name: (FLOAT, list(shape)) for name, shape in inputs.items()}
        return described(nodes, named, values, self.plan, False)


def node(operator: str, inputs: str, output: str, **attributes) -> onnx.NodeProto:
    return helper.make_node(operator, inputs.split(), [output], **attributes)


def normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    fan = shape[0] if len(shape) == 2 else np.prod(shape[1:])
    return rng.normal(0, 1 / np.sqrt(fan), shape).astype("f4")


def described(
    nodes: Sequence[onnx.NodeProto],
    inputs: dict,
    values: dict,
    part: tuple[int, int],
    is_vision: bool,
) -> onnx.ModelProto:
    """Make a model whose metadata names the slice, as openpilot's does."""
    outputs = {"outputs": (FLOAT, [1, part[1] + AFTER])}
    made = model(nodes, inputs, outputs, values)
    slices = {"hidden_state" if is_vision else "plan": slice(*part)}
    text = base64.b64encode(pickle.dumps(slices)).decode()
    made.metadata_props.add(key="output_slices", value=text)
    return made
