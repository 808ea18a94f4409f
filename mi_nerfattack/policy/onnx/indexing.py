"""ONNX operators that choose, count, sort and repeat values.

Source: the operators' specification at onnx.ai/onnx/operators.
"""

from __future__ import annotations

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.call import Call, Operator

_MOST = 1 << 24  # numbers of a Range


def slices(call: Call) -> torch.Tensor:
    """Slice; a negative step turns an axis round."""
    starts, ends = call.integers(1, "starts") or [], call.integers(2, "ends") or []
    axes = call.integers(3, "axes") or list(range(len(starts)))
    steps = call.integers(4, "steps") or [1] * len(starts)
    x = call.x
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        chosen = range(x.shape[axis])[start:end:step]
        if step == 1:
            x = x.narrow(axis, chosen.start, len(chosen))
            continue
        index = torch.arange(len(chosen), device=x.device)
        x = x.index_select(axis, chosen.start + step * index)
    return x


def gather(call: Call) -> torch.Tensor:
    """Gather: whole slices by index along an axis."""
    axis, index = call.attribute("axis", 0), call.need(1).to(call.x.device)
    axis, size = axis % call.x.ndim, call.x.shape[axis]
    index = torch.where(index < 0, index + size, index).to(torch.int64)
    result = call.x.index_select(axis, index.flatten())
    return result.reshape(call.x.shape[:axis] + index.shape + call.x.shape[axis + 1 :])


def one_hot(call: Call) -> torch.Tensor:
    """OneHot: the second value at the index, the first elsewhere."""
    depth, values = int(call.need(1)), call.need(2).to(call.x.device)
    index = call.x.to(torch.int64)
    index = torch.where(index < 0, index + depth, index).unsqueeze(-1)
    hot = index == torch.arange(depth, device=index.device)
    return torch.where(hot, values[1], values[0]).movedim(
        -1, call.attribute("axis", -1)
    )


def gather_elements(call: Call) -> torch.Tensor:
    """GatherElements: one value for each index along an axis."""
    axis = call.attribute("axis", 0)
    return call.x.gather(axis, _index(call.need(1), call.x, axis))


def gather_nd(call: Call) -> torch.Tensor:
    """GatherND: slices at tuples of indices, behind axes of a batch."""
    x, index, batch = call.x, call.need(1), call.attribute("batch_dims", 0)
    lead = x.shape[:batch]
    flat, rows = (
        x.reshape(-1, *x.shape[batch:]),
        index.reshape(-1, *index.shape[batch:]),
    )
    depth = rows.shape[-1]
    inner = flat.shape[1 : 1 + depth]
    places = [_wrapped(rows[..., i], inner[i], x) for i in range(depth)]
    number = torch.arange(len(flat), device=x.device)
    number = number.reshape(-1, *[1] * (rows.ndim - 2))
    return flat[(number, *places)].reshape(
        *lead, *rows.shape[1:-1], *flat.shape[1 + depth :]
    )


def scatter_elements(call: Call) -> torch.Tensor:
    """ScatterElements: replace, or add to, one value for each index."""
    call.only("reduction", "none", "add")
    axis, updates = call.attribute("axis", 0), call.need(2)
    index = _index(call.need(1), call.x, axis)
    if call.attribute("reduction", "none") == "add":
        return call.x.scatter_add(axis, index, updates)
    return call.x.scatter(axis, index, updates)


def scatter_nd(call: Call) -> torch.Tensor:
    """ScatterND: replace, or add to, slices at tuples of indices."""
    call.only("reduction", "none", "add")
    x, index = call.x, call.need(1)
    sizes = enumerate(x.shape[: index.shape[-1]])
    places = tuple(_wrapped(index[..., i], size, x) for i, size in sizes)
    adds = call.attribute("reduction", "none") == "add"
    return x.index_put(places, call.need(2).to(x.device), accumulate=adds)


def argument(call: Call) -> torch.Tensor:
    """ArgMax and ArgMin: the first of equal ones."""
    call.only("select_last_index", 0)
    axis, keeps = call.attribute("axis", 0), bool(call.attribute("keepdims", 1))
    search = torch.argmax if call.operator == "ArgMax" else torch.argmin
    return search(call.x, axis, keeps)


