"""The versions that a result depends on."""

from __future__ import annotations

import importlib.metadata
from typing import Any

import drjit
import mitsuba as mi

import mi_nerfattack
from mi_nerfattack import llvm


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, with the active variant."""
    dr: Any = drjit  # its stubs lack the version
    return {
        "mi_nerfattack": mi_nerfattack.__version__,
        "mitsuba": str(mi.__version__),
        "drjit": str(dr.__version__),
        "numpy": importlib.metadata.version("numpy"),
        "torch": importlib.metadata.version("torch"),
        "llvm": ".".join(map(str, llvm.version() or ())),
        "variant": str(mi.variant()),
    }


def environment_versions(name: str) -> dict[str, str]:
    """Return the versions of packages that one deployment environment needs.

    Args:
        name: key of `deploy.registry.ENVIRONMENTS`.
    """
    found = {}
    for package in _NEEDED.get(name, ()):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"  # making the environment says so
    return found


_NEEDED = {"mujoco": ("mujoco",), "mujoco_gl": ("mujoco",), "carla": ("carla",)}
