"""ONNX operators Resize and Upsample of images, as onnxruntime computes them.

A given scale is used as it is, also where it does not divide the size; sizes and
coordinates are rounded in single precision.

Source: the operators' specification at onnx.ai/onnx/operators.
"""

from __future__ import annotations

import numpy as np
import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.call import Call

_MOST_PX = 1 << 16  # of an axis


@np.errstate(over="raise", divide="raise", invalid="raise")
def resize(call: Call) -> torch.Tensor:
    """Resize the last two axes: nearest (asymmetric, floor) and linear."""
    call.only("antialias", 0)
    call.only("axes")
    call.only("keep_aspect_ratio_policy", "stretch")
    if call.operator == "Resize" and call.opset < 11:
        raise InputError(
            f"Resize: of operator set {call.opset} is not supported; export the model "
            "with operator set 11 or later"
        )
    mode, rule = call.attribute("mode", "nearest"), _rule(call)
    rounding = call.attribute("nearest_mode", "round_prefer_floor")
    nearest = mode == "nearest" and rule == "asymmetric"
    nearest &= call.operator == "Upsample" or rounding == "floor"
    linear = mode == "linear" and rule in ("half_pixel", "align_corners", "asymmetric")
    if not nearest and not linear:
        raise InputError(
            f"{call.operator}: mode {mode!r} with coordinates {rule!r} and "
            f"nearest_mode {rounding!r}; linear by half_pixel, align_corners or "
            "asymmetric, and nearest by asymmetric and floor are supported"
        )
    x = call.x
    for axis, (target, scale) in zip((2, 3), _targets(call), strict=True):
        size = x.shape[axis]
        if call.attribute("coordinate_transformation_mode") == "pytorch_half_pixel":
            _refuse_one(call, target)
        positions = _positions(rule, size, target, scale=scale)
        if nearest:
            index = torch.from_numpy(positions.astype(np.int64)).to(x.device)
            x = x.index_select(axis, index)
        elif target != size or scale != 1:
            weights = torch.from_numpy(_weights(positions, size)).to(x)
            x = weights @ x if axis == 2 else x @ weights.T
    return x


def _rule(call: Call) -> str:
    """Return the rule of the coordinates; one has another name for another size."""
    if call.operator == "Upsample":
        return "asymmetric"
    rule = call.attribute("coordinate_transformation_mode", "half_pixel")
    return "half_pixel" if rule == "pytorch_half_pixel" else rule


def _refuse_one(call: Call, target: int) -> None:
    if target == 1:
        raise InputError(
            f"{call.operator}: to a size of 1 by pytorch_half_pixel is not supported; "
            "export it with half_pixel"
        )


def _targets(call: Call) -> list[tuple[int, np.float32]]:
    """Return size and scale of height and width; refuse changes of other axes."""
    before = list(call.x.shape)
    sizes = call.integers(3, "sizes") if len(call.inputs) > 3 else None
    if sizes is None:
        values = call.need(1 if call.operator == "Upsample" else 2).flatten().tolist()
        scales = [np.float32(value) for value in values]
        sizes = [int(np.float32(s) * k) for s, k in zip(before, scales, strict=True)]
    else:
        pairs = zip(sizes, before, strict=True)
        scales = [np.float32(new) / np.float32(old) for new, old in pairs]
    if len(sizes) != 4 or sizes[:2] != before[:2] or min(sizes) < 1:
        raise InputError(f"{call.operator}: to {sizes}; only height and width change")
    if max(sizes[2:]) > _MOST_PX:
        raise InputError(f"{call.operator}: to {sizes}; at most {_MOST_PX} pixels")
    return list(zip(sizes[2:], scales[2:], strict=True))


def _positions(rule: str, size: int, target: int, scale: np.float32) -> np.ndarray:
    """Return where each pixel (target,) reads, float32 in [0, size - 1]."""
    index = np.arange(target, dtype=np.float32)
    if rule == "half_pixel":
        positions = (index + np.float32(0.5)) / scale - np.float32(0.5)
    elif rule == "align_corners":
        positions = index * np.float32(size - 1) / np.float32(max(1, target - 1))
    else:
        positions = index / scale
    return positions.clip(0, size - 1)


def _weights(positions: np.ndarray, size: int) -> np.ndarray:
    """Return weights (target, size) of the two nearest pixels."""
    distance = np.abs(positions[:, None].astype(np.float64) - np.arange(size))
    return np.maximum(0.0, 1.0 - distance)
