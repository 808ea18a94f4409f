"""Arrays of Dr.Jit as torch's and back; memory is shared where it can be."""

from __future__ import annotations

from typing import Any

import drjit as dr
import torch

from mi_nerfattack.backend.arrays import rows_type


def to_torch(array: Any) -> torch.Tensor:
    """View a Dr.Jit array or tensor, detached, as torch's; waits until it is there."""
    values = dr.detach(array)
    dr.eval(values)
    dr.sync_thread()
    if dr.backend_v(values) == dr.JitBackend.CUDA:
        return values.torch()
    # DLPack runs Python inside of C++ that drops a Ctrl-C; NumPy's memory does not
    return torch.from_numpy(values.numpy())


def to_tensor(value: torch.Tensor, like: Any) -> Any:
    """Make a Dr.Jit tensor of the type of `like`; evaluated, never a literal."""
    return type(like)(_settled(value, like))


def to_row(value: torch.Tensor, like: Any) -> Any:
    """Make a Dr.Jit row (n,) of the scalar type and backend of the tensor `like`."""
    return dr.array_t(like)(_settled(value, like))


def to_controls(value: torch.Tensor, like: Any) -> Any:
    """Make a row (n,) of controls (n,), k rows (k, n) of controls (n, k)."""
    if value.ndim == 1:
        return to_row(value, like)
    rows = rows_type(dr.array_t(like))
    return rows(*(to_row(column, like) for column in value.unbind(1)))


def _settled(value: torch.Tensor, like: Any) -> Any:
    """Bring a result into the scalar type of `like` and wait for its device."""
    scalar = torch.float64 if dr.type_v(like) == dr.VarType.Float64 else torch.float32
    value = value.detach().to(scalar).contiguous()
    if not value.is_cuda:
        return value.numpy()  # see `to_torch`
    # Dr.Jit has a stream of its own
    torch.cuda.current_stream(value.device).synchronize()
    return value