def top(call: Call) -> tuple[torch.Tensor, ...]:
    """TopK: values, and their indices."""
    (count,) = call.integers(1, "k") or [1]
    axis, largest = call.attribute("axis", -1), bool(call.attribute("largest", 1))
    selection = call.x.topk(count, axis, largest, bool(call.attribute("sorted", 1)))
    return selection.values, selection.indices


def non_zero(call: Call) -> torch.Tensor:
    """NonZero: indices, a row for each axis."""
    return call.x.nonzero().T


def cumulate(call: Call) -> torch.Tensor:
    """CumSum, from either end, with or without the value itself."""
    axis, x = int(call.need(1)), call.x
    if call.attribute("reverse", 0):
        x = x.flip(axis)
    total = x.cumsum(axis)
    if call.attribute("exclusive", 0):
        total = total - x
    return total.flip(axis) if call.attribute("reverse", 0) else total


def tile(call: Call) -> torch.Tensor:
    """Tile: repeat along each axis."""
    return call.x.repeat(call.integers(1, "repeats") or [])


def number_range(call: Call) -> torch.Tensor:
    """Range, on the device of the start."""
    start, limit, delta = (call.need(i).item() for i in range(3))
    if delta == 0 or abs(limit - start) > _MOST * abs(delta):
        raise InputError(
            f"Range: from {start} to {limit} by {delta}; at most {_MOST} numbers"
        )
    if (limit - start) * delta <= 0:
        return call.x.new_zeros(0)
    return torch.arange(start, limit, delta, dtype=call.x.dtype, device=call.x.device)


def triangle(call: Call) -> torch.Tensor:
    """Trilu: the upper or the lower triangle of matrices."""
    (diagonal,) = call.integers(1, "k") or [0]
    half = torch.triu if call.attribute("upper", 1) else torch.tril
    return half(call.x, diagonal)


def depth_to_space(call: Call) -> torch.Tensor:
    """DepthToSpace: blocks of pixels from channels."""
    block = call.attribute("blocksize")
    count, channels, height, width = call.x.shape
    inner = channels // block**2
    if call.attribute("mode", "DCR") == "DCR":
        x = call.x.reshape(count, block, block, inner, height, width)
        x = x.permute(0, 3, 4, 1, 5, 2)
    else:
        x = call.x.reshape(count, inner, block, block, height, width)
        x = x.permute(0, 1, 4, 2, 5, 3)
    return x.reshape(count, inner, height * block, width * block)


def space_to_depth(call: Call) -> torch.Tensor:
    """SpaceToDepth: channels from blocks of pixels."""
    block = call.attribute("blocksize")
    count, channels, height, width = call.x.shape
    x = call.x.reshape(count, channels, height // block, block, width // block, block)
    x = x.permute(0, 3, 5, 1, 2, 4)
    return x.reshape(count, channels * block**2, height // block, width // block)


def _wrapped(index: torch.Tensor, size: int, like: torch.Tensor) -> torch.Tensor:
    """Return indices from the start, where negative ones count from the end."""
    index = index.to(like.device, torch.int64)
    return torch.where(index < 0, index + size, index)


def _index(index: torch.Tensor, x: torch.Tensor, axis: int) -> torch.Tensor:
    return _wrapped(index, x.shape[axis], x)


INDEXING: dict[str, Operator] = {
    "ArgMax": argument,
    "ArgMin": argument,
    "CumSum": cumulate,
    "DepthToSpace": depth_to_space,
    "Gather": gather,
    "GatherElements": gather_elements,
    "GatherND": gather_nd,
    "NonZero": non_zero,
    "OneHot": one_hot,
    "Range": number_range,
    "ScatterElements": scatter_elements,
    "ScatterND": scatter_nd,
    "Slice": slices,
    "SpaceToDepth": space_to_depth,
    "Tile": tile,
    "TopK": top,
    "Trilu": triangle,
}
