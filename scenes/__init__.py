"""Bundled scenes, fields, policy and routes: data and the scripts that made them."""

from __future__ import annotations

import os
from pathlib import Path

from mi_nerfattack.errors import InputError

from .listing import ROOT, data_files

__all__ = ["BUNDLED", "bundled", "resolve"]

BUNDLED = "bundled:"


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


def resolve(name: str, folder: str | Path = "") -> Path:
    """Find a file that a command, a scenario or a scene file names.

    Args:
        name: ``bundled:FILE``, or a path relative to `folder`.
        folder: that relative paths start from.

    Raises:
        InputError: nothing of this name is bundled, or it begins with the home of a
            user that there is not.
    """
    if name.startswith(BUNDLED):
        return bundled(name[len(BUNDLED) :])
    try:
        return Path(folder) / Path(name).expanduser()
    except RuntimeError as err:
        home = name.split("/")[0]
        raise InputError(f"{name}: {home} is no home here; give the path") from err
