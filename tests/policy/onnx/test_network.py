"""The operators of the ONNX interpreter against onnxruntime."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

from onnx import helper  # noqa: E402
from support.files.policies import FLOAT, check, model  # noqa: E402

from mi_nerfattack.errors import InputError  # noqa: E402
from mi_nerfattack.policy.onnx.network import OnnxNetwork  # noqa: E402


def single(operator, x, constants=(), opset=17, extra=(), **attributes):
    """Check one operator on an input x with constant further inputs."""
    names = [f"c{i}" if c is not None else "" for i, c in enumerate(constants)]
    values = dict(zip(names, constants, strict=True))
    values.pop("", None)
    node = helper.make_node(operator, ["x", *names], ["y", *extra], **attributes)
    kind = helper.np_dtype_to_tensor_dtype(x.dtype)
    output_kind = FLOAT if operator == "OneHot" else kind
    outputs = {name: (output_kind, None) for name in ("y", *extra)}
    check(model([node], {"x": (kind, x.shape)}, outputs, values, opset), x)


def integers(*values):
    return np.array(values, np.int64)


PLAIN = """Relu LeakyRelu Selu Sigmoid HardSwish Tanh Softplus Softsign Abs Neg Exp Erf
Sin Cos Identity Dropout Flatten Transpose Softmax GlobalAveragePool GlobalMaxPool"""
WIDE = {"kernel_shape": [2, 3], "strides": [2, 1]}
PADDED = {"kernel_shape": [3, 3], "pads": [1, 0, 1, 2]}
HALVED = {"kernel_shape": [2, 2], "strides": [2, 2]}
UNARY = [
    *((operator, {}) for operator in PLAIN.split()),
    ("Elu", {"alpha": 0.7}),
    ("LeakyRelu", {"alpha": 0.2}),
    ("HardSigmoid", {"alpha": 0.3}),
    ("Flatten", {"axis": 2}),
    ("Flatten", {"axis": 0}),
    ("Transpose", {"perm": [0, 2, 3, 1]}),
    ("Softmax", {"axis": 1}),
    ("ReduceMean", {"axes": [2, 3]}),
    ("ReduceMean", {"keepdims": 0}),
    ("ReduceMax", {"axes": [1], "keepdims": 0}),
    ("MaxPool", WIDE),
    ("MaxPool", PADDED | {"dilations": [1, 2]}),
    ("MaxPool", HALVED | {"ceil_mode": 1}),
    ("AveragePool", WIDE),
    ("AveragePool", PADDED),
    ("AveragePool", PADDED | {"pads": [1, 1, 1, 1], "count_include_pad": 1}),
    ("AveragePool", HALVED | {"auto_pad": "SAME_LOWER"}),
]


@pytest.mark.parametrize(("operator", "attributes"), UNARY)
def test_one_input(operator, attributes, rng):
    single(operator, rng.normal(size=(2, 3, 5, 7)).astype("f4"), **attributes)


@pytest.mark.parametrize(
    ("operator", "opset", "attributes"),
    [
        ("Softmax", 11, {"axis": 1}),
        ("Clip", 9, {"min": -0.5, "max": 0.25}),
        ("Slice", 9, {"starts": [1, 0], "ends": [5, -1], "axes": [3, 2]}),
        ("Pad", 9, {"pads": [0, 0, 1, 2, 0, 0, 0, 3], "value": 0.5}),
        ("Unsqueeze", 11, {"axes": [0, 2]}),
        ("Split", 11, {"axis": 3, "split": [3, 4], "extra": ["z"]}),
        ("Split", 17, {"axis": 2, "extra": ["z", "a", "b", "c"]}),
        ("ReduceSum", 11, {"axes": [1, 2]}),
        ("Gelu", 20, {}),
    ],
)
def test_other_versions(operator, opset, attributes, rng):
    x = rng.normal(size=(2, 3, 5, 7)).astype("f4")
    single(operator, x, opset=opset, **attributes)


@pytest.mark.parametrize("operator", ["Add", "Sub", "Mul", "Div", "Max", "Min"])
def test_two_inputs(operator, rng):
    x = rng.normal(size=(2, 3, 5, 7)).astype("f4")
    single(operator, x, [rng.normal(size=(3, 1, 7)).astype("f4")])
    single(operator, rng.integers(-9, 9, (2, 5)), [integers(3)])
    for unary in ("Log", "Sqrt", "Reciprocal"):
        single(unary, np.abs(x) + 0.1)


MODE = "coordinate_transformation_mode"
MODES = ("half_pixel", "align_corners", "asymmetric", "pytorch_half_pixel")
HALF = {"mode": "linear", MODE: "half_pixel"}
FLOOR = {"mode": "nearest", MODE: "asymmetric", "nearest_mode": "floor"}
CONSTANTS = [
    ("Pow", [np.float32(2.0)], {}),
    ("PRelu", [np.full((3, 1, 1), 0.3, "f4")], {}),
    ("Clip", [np.float32(-0.5), np.float32(0.25)], {}),
    ("Clip", [None, np.float32(0.25)], {}),
    ("Reshape", [integers(2, -1)], {}),
    ("Reshape", [integers(0, 0, -1)], {}),
    ("Squeeze", [integers(0)], {}),
    ("Unsqueeze", [integers(-1, 1)], {}),
    ("Expand", [integers(2, 1, 1, 1)], {}),
    ("Gather", [integers(2, 0, -1)], {"axis": 1}),
    ("Gather", [np.array(1)], {"axis": 3}),
    ("Slice", [integers(1), integers(100), integers(2)], {}),
    ("Slice", [integers(-1), integers(-9), integers(3), integers(-2)], {}),
    ("Slice", [integers(0, 1), integers(1, -1)], {}),
    ("Pad", [integers(0, 0, 1, 2, 0, 0, 0, 1)], {}),
    ("Pad", [integers(0, 0, 1, 2, 0, 0, 0, 1), np.float32(2.5)], {}),
    ("Pad", [integers(0, 0, 1, 2, 0, 0, 0, 1)], {"mode": "reflect"}),
    ("Pad", [integers(0, 0, 1, 2, 0, 0, 0, 1)], {"mode": "edge"}),
    ("ReduceSum", [integers()], {"noop_with_empty_axes": 1}),
    ("ReduceSum", [integers()], {"keepdims": 0}),
    ("Split", [integers(2, 5)], {"axis": 3, "extra": ["z"]}),
    ("Resize", [None, None, integers(2, 3, 9, 4)], HALF),
]


@pytest.mark.parametrize(("operator", "constants", "attributes"), CONSTANTS)
def test_constant_inputs(operator, constants, attributes, rng):
    count = 1 if operator in ("Squeeze", "Expand") else 2
    x = rng.normal(size=(count, 3, 5, 7)).astype("f4")
    single(operator, x, constants, **attributes)


@pytest.mark.parametrize("scale", [0.3, 0.7, 1.7, 3.0])
@pytest.mark.parametrize(
    "attributes",
    [FLOOR, *(HALF | {MODE: name} for name in MODES)],
)
def test_resize_by_scales_that_do_not_divide(attributes, scale, rng):
    """The scale is used as given, and 10 times float32(0.7) is 7 in float32."""
    x = rng.normal(size=(2, 3, 10, 33)).astype("f4")
    scales = np.array([1, 1, scale, 0.9 * scale], "f4")
    single("Resize", x, [None, scales], **attributes)
    if scale == 3 and attributes in (HALF, FLOOR):  # reads at asymmetric places
        single("Upsample", x, [scales], opset=9, mode=attributes["mode"])


PYTORCH = HALF | {MODE: "pytorch_half_pixel"}
ASPECT = HALF | {"keep_aspect_ratio_policy": "not_larger"}
CUBIC = {"mode": "cubic", "name": "up"}
TWICE = np.float32([1, 1, 2, 2])
POOL = {"kernel_shape": [1, 1], "strides": [3, 3], "ceil_mode": 1}
FLAT = np.zeros((12, 5), "f4")  # recurrent weights without a direction
INFINITY = np.float32(np.inf)


@pytest.mark.parametrize(
    ("operator", "constants", "opset", "attributes", "message"),
    [
        ("Resize", [None, None, integers(1, 1, 1, 4)], 17, PYTORCH, "a size of 1"),
        ("Resize", [None, None, integers(1, 1, 3, 4)], 18, ASPECT, "'not_larger'"),
        ("Resize", [None, TWICE], 17, CUBIC, "net.onnx: node up: Resize: mode 'cubic'"),
        ("Resize", [TWICE], 10, {}, "set 10.* 11"),
        *(
            ("Resize", [None, np.float32([1, 1, 2, bad])], 17, HALF, "net.onnx: .*Resi")
            for bad in (np.inf, np.nan, 3e38, 1e-40, 0, -2)
        ),
        ("OneHot", [INFINITY, np.float32([0, 1])], 17, {}, "infinity"),
        ("Reshape", [INFINITY[None]], 17, {}, "infinity"),
        ("LSTM", [FLAT, FLAT], 17, {"hidden_size": 3}, "LSTM.*matrix"),
        ("MaxPool", [], 17, POOL, r"ceil_mode with strides \[3, 3\]"),
    ],
)
def test_attributes_that_are_refused(operator, constants, opset, attributes, message):
    names = [f"c{i}" if c is not None else "" for i, c in enumerate(constants)]
    values = {n: c for n, c in zip(names, constants, strict=True) if n}
    node = helper.make_node(operator, ["x", *names], ["y"], **attributes)
    shape = [1, 1, 5, 5]
    made = model([node], {"x": (FLOAT, shape)}, {"y": (FLOAT, None)}, values, opset)
    with pytest.raises(InputError, match=message):
        OnnxNetwork(made, "net.onnx")(torch.zeros(shape))


@pytest.mark.parametrize(
    "attributes",
    [
        {},
        {"strides": [2, 1], "pads": [1, 0, 2, 3]},
        {"dilations": [1, 2], "pads": [0, 1, 1, 0]},
        {"strides": [3, 2], "auto_pad": "SAME_UPPER"},
        {"strides": [2, 3], "auto_pad": "SAME_LOWER"},
        {"auto_pad": "VALID"},
    ],
)
def test_convolution(attributes, rng):
    x = rng.normal(size=(2, 4, 8, 11)).astype("f4")
    weight = rng.normal(size=(6, 4, 3, 3)).astype("f4")
    single("Conv", x, [weight, np.arange(6, dtype="f4")], **attributes)
    single("Conv", x, [weight[:, :2]], group=2, **attributes)
    single("Conv", x[:, :, 0], [weight[:, :, 0]])


def test_products_and_norms(rng):
    x, b = rng.normal(size=(4, 5)).astype("f4"), rng.normal(size=(5, 3)).astype("f4")
    c = rng.normal(size=3).astype("f4")
    single("MatMul", x, [b])
    single("MatMul", rng.normal(size=(2, 3, 4, 5)).astype("f4"), [b])
    single("Gemm", x, [b, c])
    single("Gemm", x, [b.T.copy(), c], transB=1, alpha=0.5, beta=2.0)
    single("Gemm", x.T.copy(), [b], transA=1)
    image = rng.normal(size=(2, 3, 4, 5)).astype("f4")
    scale, bias, mean = (rng.normal(size=3).astype("f4") for _ in range(3))
    variance = rng.uniform(0.5, 2, 3).astype("f4")
    single("BatchNormalization", image, [scale, bias, mean, variance], epsilon=1e-3)
    for axis in (-1, 0, 1):
        goals = integers(2, 0, -1)
        single("OneHot", goals, [integers(3), np.float32([0.5, 2.0])], axis=axis)
    row = rng.normal(size=5).astype("f4")
    single("LayerNormalization", image, [row, row[::-1].copy()], epsilon=1e-4)


@pytest.mark.parametrize("direction", ["forward", "reverse", "bidirectional"])
@pytest.mark.parametrize(
    ("operator", "gates", "attributes"),
    [("LSTM", 4, {}), ("GRU", 3, {}), ("GRU", 3, {"linear_before_reset": 1})],
)
def test_recurrent_layers(operator, gates, attributes, direction, rng):
    count, size = 2 if direction == "bidirectional" else 1, 3
    x = rng.normal(size=(4, 2, 5)).astype("f4")
    constants = [
        rng.normal(size=(count, gates * size, 5)).astype("f4"),
        rng.normal(size=(count, gates * size, size)).astype("f4"),
        rng.normal(size=(count, 2 * gates * size)).astype("f4"),
        None,
        rng.normal(size=(count, 2, size)).astype("f4"),
    ]
    extra = ["h", "c"] if operator == "LSTM" else ["h"]
    attributes = {"hidden_size": size, "direction": direction, **attributes}
    single(operator, x, constants[:2], extra=extra, **attributes)
    if operator == "LSTM":
        constants.append(rng.normal(size=(count, 2, size)).astype("f4"))
    single(operator, x, constants, extra=extra, **attributes)


def test_shapes_computed_in_the_graph(rng):
    """Flatten as exporters write it: Shape, Gather, Unsqueeze, Concat, Reshape."""
    nodes = [
        helper.make_node("Shape", ["x"], ["shape"]),
        helper.make_node("Constant", [], ["zero"], value_int=0),
        helper.make_node("Gather", ["shape", "zero"], ["count"]),
        helper.make_node("Unsqueeze", ["count", "axis"], ["counts"]),
        helper.make_node("Concat", ["counts", "rest"], ["target"], axis=0),
        helper.make_node("Reshape", ["x", "target"], ["flat"]),
        helper.make_node("ConstantOfShape", ["target2"], ["zeros"]),
        helper.make_node("Cast", ["count"], ["factor"], to=FLOAT),
        helper.make_node("Mul", ["flat", "factor"], ["scaled"]),
        helper.make_node("Add", ["scaled", "zeros"], ["added"]),
        helper.make_node("Less", ["added", "half"], ["below"]),
        helper.make_node("Where", ["below", "half", "added"], ["y"]),
    ]
    constants = {
        "axis": integers(0),
        "rest": integers(-1),
        "target2": integers(1, 12),
        "half": np.float32(0.5),
    }
    made = model(nodes, {"x": (FLOAT, ["n", 3, 4])}, {"y": (FLOAT, None)}, constants)
    check(made, rng.normal(size=(5, 3, 4)).astype("f4"))
