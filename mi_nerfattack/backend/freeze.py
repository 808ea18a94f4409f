"""Methods whose launches are recorded once and replayed, without tracing again."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr

from mi_nerfattack.errors import NerfAttackError


def freeze_method(
    method: Callable[..., Any], state: Callable[..., Any]
) -> Callable[..., Any]:
    """Freeze a bound method by `drjit.freeze`.

    The result does not keep the method's owner alive, so that owners die when they
    are dropped. Dr.Jit aborts the process if the garbage collector destroys one
    recording while another is made, so it rests during a call.

    Args:
        method: bound; arguments and result are PyTrees.
        state: bound; called with the same arguments, returns everything else that
            `method` reads or depends on.

    Returns:
        what does the same; errors of ours leave it as they are, not as Dr.Jit's.
    """
    call, read = weakref.WeakMethod(method), weakref.WeakMethod(state)

    def body(*arguments: Any) -> Any:
        return _alive(call)(*arguments)

    def state_fn(*arguments: Any) -> Any:
        return _alive(read)(*arguments)

    recorded = dr.freeze(body, state_fn=state_fn, auto_opaque=False)

    def replay(*arguments: Any) -> Any:
        with _no_garbage_collection():
            try:
                return recorded(*arguments)
            except RuntimeError as err:
                if isinstance(err.__cause__, NerfAttackError):
                    raise err.__cause__ from None
                raise

    return replay


def _alive(reference: weakref.WeakMethod) -> Callable[..., Any]:
    method = reference()
    assert method is not None, "the owner of a frozen method outlives its calls"
    return method


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
