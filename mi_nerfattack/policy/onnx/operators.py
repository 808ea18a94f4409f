"""ONNX operators on values and shapes, as functions of torch.

Source: the operators' specification at onnx.ai/onnx/operators.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce

import torch
from torch.nn import functional

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.call import Call, Operator
from mi_nerfattack.policy.onnx.indexing import INDEXING
from mi_nerfattack.policy.onnx.layers import LAYERS
from mi_nerfattack.policy.onnx.recurrent import RECURRENT

#: Element types of ONNX that stay integers or booleans; floating ones become one type.
_INTEGER_TYPES = {
    2: torch.uint8,
    3: torch.int8,
    5: torch.int16,
    6: torch.int32,
    7: torch.int64,
    9: torch.bool,
}
_FLOATING_TYPES = (1, 10, 11, 16)


def _one(function: Callable[[torch.Tensor], torch.Tensor]) -> Operator:
    """Make an operator of one input."""
    return lambda call: function(call.x)


def _many(
    function: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
) -> Operator:
    """Make an operator that folds its inputs, two at a time."""

    def fold(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        # shapes are computed on the CPU: a constant of theirs may meet a GPU's value
        return function(a.to(b.device), b) if b.is_cuda else function(a, b.to(a.device))

    return lambda call: reduce(fold, [call.need(i) for i in range(len(call.inputs))])


def _divide(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Divide; integers towards zero."""
    are_integers = not (a.is_floating_point() or b.is_floating_point())
    return torch.div(a, b, rounding_mode="trunc") if are_integers else a / b


def gemm(call: Call) -> torch.Tensor:
    """Gemm: alpha A B + beta C."""
    a = call.x.T if call.attribute("transA", 0) else call.x
    b = call.need(1).T if call.attribute("transB", 0) else call.need(1)
    product = call.attribute("alpha", 1.0) * (a @ b)
    c = call.get(2)
    return product if c is None else product + call.attribute("beta", 1.0) * c


def clip(call: Call) -> torch.Tensor:
    """Clip: torch's subgradient, one inside and at the limits, zero outside."""
    low, high = call.number(1, "min"), call.number(2, "max")
    return call.x if low is None and high is None else call.x.clamp(low, high)


def hard_sigmoid(call: Call) -> torch.Tensor:
    """HardSigmoid: clipped alpha x + beta."""
    line = call.attribute("alpha", 0.2) * call.x + call.attribute("beta", 0.5)
    return line.clamp(0, 1)


def softmax(call: Call) -> torch.Tensor:
    """Softmax; before version 13 over all axes from `axis` on."""
    if call.opset >= 13:
        return call.x.softmax(call.attribute("axis", -1))
    axis = call.attribute("axis", 1) % call.x.ndim
    return call.x.flatten(axis).softmax(-1).reshape(call.x.shape)


def log_softmax(call: Call) -> torch.Tensor:
    """LogSoftmax; before version 13 over all axes from `axis` on."""
    if call.opset >= 13:
        return call.x.log_softmax(call.attribute("axis", -1))
    axis = call.attribute("axis", 1) % call.x.ndim
    return call.x.flatten(axis).log_softmax(-1).reshape(call.x.shape)


def modulo(call: Call) -> torch.Tensor:
    """Mod, with the sign of the divisor, or with fmod that of the dividend."""
    return (torch.fmod if call.attribute("fmod", 0) else torch.remainder)(
        call.x, call.need(1)
    )


def einsum(call: Call) -> torch.Tensor:
    """Einsum."""
    operands = [call.need(i) for i in range(len(call.inputs))]
    return torch.einsum(call.attribute("equation"), *operands)


def mean(call: Call) -> torch.Tensor:
    """Mean of any number of inputs."""
    inputs = [call.need(i) for i in range(len(call.inputs))]
    return reduce(torch.add, inputs) / len(inputs)


def gelu(call: Call) -> torch.Tensor:
    """Gelu, exact or by tanh."""
    return functional.gelu(call.x, approximate=call.attribute("approximate", "none"))


def cast(call: Call) -> torch.Tensor:
    """Cast: floating types are all the precision of the evaluation."""
    target = call.attribute("to")
    if target in _FLOATING_TYPES:
        return call.x.to(call.dtype)
    if target not in _INTEGER_TYPES:
        raise InputError(f"Cast: to element type {target} is not supported")
    return call.x.to(_INTEGER_TYPES[target])


def cast_like(call: Call) -> torch.Tensor:
    """CastLike: to the type of the second input."""
    return call.x.to(call.need(1).dtype)


