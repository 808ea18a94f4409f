"""Operators of vision networks and transformers: onnxruntime, and differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from onnx import TensorProto, helper
from support.files.policies import FLOAT, check, model

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.network import OnnxNetwork

INT64, BOOL = TensorProto.INT64, TensorProto.BOOL
KINDS = {"f": FLOAT, "i": INT64, "b": BOOL}


def one(operator, x, constants=(), opset=18, output_kind=None, extra=(), **attributes):
    """Make a model of an operator of x, whose further inputs are constant."""
    names = [f"c{i}" if c is not None else "" for i, c in enumerate(constants)]
    values = {n: c for n, c in zip(names, constants, strict=True) if n}
    node = helper.make_node(operator, ["x", *names], ["y", *extra], **attributes)
    kind = KINDS[x.dtype.kind]
    outputs = {"y": (output_kind or kind, None), **{n: (INT64, None) for n in extra}}
    return model([node], {"x": (kind, x.shape)}, outputs, values, opset)


def integers(*values):
    return np.array(values, np.int64)


def floats(*shape):
    return np.random.default_rng(sum(shape)).normal(size=shape).astype("f4")


X = floats(2, 4, 6, 8)
KERNEL = floats(4, 3, 3, 3)
PAIR = [floats(4), floats(4)]
SMOOTH = [
    *((name, X, [], {}) for name in ("Mish", "Celu", "Atan", "Sinh", "Cosh", "Asinh")),
    *((name, 0.4 * np.tanh(X), [], {}) for name in ("Tan", "Asin", "Acos", "Atanh")),
    ("Acosh", 1.5 + np.abs(X), [], {}),
    ("Celu", X, [], {"alpha": 0.6}),
    ("LogSoftmax", X, [], {"axis": 1}),
    ("ThresholdedRelu", X, [], {"alpha": 0.3}),
    ("Mean", X, [X[:1], floats(8)], {}),
    ("Mod", np.abs(X), [np.float32(0.7)], {"fmod": 1}),
    ("ReduceL1", X, [integers(1, 2)], {}),
    ("ReduceL2", X, [integers(-1)], {"keepdims": 0}),
    ("ReduceLogSum", np.abs(X), [integers(2)], {}),
    ("ReduceLogSumExp", X, [integers(1, 3)], {}),
    ("ReduceProd", X[:, :2, :2, :2], [integers(1, -1)], {}),
    ("ReduceProd", X[:, :2, :2, :2], [integers(1, 3)], {"keepdims": 0}),
    ("ReduceSumSquare", X, [], {}),
    ("Einsum", X, [floats(2, 4, 5, 8)], {"equation": "bhid, bhjd -> bhij"}),
    ("Einsum", X, [floats(8, 3)], {"equation": "...k,kl->...l"}),
    ("ConvTranspose", X, [KERNEL], {}),
    ("ConvTranspose", X, [KERNEL, floats(3)], {"strides": [2, 3]}),
    (
        "ConvTranspose",
        X,
        [KERNEL, floats(3)],
        {"strides": [2, 3], "pads": [1, 0, 0, 2], "output_padding": [1, 2]},
    ),
    ("ConvTranspose", X, [KERNEL[:, :2]], {"group": 2, "dilations": [2, 1]}),
    ("ConvTranspose", X, [KERNEL], {"strides": [2, 2], "auto_pad": "SAME_UPPER"}),
    ("ConvTranspose", X, [KERNEL], {"strides": [2, 2], "auto_pad": "SAME_LOWER"}),
    ("ConvTranspose", X, [KERNEL], {"strides": [2, 2], "output_shape": [12, 16]}),
    ("ConvTranspose", X[:, :, 0], [KERNEL[..., 0]], {"strides": [2]}),
    ("InstanceNormalization", X, PAIR, {"epsilon": 1e-3}),
    ("GroupNormalization", X, [floats(2), floats(2)], {"num_groups": 2}),
    ("LpNormalization", X, [], {"axis": 1, "p": 1}),
    ("LpNormalization", X, [], {}),
    ("MeanVarianceNormalization", X, [], {}),
    ("GridSample", X, [np.tanh(floats(2, 3, 5, 2))], {}),
    ("GridSample", X, [floats(2, 3, 5, 2)], {"padding_mode": "border"}),
    ("GridSample", X, [floats(2, 3, 5, 2)], {"align_corners": 1}),
    ("DepthToSpace", X, [], {"blocksize": 2}),
    ("DepthToSpace", X, [], {"blocksize": 2, "mode": "CRD"}),
    ("SpaceToDepth", X, [], {"blocksize": 2}),
    ("Tile", X, [integers(1, 2, 1, 3)], {}),
    ("Trilu", X, [], {}),
    ("Trilu", X, [np.array(-1)], {"upper": 0}),
    ("CumSum", X, [np.array(1)], {}),
    ("CumSum", X, [np.array(-1)], {"exclusive": 1, "reverse": 1}),
    ("GatherElements", X, [integers(0, -1).reshape(1, 1, 1, 2)], {"axis": 2}),
    ("GatherND", X, [integers([0, 1], [1, -1])], {}),
    ("GatherND", X, [integers([[0], [3]], [[1], [-1]])], {"batch_dims": 1}),
    (
        "ScatterElements",
        X,
        [integers(1, -2).reshape(1, 1, 1, 2), floats(1, 1, 1, 2)],
        {"axis": 3},
    ),
    (
        "ScatterElements",
        X,
        [integers(1, 1).reshape(1, 1, 1, 2), floats(1, 1, 1, 2)],
        {"axis": 3, "reduction": "add"},
    ),
    ("ScatterND", X, [integers([0, 1], [1, -2]), floats(2, 6, 8)], {}),
    (
        "ScatterND",
        X,
        [integers([0, 1], [0, 1]), floats(2, 6, 8)],
        {"reduction": "add"},
    ),
    ("CastLike", X, [np.float32(0)], {}),
]
FLAT = [
    *((name, X, [], {}) for name in ("Ceil", "Floor", "Sign")),
    ("Round", np.float32([-1.5, -0.5, 0.4, 0.5, 1.5, 2.5]), [], {}),
    ("IsNaN", np.float32([0, np.nan, np.inf]), [], {"output_kind": BOOL}),
    ("IsInf", np.float32([0, np.nan, -np.inf]), [], {"output_kind": BOOL}),
    ("GreaterOrEqual", X, [X[:1]], {"output_kind": BOOL}),
    ("LessOrEqual", X, [X[:1]], {"output_kind": BOOL}),
    *((name, X > 0, [X[:1] > 0.5], {}) for name in ("And", "Or", "Xor")),
    ("Not", X > 0, [], {}),
    ("Mod", integers(-7, 7, 5), [integers(3, -3, 2)], {}),
    ("ArgMax", X, [], {"axis": 1, "output_kind": INT64}),
    ("ArgMin", X, [], {"axis": -1, "keepdims": 0, "output_kind": INT64}),
    ("NonZero", X > 0.5, [], {"output_kind": INT64}),
    ("Size", X, [], {"output_kind": INT64}),
    ("Range", integers(3), [np.array(-5), np.array(-2)], {}),
    ("Range", np.float32([0.5]), [np.float32(2), np.float32(0.4)], {}),
    ("Range", integers(3), [np.array(1), np.array(1)], {}),
    ("GridSample", X, [np.tanh(floats(2, 3, 5, 2))], {"mode": "nearest", "opset": 16}),
    ("LogSoftmax", X, [], {"opset": 11}),
]
TOP = [
    ("TopK", X, [integers(3)], {"extra": ["i"]}),
    ("TopK", X, [integers(2)], {"axis": 1, "largest": 0, "extra": ["i"]}),
]


@pytest.mark.parametrize(("operator", "x", "constants", "options"), SMOOTH + FLAT + TOP)
def test_values(operator, x, constants, options):
    check(one(operator, x, constants, **options), x, tolerance=2e-5)


@pytest.mark.parametrize(("operator", "x", "constants", "options"), SMOOTH + TOP)
def test_derivatives(operator, x, constants, options):
    network = OnnxNetwork(one(operator, x, constants, **options), "net.onnx").double()
    leaf = torch.tensor(x, dtype=torch.float64, requires_grad=True)

    def weighed(values):
        output = network(values)[0]
        weights = torch.linspace(0.5, 1.7, output.numel(), dtype=torch.float64)
        return (output * weights.reshape(output.shape)).sum()

    assert torch.autograd.gradcheck(weighed, leaf, fast_mode=True, atol=1e-6)


@pytest.mark.parametrize(
    ("operator", "x", "constants", "options", "message"),
    [
        ("GridSample", X, [floats(2, 3, 5, 2)], {"mode": "cubic"}, "mode 'cubic'"),
        ("Range", integers(0), [np.array(9), np.array(0)], {}, "from 0 to 9 by 0"),
        ("Range", integers(0), [np.array(1 << 40), np.array(1)], {}, "at most"),
        ("ArgMax", X, [], {"select_last_index": 1}, "select_last_index"),
        ("ScatterND", X, [integers([0]), X[:1]], {"reduction": "mul"}, "'mul'"),
    ],
)
def test_refused(operator, x, constants, options, message):
    network = OnnxNetwork(one(operator, x, constants, **options), "net.onnx")
    with pytest.raises(InputError, match=f"net.onnx: .*{operator}.*{message}"):
        network(torch.tensor(x))
