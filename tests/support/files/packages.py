"""Other packages, as pip installs them, whose entry points offer something."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from mi_nerfattack.system import entry_points


def write_package(
    folder: Path,
    points: Mapping[str, str],
    sources: Mapping[str, str],
    name: str = "other",
    version: str = "1.0",
) -> Path:
    """Write a package and what pip records of it.

    Args:
        folder: where packages are found.
        points: values of entry points by ``GROUP.NAME`` without ``mi_nerfattack.``.
        sources: text by file below the folder.
        name: of the package.
        version: of the package.
    """
    lines = []
    for key, value in points.items():
        group, _, point = key.partition(".")
        lines += [f"[mi_nerfattack.{group}]", f"{point} = {value}"]
    info = folder / f"{name}-{version}.dist-info"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    texts = {f"{info.name}/METADATA": metadata}
    texts |= {f"{info.name}/entry_points.txt": "\n".join(lines) + "\n"}
    for file, text in (texts | dict(sources)).items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, "utf-8")
    return folder


def use_packages(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Let this process, and those that it starts, find packages of a folder."""
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")
    importlib.invalidate_caches()
    entry_points._load.cache_clear()
    names = {path.stem for path in folder.iterdir()}
    for module in list(sys.modules):  # of the same package in another test
        if module.partition(".")[0] in names:
            monkeypatch.delitem(sys.modules, module)