def shape(call: Call) -> torch.Tensor:
    """Shape, on the CPU."""
    sizes = list(call.x.shape)
    end = call.attribute("end", len(sizes))
    return torch.tensor(sizes[call.attribute("start", 0) : end], dtype=torch.int64)


def constant(call: Call) -> torch.Tensor:
    """Constant: tensor, number or list."""
    if "value" in call.attributes:
        return call.attributes["value"]
    for name, dtype in (
        ("value_float", call.dtype),
        ("value_floats", call.dtype),
        ("value_int", torch.int64),
        ("value_ints", torch.int64),
    ):
        if name in call.attributes:
            return torch.tensor(call.attributes[name], dtype=dtype)
    raise InputError("Constant: strings and sparse tensors are not supported")


def constant_of_shape(call: Call) -> torch.Tensor:
    """ConstantOfShape."""
    value = call.attribute("value", torch.zeros(1))
    if value.is_floating_point():
        value = value.to(call.device, call.dtype)
    return value.reshape(()).expand([int(size) for size in call.x.tolist()])


def reshape(call: Call) -> torch.Tensor:
    """Reshape: 0 keeps a size, -1 takes the rest."""
    sizes = call.integers(1, "shape") or []
    if not call.attribute("allowzero", 0):
        sizes = [size or call.x.shape[i] for i, size in enumerate(sizes)]
    return call.x.reshape(sizes)


def flatten(call: Call) -> torch.Tensor:
    """Flatten to two axes."""
    axis = call.attribute("axis", 1)
    axis = axis + call.x.ndim if axis < 0 else axis
    return call.x.reshape(math.prod(call.x.shape[:axis]), -1)


def transpose(call: Call) -> torch.Tensor:
    """Transpose; all axes turned round by default."""
    return call.x.permute(call.attribute("perm", list(range(call.x.ndim))[::-1]))


def concat(call: Call) -> torch.Tensor:
    """Concat."""
    inputs = [call.need(i) for i in range(len(call.inputs))]
    return torch.cat(inputs, call.attribute("axis"))


