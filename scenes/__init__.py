"""Bundled scenes, fields, policy and routes: data and the scripts that made them."""

from __future__ import annotations

import os
from pathlib import Path

from mi_nerfattack.errors import InputError

from .listing import ROOT, data_files

__all__ = ["bundled"]


def bundled(name: str) -> Path:
    """Return the path of a bundled file or folder.

    Args:
        name: relative to this package with forward slashes, for instance
            ``"intersection/scene.xml"``.

    Raises:
        InputError: nothing of this name is bundled; the message lists what is.
    """
    path = ROOT / name
    if os.path.exists(path) and path.resolve().is_relative_to(ROOT):
        return path.resolve()
    known = ", ".join(data_files(ROOT))
    raise InputError(f"{name}: not a bundled file or folder; there are {known}")
