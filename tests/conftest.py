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
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from support.reference.derivatives import VARIANTS

SEED = 0

# Tables are as wide, and as plain, in every terminal.
for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE"):
    os.environ.pop(name, None)

# `make test` draws the same examples on every machine; `make test-random` others each
# time: pytest --hypothesis-profile random. How fast an example is decides nothing.
_SLOW = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
settings.register_profile(
    "fixed", deadline=None, database=None, derandomize=True, suppress_health_check=_SLOW
)
settings.register_profile(
    "random", deadline=None, max_examples=300, suppress_health_check=_SLOW
)
settings.load_profile("fixed")

# A job in the background of a shell ignores SIGINT, and so would what the tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def seed_all() -> None:
    """Give what follows the same random numbers, whatever ran before it."""
    random.seed(SEED)
    np.random.seed(SEED)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(SEED)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Seed every test."""
    seed_all()


@pytest.hookimpl(tryfirst=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef) -> None:
    """Seed what tests share too: it is made before `seeded` of the first of them."""
    if fixturedef.scope != "function":
        seed_all()


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
    yield from _with_variant(request.param)


@pytest.fixture
def no_variant_left() -> Iterator[None]:
    """Let the test change the variant; the one before it comes back."""
    before = mi.variant()
    yield
    if before is not None and mi.variant() != before:
        mi.set_variant(before)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[type], str]]:
    """Give a function that serves with a handler of HTTP and returns the URL."""
    from support.files.policies import serving  # imports onnx

    monkeypatch.setenv("no_proxy", "*")
    with serving() as start:
        yield start


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


@pytest.fixture(scope="session")
def carla() -> ModuleType:
    """The client of CARLA's server; what asks for it is collected where it is."""
    import carla

    return carla


def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Leave out what needs CARLA's client where it is not installed."""
    if find_spec("carla") is None:
        needing = [i for i in items if "carla" in getattr(i, "fixturenames", ())]
        config.hook.pytest_deselected(items=needing)
        items[:] = [item for item in items if item not in needing]


def _with_variant(name: str) -> Iterator[str]:
    before = mi.variant() or "llvm_ad_rgb"  # there is no way back to none
    mi.set_variant(name)
    yield name
    if before != name:
        mi.set_variant(before)
