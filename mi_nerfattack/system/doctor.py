"""Examine the installation: versions, LLVM, variants, machine, bundled files."""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement

from mi_nerfattack import variant
from mi_nerfattack.backend import llvm
from mi_nerfattack.errors import NerfAttackError
from mi_nerfattack.extras import install_hint
from mi_nerfattack.io import files
from mi_nerfattack.system.machine import cores
from mi_nerfattack.system.processes import module_command

DISTRIBUTION = "mi-nerfattack"
DEVELOPER_EXTRAS = ("docs", "test", "dev")
MIN_MEMORY_BYTES = 4 << 30
MIN_DISK_BYTES = 1 << 30
PROBE_SECONDS = 120


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: what it is.
        value: what was found.
        state: "ok"; "missing", without which nothing runs; or "absent", without which
            a part of the work does not.
        remedy: what to do about it, empty where nothing is needed.
    """

    name: str
    value: str
    state: str = "ok"
    remedy: str = ""


def examine(developer: bool = False) -> list[Finding]:
    """Look at everything; no finding raises.

    Args:
        developer: also look for the packages that only tests, checks of the code and
            the documentation need.
    """
    return [
        Finding("python", f"{platform.python_version()} ({sys.executable})"),
        *_packages(developer),
        _llvm(),
        *_variants(),
        *_machine(),
        *_bundled_files(),
    ]


def can_run(findings: Sequence[Finding]) -> bool:
    """Return whether nothing is missing that everything needs."""
    return all(finding.state != "missing" for finding in findings)


def document(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings as JSON holds them."""
    return {
        "schema": 1,
        "can_run": can_run(findings),
        "findings": [asdict(finding) for finding in findings],
    }


