"""How far a benchmark is, what is said about the machine, and where results go."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import drjit as dr
import tyro

from mi_nerfattack import variant
from mi_nerfattack.backend import llvm
from mi_nerfattack.commands.shared.options import check_positive, command_line
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.system.machine import cores

PACKAGES = ("mi-nerfattack", "mitsuba", "drjit", "torch", "numpy")
#: Called with a stage's name, units done and wanted, and a remark.
Progress = Callable[[str, int, int, str], None]


@contextmanager
def progress() -> Iterator[Progress]:
    """Show how far a benchmark is."""
    with StageBars() as bars:

        def show(stage: str, done: int, total: int, remark: str) -> None:
            bars.show(stage, done, total, f"{done}/{total} {remark}")

        yield show


def read_sizes(texts: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Read widths and heights as in 200x66."""
    sizes = []
    for text in texts:
        width, cross, height = text.partition("x")
        if not (cross and width.isdecimal() and height.isdecimal()):
            raise InputError(f"--sizes: {text!r}; expected WIDTHxHEIGHT as in 200x66")
        if not (8 <= int(width) <= 4096 and 8 <= int(height) <= 4096):
            raise InputError(f"--sizes: {text!r}; allowed are 8 to 4096 pixels")
        sizes.append((int(width), int(height)))
    if not sizes:
        raise InputError("--sizes: none given; expected WIDTHxHEIGHT as in 200x66")
    return tuple(sizes)


@dataclass(frozen=True)
class Comparison:
    """What commands take that measure two sides in turns."""

    repeats: int = 5
    """Turns of each side."""
    quick: bool = False
    """Measure next to nothing: to see that it works, not for figures."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the result with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the table."""


_Options = TypeVar("_Options", bound=Comparison)


def compare(
    name: str,
    options: _Options,
    measure: Callable[[_Options, Path, Progress], dict[str, Any]],
    lines: Callable[[dict[str, Any]], list[str]],
) -> Result:
    """Measure, write if `options.output` says where, and print.

    Args:
        name: of the command.
        options: of it.
        measure: returns the document, but for its stamp; may write into the folder.
        lines: returns the table of a document, and the lines below it.
    """
    check_positive(options, "repeats")
    variant.ensure()
    with progress() as show, tempfile.TemporaryDirectory() as folder:
        document = publish(name, options, measure(options, Path(folder), show))
    return Result(document, lambda: print(*lines(document), sep="\n"))


def data_folder() -> Path:
    """Return the folder of inputs that no checkout has.

    Raises:
        InputError: NERFATTACK_DATA is not set.
    """
    if not (data := os.environ.get("NERFATTACK_DATA")):
        raise InputError(
            "NERFATTACK_DATA: set it to the folder that has `fox` (NERFATTACK_DATA is "
            "not set)"
        )
    return Path(data)


def timed(
    work: Callable[[], Any], clock: Callable[[], float] = time.process_time
) -> float:
    """Return the time of work, with the kernels that it launched."""
    dr.sync_thread()
    start = clock()
    work()
    dr.sync_thread()
    return clock() - start


def machine() -> dict[str, Any]:
    """Describe processor and system; nothing that names the computer."""
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, LLVM and the packages that compute."""
    by_name = {name: importlib.metadata.version(name) for name in PACKAGES}
    number = llvm.version()
    by_name["llvm"] = ".".join(map(str, number)) if number else "none"
    by_name["python"] = platform.python_version()
    return by_name


def stamp(document: dict[str, Any], command: str) -> dict[str, Any]:
    """Add date, machine, versions and command to a document."""
    now = datetime.datetime.now(datetime.timezone.utc)
    return {
        **document,
        "date": now.date().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "command": command,
    }


def command_of(name: str, options: Any) -> str:
    """Write a benchmark's command: options but for the defaults and the output."""
    where = {f.name: f.default for f in fields(options) if f.name in ("output", "json")}
    line = command_line(name, replace(options, **where))
    return line.replace("mi-nerfattack", "python -m bench", 1)


def publish(name: str, options: Any, document: dict[str, Any]) -> dict[str, Any]:
    """Return a result with its stamp, and write it if `options.output` says where."""
    document = stamp(document, command_of(name, options))
    if options.output is not None:
        path = write(options.output, name, document)
        print(f"written to {path}", file=sys.stderr)
    return document


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


def run_command(words: Sequence[str]) -> None:
    """Run ``mi-nerfattack``, ``python -m bench`` or ``python`` in another process.

    Args:
        words: of its command line; the first one is ``bench`` for a benchmark, and
            ``python`` for a script or another module.

    Raises:
        SystemExit: with its exit code, if it fails.
    """
    if code := _run(words, stdout=None).returncode:
        raise SystemExit(code if code > 0 else 1)


def run_for_output(words: Sequence[str]) -> tuple[int, str]:
    """Run a command as :func:`run_command` does, also one that may fail.

    Returns:
        Its exit code, and what it printed on standard output.
    """
    done = _run(words, stdout=subprocess.PIPE)
    return done.returncode, done.stdout


def _run(words: Sequence[str], stdout: int | None) -> subprocess.CompletedProcess[str]:
    prefix = {"bench": ["-m", "bench"], "python": []}.get(words[0])
    if prefix is None:
        words, prefix = ["mi-nerfattack", *words], ["-m", "mi_nerfattack.cli"]
    print("$", shlex.join(words), file=sys.stderr, flush=True)
    command = [sys.executable, *prefix, *words[1:]]
    return subprocess.run(command, check=False, stdout=stdout, text=True)
