"""The versions that a result depends on."""

from __future__ import annotations

from typing import Any

import drjit
import mitsuba as mi

import mi_nerfattack


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, with the active variant."""
    dr: Any = drjit  # its stubs lack the version
    return {
        "mi_nerfattack": mi_nerfattack.__version__,
        "mitsuba": str(mi.__version__),
        "drjit": str(dr.__version__),
        "variant": str(mi.variant()),
    }