def print_table(findings: Sequence[Finding]) -> None:
    """Print the findings as a table, then what to do, then the verdict."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    styles = {"ok": "green", "missing": "bold red", "absent": "yellow"}
    table = Table("what", "found", "state", box=None, pad_edge=False)
    for item in findings:
        state = f"[{styles[item.state]}]{item.state}[/]"
        table.add_row(escape(item.name), escape(item.value), state)
    console = Console()
    console.print(table)
    remedies: dict[str, list[str]] = {}
    for item in findings:
        remedies.setdefault(item.remedy, []).append(item.name)
    for remedy, names in remedies.items():
        if remedy:
            line = f"{', '.join(names)}: {remedy}"
            console.print(line, markup=False, soft_wrap=True)
    verdict = "can" if can_run(findings) else "cannot"
    console.print(f"mi-nerfattack {verdict} run on this machine.", highlight=False)


def _packages(developer: bool) -> Iterator[Finding]:
    try:
        own = importlib.metadata.version(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        remedy = "run 'pip install -e .' in the source folder"
        yield Finding(DISTRIBUTION, "not installed", "missing", remedy)
        return
    yield Finding(DISTRIBUTION, own)
    lines = importlib.metadata.requires(DISTRIBUTION) or []
    needed = [Requirement(line) for line in lines]
    for item in needed:
        if item.marker is None or item.marker.evaluate({"extra": ""}):
            yield _package(item, "missing", f"run \"pip install '{_spec(item)}'\"")
    extras = importlib.metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or []
    for extra in extras:
        if extra in DEVELOPER_EXTRAS and not developer:
            continue
        remedy = f"for {extra}, {install_hint(extra)}"
        for item in needed:
            if item.name != DISTRIBUTION and _belongs(item, extra):
                yield _package(item, "absent", remedy)


def _belongs(item: Requirement, extra: str) -> bool:
    """Tell whether a requirement is one of an extra, and not one of the core."""
    marker = item.marker
    return (
        marker is not None
        and marker.evaluate({"extra": extra})
        and not marker.evaluate({"extra": ""})
    )


def _spec(item: Requirement) -> str:
    return f"{item.name}{item.specifier}"


def _package(item: Requirement, state: str, remedy: str) -> Finding:
    try:
        version = importlib.metadata.version(item.name)
    except (importlib.metadata.PackageNotFoundError, InvalidRequirement):
        return Finding(item.name, "not installed", state, remedy)
    if not item.specifier.contains(version, prereleases=True):
        value = f"{version}, needed {item.specifier}"
        return Finding(item.name, value, state, remedy)
    return Finding(item.name, version)


def _llvm() -> Finding:
    library = llvm.locate()
    origins = {
        "variable": f"from your {llvm.VARIABLE}",
        "package": f"from the package {llvm.PACKAGE}",
        "system": "from the system",
        "dr.jit": "searched by Dr.Jit",
    }
    where = f"{origins[library.origin]}, {library.path or 'file unknown'}"
    try:
        version = ".".join(map(str, llvm.check_version()))
    except (NerfAttackError, ImportError) as err:
        return Finding("LLVM", where, "missing", str(err))
    return Finding("LLVM", f"{version} {where}")


def _variants() -> Iterator[Finding]:
    """Try the variants in a process of their own; it may be aborted."""
    command = module_command("mi_nerfattack.system.probe")
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
        output = done.stdout
    except (OSError, subprocess.TimeoutExpired) as err:
        output = ""
        yield Finding("variants", f"not tried: {err}", "absent")
    errors: dict[str, str | None] = {}
    for line in output.splitlines():
        if line.startswith("{"):
            record = json.loads(line)
            errors[record["variant"]] = record.get("error", "aborted the process")
    loaded = [name for name, error in errors.items() if error is None]
    default = os.environ.get(variant.VARIABLE, variant.DEFAULT)
    yield Finding("variants", ", ".join(loaded) or "none")
    if default in loaded:
        yield Finding("default variant", default)
    else:
        reason = errors.get(default) or "not tried"
        remedy = f"see LLVM above, or set {variant.VARIABLE} to a variant that loads"
        yield Finding("default variant", f"{default}: {reason}", "missing", remedy)
    if any(name.startswith("cuda") for name in loaded):
        yield Finding("GPU", "usable by Dr.Jit")
    else:
        remedy = "optional: an NVIDIA GPU with its driver makes the cuda variants load"
        yield Finding("GPU", "none usable by Dr.Jit", "absent", remedy)


def _machine() -> Iterator[Finding]:
    yield Finding("cores", str(cores()))
    memory = _memory_bytes()
    if memory is not None:
        low = memory < MIN_MEMORY_BYTES
        remedy = f"at least {_gib(MIN_MEMORY_BYTES)} are advised" if low else ""
        yield Finding("memory", _gib(memory), "absent" if low else "ok", remedy)
    disk = shutil.disk_usage(Path.cwd()).free
    low = disk < MIN_DISK_BYTES
    remedy = f"at least {_gib(MIN_DISK_BYTES)} are advised" if low else ""
    yield Finding("disk", f"{_gib(disk)} free here", "absent" if low else "ok", remedy)


def _memory_bytes() -> int | None:
    """Return the memory of the machine, or of the container if that is less."""
    if sys.platform == "win32":
        return None
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.is_file() else "max"
    return total if text == "max" else min(total, int(text))


def _gib(size: int) -> str:
    return f"{size / (1 << 30):.1f} GiB"


def _bundled_files() -> Iterator[Finding]:
    """Compare the bundled scenes with their manifest."""
    remedy = f"reinstall {DISTRIBUTION}, or check out the source folder again"
    try:
        scenes = Path(str(importlib.resources.files("mi_nerfattack.scenes")))
        entries = files.read_json(scenes / "manifest.json")["files"]
    except (ModuleNotFoundError, NerfAttackError, KeyError) as err:
        yield Finding("bundled files", f"no manifest: {err}", "missing", remedy)
        return
    wrong = [
        name for name, entry in entries.items() if not _matches(scenes, name, entry)
    ]
    if wrong:
        yield Finding("bundled files", f"wrong: {', '.join(wrong)}", "missing", remedy)
    else:
        yield Finding("bundled files", f"{len(entries)} as in the manifest")


def _matches(scenes: Path, name: str, entry: dict[str, str]) -> bool:
    path = scenes / name
    return path.is_file() and files.sha256(path) == entry["sha256"]
