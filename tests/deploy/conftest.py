"""Fixtures of the environments' tests."""

from __future__ import annotations

import pytest

from mi_nerfattack.deploy.mujoco import opengl
from mi_nerfattack.errors import InputError


@pytest.fixture(scope="session")
def gl() -> None:
    """Skip where OpenGL cannot be had without a window."""
    try:
        opengl.make_context(8, 8).free()
    except InputError as error:
        pytest.skip(str(error))
