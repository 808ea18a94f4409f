"""Fixtures that every test file shares: variant, seeds, outside data."""

from __future__ import annotations

import os

# Idle threads of PyTorch would spin on cores that another worker needs; before torch.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import mi_nerfattack  # noqa: E402, F401  before drjit: it chooses the LLVM

# isort: split
import random
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

SEED = 0
VARIANTS = (
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "llvm_ad_spectral",
    "cuda_ad_rgb",
    "cuda_ad_mono",
    "cuda_ad_spectral",
)

# A job in the background of a shell ignores SIGINT, and so would what the tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Give every test the same random numbers, whatever ran before it."""
    random.seed(SEED)
    np.random.seed(SEED)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(SEED)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator of the test's own."""
    return np.random.default_rng(SEED)


@pytest.fixture
def variant() -> Iterator[str]:
    """Set llvm_ad_rgb, and afterwards the variant that was set before."""
    yield from _with_variant("llvm_ad_rgb")


@pytest.fixture
def spectral() -> Iterator[str]:
    """Set llvm_ad_spectral, and afterwards the variant that was set before."""
    yield from _with_variant("llvm_ad_spectral")


@pytest.fixture(params=VARIANTS)
def each_variant(request: pytest.FixtureRequest) -> Iterator[str]:
    """Set each variant that the plugins support and this machine can run."""
    name = request.param
    if name not in mi.variants():
        pytest.skip(f"this Mitsuba has no {name}")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip(f"{name}: no CUDA device")
    yield from _with_variant(name)


@pytest.fixture
def no_variant_left() -> Iterator[None]:
    """Let the test change the variant; the one before it comes back."""
    before = mi.variant()
    yield
    if before is not None and mi.variant() != before:
        mi.set_variant(before)


@pytest.fixture
def single_thread() -> Iterator[None]:
    """Run kernels on one thread: equal input gives equal bits."""
    before = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(before)


@pytest.fixture
def data_folder() -> Path:
    """The folder of outside data that NERFATTACK_DATA names."""
    folder = os.environ.get("NERFATTACK_DATA")
    if folder is None:
        pytest.skip("NERFATTACK_DATA names no folder of test data")
    return Path(folder)


def _with_variant(name: str) -> Iterator[str]:
    before = mi.variant()
    mi.set_variant(name)
    yield name
    if before is not None and before != name:
        mi.set_variant(before)
