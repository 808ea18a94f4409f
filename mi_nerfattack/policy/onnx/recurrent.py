"""ONNX's recurrent layers: LSTM and GRU, any direction, default activations.

Source: the operators' specification at onnx.ai/onnx/operators.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch.nn.functional import linear

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.onnx.call import Call, Operator

#: Map (x W^T + b_W, R, b_R, states) of one time to the next states.
Cell = Callable[..., tuple[torch.Tensor, ...]]


def lstm(call: Call) -> tuple[torch.Tensor, ...]:
    """LSTM: gates in the order input, output, forget, cell."""
    if call.get(7) is not None:
        raise InputError("LSTM: peepholes are not supported")
    call.only("input_forget", 0)
    return _layer(
        call, _lstm_cell, gates=4, activations=["Sigmoid", "Tanh", "Tanh"], states=2
    )


def gru(call: Call) -> tuple[torch.Tensor, ...]:
    """GRU: gates in the order update, reset, hidden."""
    before = bool(call.attribute("linear_before_reset", 0))
    cell = _gru_cell if before else _gru_cell_reset_first
    return _layer(call, cell, gates=3, activations=["Sigmoid", "Tanh"], states=1)


def _lstm_cell(
    gates: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor,
    hidden: torch.Tensor,
    cell: torch.Tensor,
) -> tuple[torch.Tensor, ...]:
    gates = gates + linear(hidden, weight, bias)
    into, out, forget, candidate = gates.chunk(4, dim=-1)
    cell = forget.sigmoid() * cell + into.sigmoid() * candidate.tanh()
    return out.sigmoid() * cell.tanh(), cell


def _gru_cell(
    gates: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, hidden: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    update, reset, candidate = gates.chunk(3, dim=-1)
    update_h, reset_h, candidate_h = linear(hidden, weight, bias).chunk(3, dim=-1)
    update = (update + update_h).sigmoid()
    candidate = (candidate + (reset + reset_h).sigmoid() * candidate_h).tanh()
    return ((1 - update) * candidate + update * hidden,)


def _gru_cell_reset_first(
    gates: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, hidden: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    first, last = weight.tensor_split([2 * hidden.shape[-1]])
    bias_first, bias_last = bias.tensor_split([2 * hidden.shape[-1]])
    update, reset, candidate = gates.chunk(3, dim=-1)
    both = (
        torch.cat([update, reset], -1) + linear(hidden, first, bias_first)
    ).sigmoid()
    update, reset = both.chunk(2, dim=-1)
    candidate = (candidate + linear(reset * hidden, last, bias_last)).tanh()
    return ((1 - update) * candidate + update * hidden,)


def _layer(
    call: Call, cell: Cell, gates: int, activations: list[str], states: int
) -> tuple[torch.Tensor, ...]:
    """Run a cell over time in each direction; return Y and the last states."""
    direction = call.attribute("direction", "forward")
    count = 2 if direction == "bidirectional" else 1
    call.only("activations", activations * count)
    call.only("layout", 0)
    call.only("clip")
    if call.get(4) is not None:
        raise InputError(f"{call.operator}: sequence_lens is not supported")
    x, size = call.x, call.attribute("hidden_size")
    outputs, lasts = [], []
    for i in range(count):
        backward = direction == "reverse" or i == 1
        bias = call.get(3)
        flat = x.new_zeros(2 * gates * size) if bias is None else bias[i]
        before, within = flat.chunk(2)
        projected = linear(x, call.need(1)[i], before)
        state = tuple(
            x.new_zeros(x.shape[1], size) if start is None else start[i]
            for start in (call.get(5), call.get(6))[:states]
        )
        hidden = []
        for step in reversed(projected) if backward else projected:
            state = cell(step, call.need(2)[i], within, *state)
            hidden.append(state[0])
        outputs.append(torch.stack(hidden[::-1] if backward else hidden))
        lasts.append(state)
    last = (torch.stack(by_direction) for by_direction in zip(*lasts, strict=True))
    return torch.stack(outputs, dim=1), *last


RECURRENT: dict[str, Operator] = {"LSTM": lstm, "GRU": gru}
