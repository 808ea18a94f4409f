"""ONNX operators with weights or windows: convolution, pooling, padding.

Source: the operators' specification at onnx.ai/onnx/operators.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn import functional

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.call import Call, Operator
from mi_nerfattack.policy.onnx.resize import resize

_CONVOLUTIONS = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}
_TRANSPOSED = {
    1: functional.conv_transpose1d,
    2: functional.conv_transpose2d,
    3: functional.conv_transpose3d,
}
_MAX_POOLS = {1: functional.max_pool1d, 2: functional.max_pool2d}
_AVERAGE_POOLS = {1: functional.avg_pool1d, 2: functional.avg_pool2d}
_GRID_MODES = {"linear": "bilinear", "bilinear": "bilinear", "nearest": "nearest"}
_PAD_MODES = {"constant": "constant", "reflect": "reflect", "edge": "replicate"}


def convolve(call: Call) -> torch.Tensor:
    """Conv: any padding, stride, dilation and groups, one to three axes."""
    weight = call.need(1)
    axes = weight.ndim - 2
    kernel = list(weight.shape[2:])
    strides = call.attribute("strides", [1] * axes)
    dilations = call.attribute("dilations", [1] * axes)
    x = _padded(call, call.x, kernel, strides=strides, dilations=dilations, value=0.0)
    group = call.attribute("group", 1)
    return _CONVOLUTIONS[axes](
        x, weight, call.get(2), strides, 0, list(dilations), group
    )


def convolve_transposed(call: Call) -> torch.Tensor:
    """ConvTranspose: padding cuts the result, and output_padding enlarges it."""
    weight, bias = call.need(1), call.get(2)
    axes, sizes = weight.ndim - 2, call.x.shape[2:]
    strides = list(call.attribute("strides", [1] * axes))
    dilations = list(call.attribute("dilations", [1] * axes))
    output_padding = list(call.attribute("output_padding", [0] * axes))
    group = call.attribute("group", 1)
    uncropped = _TRANSPOSED[axes](call.x, weight, None, strides, 0, 0, group, dilations)
    pads = list(call.attribute("pads", [0] * 2 * axes))
    rule = call.attribute("auto_pad", "NOTSET")
    output_shape = call.attribute("output_shape")
    if output_shape is None and rule.startswith("SAME"):
        output_shape = [
            size * stride for size, stride in zip(sizes, strides, strict=True)
        ]
    for i, size in enumerate(output_shape or ()):
        total = uncropped.shape[2 + i] + output_padding[i] - size
        before = total // 2 if rule == "SAME_UPPER" else total - total // 2
        pads[i], pads[i + axes] = before, total - before
    flat = []
    for i in reversed(range(axes)):
        flat += [-pads[i], output_padding[i] - pads[i + axes]]
    result = functional.pad(uncropped, flat)
    return result if bias is None else result + bias.reshape(-1, *[1] * axes)


def max_pool(call: Call) -> torch.Tensor:
    """MaxPool: values alone, without their indices."""
    kernel, strides, axes = _window(call)
    dilations = call.attribute("dilations", [1] * axes)
    x = _padded(
        call, call.x, kernel, strides=strides, dilations=dilations, value=float("-inf")
    )
    ceil = bool(call.attribute("ceil_mode", 0))
    if ceil and any(s > k for s, k in zip(strides, kernel, strict=True)):
        raise InputError(
            f"MaxPool: ceil_mode with strides {strides} above the kernel {kernel} is "
            "not supported; export it without ceil_mode"
        )
    return _MAX_POOLS[axes](x, kernel, strides, 0, list(dilations), ceil_mode=ceil)


def average_pool(call: Call) -> torch.Tensor:
    """AveragePool: with or without the padding counted."""
    call.only("ceil_mode", 0)
    kernel, strides, axes = _window(call)
    ones = [1] * axes
    call.only("dilations", ones)
    mean = _AVERAGE_POOLS[axes]
    result = mean(
        _padded(call, call.x, kernel, strides=strides, dilations=ones, value=0.0),
        kernel,
        strides,
    )
    if call.attribute("count_include_pad", 0):
        return result
    inside = torch.ones_like(call.x[:1, :1])
    inside = _padded(call, inside, kernel, strides=strides, dilations=ones, value=0.0)
    return result / mean(inside, kernel, strides)


def batch_normalise(call: Call) -> torch.Tensor:
    """BatchNormalization, as it is evaluated after training."""
    call.only("training_mode", 0)
    scale, bias, mean, variance = (call.need(i) for i in range(1, 5))
    return functional.batch_norm(
        call.x, mean, variance, scale, bias, eps=call.attribute("epsilon", 1e-5)
    )


def layer_normalise(call: Call) -> torch.Tensor:
    """LayerNormalization: the first output alone."""
    shape = call.x.shape[call.attribute("axis", -1) :]
    epsilon = call.attribute("epsilon", 1e-5)
    return functional.layer_norm(call.x, shape, call.need(1), call.get(2), epsilon)


def instance_normalise(call: Call) -> torch.Tensor:
    """InstanceNormalization: each channel of each image by itself."""
    epsilon = call.attribute("epsilon", 1e-5)
    return functional.instance_norm(
        call.x, weight=call.need(1), bias=call.need(2), eps=epsilon
    )


def group_normalise(call: Call) -> torch.Tensor:
    """GroupNormalization; before version 21 with a scale and a bias for each group."""
    groups, scale, bias = call.attribute("num_groups"), call.need(1), call.need(2)
    if call.opset < 21:
        repeat = call.x.shape[1] // groups
        scale = scale.repeat_interleave(repeat)
        bias = bias.repeat_interleave(repeat)
    epsilon = call.attribute("epsilon", 1e-5)
    return functional.group_norm(call.x, groups, scale, bias, epsilon)


def unit_normalise(call: Call) -> torch.Tensor:
    """LpNormalization: divide by the norm along an axis, 0 where it is 0."""
    axis, order = call.attribute("axis", -1), call.attribute("p", 2)
    norm = call.x.norm(order, axis, keepdim=True)
    return call.x / torch.where(norm == 0, torch.ones_like(norm), norm)


def mean_variance_normalise(call: Call) -> torch.Tensor:
    """MeanVarianceNormalization, over the image and the batch by default."""
    axes = list(call.attribute("axes", [0, 2, 3]))
    centred = call.x - call.x.mean(axes, keepdim=True)
    return centred / (centred.square().mean(axes, keepdim=True).sqrt() + 1e-9)


def sample(call: Call) -> torch.Tensor:
    """GridSample: read images at places in [-1, 1]."""
    mode = call.attribute("mode", "bilinear")
    if mode not in _GRID_MODES or call.x.ndim != 4:
        raise InputError(
            f"GridSample: mode {mode!r} of {call.x.ndim} axes is not supported; "
            f"{' and '.join(_GRID_MODES)} of 4 axes are"
        )
    padding = call.attribute("padding_mode", "zeros")
    align = bool(call.attribute("align_corners", 0))
    return functional.grid_sample(
        call.x, call.need(1), _GRID_MODES[mode], padding, align
    )


def global_average(call: Call) -> torch.Tensor:
    """GlobalAveragePool."""
    return call.x.mean(list(range(2, call.x.ndim)), keepdim=True)


def global_maximum(call: Call) -> torch.Tensor:
    """GlobalMaxPool."""
    return call.x.amax(list(range(2, call.x.ndim)), keepdim=True)


def pad(call: Call) -> torch.Tensor:
    """Pad: constant, by reflection or by the edge; negative numbers cut."""
    pads = call.integers(1, "pads")
    mode = call.attribute("mode", "constant")
    if pads is None or mode not in _PAD_MODES:
        raise InputError(f"Pad: mode {mode!r}; {', '.join(_PAD_MODES)} are supported")
    axes = call.integers(3, "axes") or list(range(call.x.ndim))
    both = [(0, 0)] * call.x.ndim
    for i, axis in enumerate(axes):
        both[axis % call.x.ndim] = (pads[i], pads[i + len(axes)])
    flat = [size for pair in reversed(both) for size in pair]
    if mode == "constant":
        return functional.pad(call.x, flat, value=call.number(2, "value") or 0.0)
    while len(flat) > 2 and flat[-2:] == [0, 0]:  # torch pads the last axes alone
        flat = flat[:-2]
    return functional.pad(call.x, flat, _PAD_MODES[mode])


def _window(call: Call) -> tuple[list[int], list[int], int]:
    """Return kernel, strides and the number of axes of a pooling."""
    kernel = list(call.attribute("kernel_shape"))
    strides = list(call.attribute("strides", [1] * len(kernel)))
    return kernel, strides, len(kernel)


def _padded(
    call: Call,
    x: torch.Tensor,
    kernel: Sequence[int],
    strides: Sequence[int],
    dilations: Sequence[int],
    value: float,
) -> torch.Tensor:
    """Pad as ``pads`` or ``auto_pad`` say, both ends on their own."""
    axes = len(kernel)
    pads = list(call.attribute("pads", [0] * 2 * axes))
    rule = call.attribute("auto_pad", "NOTSET")
    if rule.startswith("SAME"):
        pads = [0] * 2 * axes
        for i, size in enumerate(x.shape[2:]):
            reach = dilations[i] * (kernel[i] - 1) + 1
            steps = -(-size // strides[i])
            extra = max(0, (steps - 1) * strides[i] + reach - size)
            before = extra // 2 if rule == "SAME_UPPER" else extra - extra // 2
            pads[i], pads[i + axes] = before, extra - before
    if not any(pads):
        return x
    flat = [pads[i + end * axes] for i in reversed(range(axes)) for end in (0, 1)]
    return functional.pad(x, flat, value=value)


LAYERS: dict[str, Operator] = {
    "AveragePool": average_pool,
    "BatchNormalization": batch_normalise,
    "Conv": convolve,
    "ConvTranspose": convolve_transposed,
    "GlobalAveragePool": global_average,
    "GlobalMaxPool": global_maximum,
    "GridSample": sample,
    "GroupNormalization": group_normalise,
    "InstanceNormalization": instance_normalise,
    "LayerNormalization": layer_normalise,
    "LpNormalization": unit_normalise,
    "MaxPool": max_pool,
    "MeanVarianceNormalization": mean_variance_normalise,
    "Pad": pad,
    "Resize": resize,
    "Upsample": resize,
}
