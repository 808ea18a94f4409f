"""The toy loop, for tests of the closed loop."""

from __future__ import annotations

import pytest


@pytest.fixture
def toy(variant):
    from helpers import toy_loop

    return toy_loop
