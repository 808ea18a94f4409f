"""Equal input, equal bits; and the random generators that all code shares.

Only `one_thread` imports torch: elsewhere it is taken into account where something
else has loaded it.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import threadpoolctl

from mi_nerfattack.errors import SetupError


@contextmanager
def deterministic(enabled: bool = True) -> Iterator[None]:
    """Let equal input give equal bits: kernels, BLAS and torch on one thread.

    What differs from run to run otherwise is the order in which threads add gradients
    up; torch also refuses operations without a deterministic implementation.

    Args:
        enabled: whether; otherwise nothing is changed.

    Raises:
        SetupError: the variant runs on a GPU, which sums in any order.
    """
    if not enabled:
        yield
        return
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
        raise SetupError(
            f"deterministic: variant {mi.variant()} adds gradients in any order; set "
            "MI_NERFATTACK_VARIANT=llvm_ad_rgb, or leave attack.deterministic out"
        )
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        with threadpoolctl.threadpool_limits(1), _deterministic_torch():
            yield
    finally:
        dr.set_thread_count(threads)


def random_states() -> dict[str, np.ndarray]:
    """Return the states of the global generators of Python, NumPy and torch.

    Nothing in this package draws from them, but a policy of the user's may.
    """
    version, words, spare = random.getstate()
    _, keys, position, has_spare, spare_normal = np.random.get_state(legacy=True)
    result = {
        "random.python": np.array([version, *words], np.int64),
        "random.python.spare": np.array([np.nan if spare is None else spare]),
        "random.numpy": np.array(keys, np.uint32),
        "random.numpy.position": np.array([position, has_spare], np.int64),
        "random.numpy.spare": np.array([spare_normal]),
    }
    torch = _torch()
    if torch is not None:
        result["random.torch"] = torch.get_rng_state().numpy().copy()
    return result


def restore_random_states(tensors: Mapping[str, np.ndarray]) -> None:
    """Put the global generators into states from :func:`random_states`.

    Raises:
        KeyError: an entry is missing.
    """
    version, *words = (int(word) for word in tensors["random.python"])
    spare = float(tensors["random.python.spare"][0])
    random.setstate((version, tuple(words), None if np.isnan(spare) else spare))
    position, has_spare = (int(v) for v in tensors["random.numpy.position"])
    normal = float(tensors["random.numpy.spare"][0])
    keys = tensors["random.numpy"]
    np.random.set_state(("MT19937", keys, position, has_spare, normal))
    torch = _torch()
    if torch is not None and "random.torch" in tensors:
        state = np.array(tensors["random.torch"], np.uint8)
        torch.set_rng_state(torch.from_numpy(state))


@contextmanager
def _deterministic_torch() -> Iterator[None]:
    torch = _torch()
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    strict = torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.set_num_threads(threads)


def _torch() -> Any:
    return sys.modules.get("torch")


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread: several wait spinning while the renderer works."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
