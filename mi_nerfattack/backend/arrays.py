"""Arrays end to end, and from NumPy, by kernels that do not depend on places in memory.

`drjit.concat` and slices compile a kernel for every offset. Memory from NumPy has an
alignment of its own, and Dr.Jit compiles kernels of its own for that; lists have none.
On a CPU, Dr.Jit does not copy NumPy's memory, either: who changes an array afterwards
changes what kernels read, and while a frozen function is recorded, giving such memory
back ends the process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from mi_nerfattack.errors import InputError


def concat(chunks: Sequence[Any], counts: Sequence[int]) -> Any:
    """Lay arrays, or dataclasses and lists of arrays, end to end.

    Args:
        chunks: all of the same structure. An array may have a single entry, which then
            counts for its whole chunk. A leaf that is not an array is equal in all
            chunks.
        counts: size of each chunk.

    Returns:
        evaluated arrays of the sum of the sizes.
    """
    result, start = _empty(chunks[0], sum(counts)), 0
    for chunk, count in zip(chunks, counts, strict=True):
        put(result, chunk, dr.opaque(mi.UInt32, start) + dr.arange(mi.UInt32, count))
        dr.eval(result)  # of chunks of equal size it would make one kernel
        start += count
    return result


def split(array: Any, count: int) -> list[Any]:
    """Cut an array (n count,) into n of `count` entries, evaluated."""
    within = dr.arange(mi.UInt32, count)
    starts = range(0, dr.width(array), count)
    chunks = []
    for start in starts:
        place = dr.opaque(mi.UInt32, start) + within
        chunks.append(dr.gather(type(array), array, place))
        dr.eval(chunks[-1])  # see `concat`
    return chunks


def _empty(part: Any, size: int) -> Any:
    if isinstance(part, list):
        return [_empty(item, size) for item in part]
    if is_dataclass(part):
        values = {f.name: _empty(getattr(part, f.name), size) for f in fields(part)}
        return type(part)(**values)
    return dr.empty(type(part), size) if dr.is_array_v(part) else part


def put(target: Any, part: Any, place: mi.UInt32) -> None:
    """Scatter arrays, or dataclasses and lists of arrays, leaf by leaf.

    Args:
        target: arrays to scatter into.
        part: arrays to scatter, in the structure of `target`.
        place: entry k goes to `place[k]`.
    """
    if isinstance(part, list):
        for item, value in zip(target, part, strict=True):
            put(item, value, place)
    elif is_dataclass(part):
        for name in (item.name for item in fields(part)):
            put(getattr(target, name), getattr(part, name), place)
    elif dr.is_array_v(part):
        dr.scatter(target, part, place)


def allocated_bytes(value: Any) -> int:
    """Return the bytes that Dr.Jit holds for the arrays of lists and dataclasses.

    Its allocator rounds each array up to a power of two.
    """
    if isinstance(value, list | tuple):
        return sum(map(allocated_bytes, value))
    if is_dataclass(value):
        return sum(allocated_bytes(getattr(value, item.name)) for item in fields(value))
    if not dr.is_array_v(value):
        return 0
    if dr.is_tensor_v(value):
        return allocated_bytes(value.array)
    if dr.depth_v(value) > 1:
        return sum(map(allocated_bytes, value))
    size = dr.width(value) * dr.itemsize_v(value)
    return 1 << (size - 1).bit_length() if size else 0


def upload(kind: Any, values: np.ndarray) -> Any:
    """Copy an array to a flat one of a type, such as `mi.Float`, in Dr.Jit's memory.

    Args:
        kind: a Dr.Jit type of one dimension.
        values: of any shape; numbers are converted to those of `kind`.
    """
    number = np.dtype(dr.type_v(kind).name.lower())
    # the kernel runs later, so that NumPy has to copy, too
    borrowed = kind(aligned(np.asarray(values, number)).reshape(-1))
    result = dr.empty(kind, values.size)
    # a gather of everything, or `dr.copy`, would return the same memory
    dr.scatter(result, borrowed, dr.arange(dr.uint32_array_t(kind), values.size))
    dr.eval(result)
    return result


def aligned(values: np.ndarray) -> np.ndarray:
    """Copy an array into memory that begins at a multiple of 64 bytes.

    Dr.Jit compiles one kernel for such memory and another for any other, and where
    NumPy's begins is chance.
    """
    raw = np.empty(values.nbytes + 64, np.uint8)
    start = -raw.ctypes.data % 64
    copy = raw[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy


def upload_rows(kind: Any, rows: np.ndarray) -> Any:
    """Return vectors of a type, such as `mi.Point3f`, from rows (n, m)."""
    column = dr.value_t(kind)
    return kind(*[column(values) for values in rows.T.tolist()])


def rows_type(row: Any) -> Any:
    """Type of an array of any number of rows: `ArrayXf64` for a row `Float64`."""
    return getattr(sys.modules[row.__module__], _ROWS[dr.type_v(row)])


_ROWS = {dr.VarType.Float32: "ArrayXf", dr.VarType.Float64: "ArrayXf64"}


def adam_tensors(optimiser: Adam) -> dict[str, np.ndarray]:
    """Return copies of parameters and moments.

    Args:
        optimiser: not one with AMSGrad, whose maxima are left out.

    Returns:
        for each parameter: ``value.NAME``, and the moments ``first.NAME`` and
        ``second.NAME``, float32 in the parameter's shape; ``time.NAME``, (1,) uint32,
        the number of steps.
    """
    result: dict[str, np.ndarray] = {}
    state: dict[str, Any] = optimiser.state
    for name, (value, _, _, (time, first, second, _)) in state.items():
        for part, array in (("value", value), ("first", first), ("second", second)):
            flat = np.array(dr.detach(array), np.float32)
            result[f"{part}.{name}"] = flat.reshape(value.shape)
        result[f"time.{name}"] = np.array([time[0]], np.uint32)
    return result


def load_adam(
    optimiser: Adam,
    tensors: dict[str, np.ndarray],
    names: Iterable[str] | None = None,
) -> None:
    """Load what :func:`adam_tensors` returned; keep the learning rates.

    Args:
        optimiser: has the parameters already.
        tensors: the arrays; they are copied.
        names: of the parameters to load; all by default.

    Raises:
        InputError: an array has another shape than the parameter.
        KeyError: an array is missing.
    """
    state: dict[str, Any] = optimiser.state
    for name in list(state if names is None else names):
        value, promoted, rate, (time, first, _, largest) = state[name]
        shapes = {part: value.shape for part in ("value", "first", "second")}
        for part, shape in {**shapes, "time": (1,)}.items():
            if (actual := tensors[f"{part}.{name}"].shape) != shape:
                raise InputError(
                    f"{part}.{name}: shape {actual}; the parameter has {shape}"
                )
        # copies, because Dr.Jit would share memory with NumPy
        arrays = [np.array(tensors[f"{part}.{name}"], np.float32) for part in shapes]
        fresh = type(value)(arrays[0])
        moments = [type(first)(array.ravel()) for array in arrays[1:]]
        dr.make_opaque(fresh, moments)
        dr.enable_grad(fresh)
        # a literal, as Adam itself counts, so that the same kernel does the next step
        steps = type(time)(int(tensors[f"time.{name}"][0]))
        state[name] = fresh, promoted, rate, (steps, *moments, largest)


def differentiates_rays(integrator: Any) -> bool:
    """Tell whether an integrator has the protocol of Mitsuba's `RBIntegrator`.

    By the name of its base class: other packages and changes of variant leave several
    copies of that class in a process.
    """
    return any(base.__name__ == "RBIntegrator" for base in type(integrator).__mro__)


def vjp(f: Callable[[Any], Any], x: Any, dy: Any) -> Any:
    """Multiply a cotangent by the derivative of a function (reverse mode).

    The function is evaluated again, with gradients even where the caller suspended
    them. Other arrays that `f` reads get their gradients, too, if they are attached.

    Args:
        f: maps a PyTree of arrays to a PyTree of arrays.
        x: where to differentiate; itself stays detached or attached as it is.
        dy: cotangent of ``f(x)``, of the same structure; a number is the value of all
            entries.

    Returns:
        cotangent of `x`, of its structure and shapes; detached, not evaluated.

    Raises:
        ValueError: ``f(x)`` does not depend on `x`.
    """
    with dr.resume_grad():
        leaf = dr.detach(x)
        dr.enable_grad(leaf)
        y = f(leaf)
        if not dr.grad_enabled(y):
            raise ValueError("vjp: the result does not depend on the argument")
        dr.accum_grad(y, dy)  # not set: two entries of y may be one variable
        dr.enqueue(dr.ADMode.Backward, y)
        dr.traverse(dr.ADMode.Backward)
        return dr.grad(leaf)
