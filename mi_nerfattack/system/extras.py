"""Packages that only some of our work needs."""

from __future__ import annotations

import importlib
from typing import Any

from mi_nerfattack.errors import SetupError


def install_hint(extra: str) -> str:
    """Return what installs an extra of this package, for the end of a message."""
    return f"in the checkout of mi-nerfattack, run: pip install '.[{extra}]'"


def load_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a package that an extra of ours installs.

    Args:
        module: its name.
        extra: of this package.
        purpose: what needs it, for the message.

    Raises:
        SetupError: it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as err:
        raise SetupError(
            f"{purpose} needs {module.partition('.')[0]}, which cannot be imported "
            f"({err}); {install_hint(extra)}"
        ) from err