def split(call: Call) -> tuple[torch.Tensor, ...]:
    """Split into given sizes, or equal parts."""
    axis = call.attribute("axis", 0)
    sizes = call.integers(1, "split")
    if sizes is None:
        count = call.attribute("num_outputs", call.attribute("outputs"))
        return call.x.split(-(-call.x.shape[axis] // count), axis)
    return call.x.split(sizes, axis)


def squeeze(call: Call) -> torch.Tensor:
    """Squeeze given axes, or all of size one."""
    axes = call.integers(1, "axes")
    return call.x.squeeze() if axes is None else call.x.squeeze(axes)


def unsqueeze(call: Call) -> torch.Tensor:
    """Unsqueeze: axes count in the result."""
    axes = call.integers(1, "axes") or []
    rank = call.x.ndim + len(axes)
    x = call.x
    for axis in sorted(axis % rank for axis in axes):
        x = x.unsqueeze(axis)
    return x


def expand(call: Call) -> torch.Tensor:
    """Expand: both ways, as broadcasting does."""
    sizes = call.integers(1, "shape") or []
    return call.x.expand(torch.broadcast_shapes(call.x.shape, tuple(sizes)))


def _reduction(function: Callable[..., torch.Tensor]) -> Operator:
    """Make an operator that reduces given axes, or all."""

    def run(call: Call) -> torch.Tensor:
        axes = call.integers(1, "axes")
        if not axes and call.attribute("noop_with_empty_axes", 0):
            return call.x
        axes = axes or list(range(call.x.ndim))
        return function(call.x, axes, keepdim=bool(call.attribute("keepdims", 1)))

    return run


def _product(x: torch.Tensor, axes: list[int], keepdim: bool) -> torch.Tensor:
    for axis in sorted((axis % x.ndim for axis in axes), reverse=True):
        x = x.prod(axis, keepdim)
    return x


def _sum_of(
    inner: Callable[[torch.Tensor], torch.Tensor],
    outer: Callable[[torch.Tensor], torch.Tensor] | None = None,
) -> Operator:
    """Make an operator that reduces by a sum of functions, or a function of it."""

    def run(x: torch.Tensor, axes: list[int], keepdim: bool) -> torch.Tensor:
        total = inner(x).sum(axes, keepdim)
        return total if outer is None else outer(total)

    return _reduction(run)


def _celu(call: Call) -> torch.Tensor:
    return functional.celu(call.x, call.attribute("alpha", 1.0))


def _thresholded(call: Call) -> torch.Tensor:
    above = call.x > call.attribute("alpha", 1.0)
    return torch.where(above, call.x, torch.zeros_like(call.x))


def _elu(call: Call) -> torch.Tensor:
    return functional.elu(call.x, call.attribute("alpha", 1.0))


def _leaky_relu(call: Call) -> torch.Tensor:
    return functional.leaky_relu(call.x, call.attribute("alpha", 0.01))


def _prelu(call: Call) -> torch.Tensor:
    return torch.where(call.x < 0, call.need(1) * call.x, call.x)


def _where(call: Call) -> torch.Tensor:
    return torch.where(call.x.bool(), call.need(1), call.need(2))


VALUES: dict[str, Operator] = {
    "Abs": _one(torch.abs),
    "Acos": _one(torch.acos),
    "Acosh": _one(torch.acosh),
    "Add": _many(torch.add),
    "And": _many(torch.logical_and),
    "Asin": _one(torch.asin),
    "Asinh": _one(torch.asinh),
    "Atan": _one(torch.atan),
    "Atanh": _one(torch.atanh),
    "Cast": cast,
    "CastLike": cast_like,
    "Ceil": _one(torch.ceil),
    "Celu": _celu,
    "Clip": clip,
    "Cos": _one(torch.cos),
    "Cosh": _one(torch.cosh),
    "Div": _many(_divide),
    "Dropout": _one(lambda x: x),
    "Einsum": einsum,
    "Elu": _elu,
    "Equal": _many(torch.eq),
    "Erf": _one(torch.erf),
    "Exp": _one(torch.exp),
    "Floor": _one(torch.floor),
    "Gelu": gelu,
    "Gemm": gemm,
    "Greater": _many(torch.gt),
    "GreaterOrEqual": _many(torch.ge),
    "HardSigmoid": hard_sigmoid,
    "HardSwish": _one(functional.hardswish),
    "Identity": _one(lambda x: x),
    "IsInf": _one(torch.isinf),
    "IsNaN": _one(torch.isnan),
    "LeakyRelu": _leaky_relu,
    "Less": _many(torch.lt),
    "LessOrEqual": _many(torch.le),
    "Log": _one(torch.log),
    "LogSoftmax": log_softmax,
    "MatMul": _many(torch.matmul),
    "Max": _many(torch.maximum),
    "Mean": mean,
    "Min": _many(torch.minimum),
    "Mish": _one(functional.mish),
    "Mod": modulo,
    "Mul": _many(torch.mul),
    "Neg": _one(torch.neg),
    "Not": _one(torch.logical_not),
    "Or": _many(torch.logical_or),
    "PRelu": _prelu,
    "Pow": _many(torch.pow),
    "Reciprocal": _one(torch.reciprocal),
    "ReduceL1": _sum_of(torch.abs),
    "ReduceL2": _sum_of(torch.square, torch.sqrt),
    "ReduceLogSum": _sum_of(lambda x: x, torch.log),
    "ReduceLogSumExp": _reduction(torch.logsumexp),
    "ReduceMax": _reduction(torch.amax),
    "ReduceMean": _reduction(torch.mean),
    "ReduceMin": _reduction(torch.amin),
    "ReduceProd": _reduction(_product),
    "ReduceSum": _reduction(torch.sum),
    "ReduceSumSquare": _sum_of(torch.square),
    "Relu": _one(torch.relu),
    "Round": _one(torch.round),
    "Selu": _one(torch.selu),
    "Sigmoid": _one(torch.sigmoid),
    "Sign": _one(torch.sign),
    "Sin": _one(torch.sin),
    "Sinh": _one(torch.sinh),
    "Softmax": softmax,
    "Softplus": _one(functional.softplus),
    "Softsign": _one(functional.softsign),
    "Sqrt": _one(torch.sqrt),
    "Sub": _many(torch.sub),
    "Sum": _many(torch.add),
    "Tan": _one(torch.tan),
    "Tanh": _one(torch.tanh),
    "ThresholdedRelu": _thresholded,
    "Where": _where,
    "Xor": _many(torch.logical_xor),
}
SHAPES: dict[str, Operator] = {
    "Concat": concat,
    "Constant": constant,
    "ConstantOfShape": constant_of_shape,
    "Expand": expand,
    "Flatten": flatten,
    "Reshape": reshape,
    "Shape": shape,
    "Size": lambda call: torch.tensor(call.x.numel()),
    "Split": split,
    "Squeeze": squeeze,
    "Transpose": transpose,
    "Unsqueeze": unsqueeze,
}
OPERATORS: dict[str, Operator] = {**VALUES, **SHAPES, **INDEXING, **LAYERS, **RECURRENT}
