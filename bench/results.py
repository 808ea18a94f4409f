"""What is said about the machine, and where results are written."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.backend import llvm
from mi_nerfattack.io import files
from mi_nerfattack.system.cores import cores

PACKAGES = ("mi-nerfattack", "mitsuba", "drjit", "torch", "numpy")


def machine() -> dict[str, Any]:
    """Describe processor and system; nothing that names the computer."""
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, LLVM and the packages that compute."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    number = llvm.version()
    found["llvm"] = ".".join(map(str, number)) if number else "none"
    found["python"] = platform.python_version()
    return found


def stamp(document: dict[str, Any], command: Sequence[str]) -> dict[str, Any]:
    """Add date, machine, versions and command to a document."""
    now = datetime.datetime.now(datetime.timezone.utc)
    return {
        **document,
        "date": now.date().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "command": " ".join(command),
    }


def summary_of(sweep: Path) -> dict[str, Any]:
    """Return what a sweep, finished or not, or a copy of its table came to."""
    from mi_nerfattack.experiment.sweep.cell import CELLS
    from mi_nerfattack.experiment.sweep.summary import (
        SUMMARY,
        read_attacks,
        summarise,
    )
    from mi_nerfattack.experiment.sweep.table import RESULTS, read_table

    if (sweep / SUMMARY).is_file() and not (sweep / CELLS).is_dir():
        return files.read_json(sweep / SUMMARY)
    rows = read_table(sweep / RESULTS)
    return summarise(rows, read_attacks(sweep, rows))


def copy_files(names: Sequence[str], folder: Path, output: Path) -> None:
    """Copy files, such as a sweep's table, unless they are there already."""
    from mi_nerfattack.experiment.sweep.table import MAX_TABLE_BYTES

    files.make_folder(output)
    if output.resolve() != folder.resolve():
        for name in names:
            raw = files.read_bytes(folder / name, MAX_TABLE_BYTES)
            files.write_bytes(output / name, raw)


def write(target: Path, name: str, document: dict[str, Any]) -> Path:
    """Write a stamped document.

    Args:
        target: a file, or a folder in which the file is named by date, machine and
            `name`.
        name: of the benchmark.
        document: from :func:`stamp`.

    Returns:
        the file's path.
    """
    if target.suffix != ".json":
        kind = document["machine"]
        words = f"{kind['cpu']} {kind['cores']} cores {name}".lower()
        slug = re.sub(r"[^a-z0-9]+", "-", words).strip("-")
        target = files.make_folder(target) / f"{document['date']}-{slug}.json"
    files.write_json(target, document)
    return target


def _cpu() -> str:
    if sys.platform == "linux":
        text = files.read_text("/proc/cpuinfo")
        match = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()
