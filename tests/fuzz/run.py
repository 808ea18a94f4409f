"""Fuzz readers: ``python -m fuzz.run FORMAT... --count N`` with `tests` as a path.

Files are read in a child that is forked from this process, which has no threads. An
input may take `SECONDS` of a core, and `MEMORY` bytes more than there was before the
first of its format. A child that dies or hangs is replaced by one that goes on after
the input.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mi_nerfattack  # noqa: F401  before drjit: it chooses the LLVM

# isort: split
from fuzz.formats import FORMATS, Read

from mi_nerfattack import variant
from mi_nerfattack.errors import NerfAttackError

SECONDS = 10.0
WAITING = 60.0  # seconds that pass, whatever is computed
MEMORY = 2 << 30
LONGEST = 10_000  # characters of a message


@dataclass(frozen=True)
class Plan:
    """Formats and numbers of inputs, in order; a folder keeps those that fail."""

    jobs: Sequence[tuple[str, int]]
    seed: int
    verbose: bool
    keep: Path | None


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("formats", nargs="*", default=list(FORMATS))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of an input")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="one input, with its traceback")
    parser.add_argument("--keep", type=Path, help="folder for the inputs that fail")
    arguments = parser.parse_args()
    single = arguments.only is not None
    several = range(arguments.first, arguments.first + arguments.count)
    numbers = [arguments.only] if single else several
    jobs = [(name, number) for name in arguments.formats for number in numbers]
    failures = fuzz(Plan(jobs, arguments.seed, single, arguments.keep))
    for (name, kind), inputs in failures.items():
        print(f"{name}: {len(inputs)} inputs, as --only {inputs[0]}: {kind}")
    return int(bool(failures))


def fuzz(plan: Plan) -> dict[tuple[str, str], list[int]]:
    failures: dict[tuple[str, str], list[int]] = {}
    at = 0
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report"
        while at < len(plan.jobs):
            shared = mmap.mmap(-1, 9)
            report.write_bytes(b"")
            child = os.fork()
            if child == 0:
                _child(plan, at, shared, report, tempfile.mkdtemp(dir=folder))
            ending = _watch(child, shared)
            for line in report.read_text().splitlines():
                index, kind = json.loads(line)
                name, number = plan.jobs[index]
                failures.setdefault((name, kind), []).append(number)
            at = max(at, int.from_bytes(shared[:8], "little"))
            name, number = plan.jobs[at]
            if ending:
                failures.setdefault((name, ending), []).append(number)
            at = at + 1 if ending else len(plan.jobs)
    return failures


def _watch(child: int, shared: mmap.mmap) -> str:
    """Wait for the end of a child; say how it ended where it was not by itself."""
    last, since, spent = b"", 0.0, 0.0
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            code = os.waitstatus_to_exitcode(status)
            ending = f"signal {signal.Signals(-code).name}" if code < 0 else ""
            return ending or (f"exit code {code}" if code else "")
        used = _cpu_seconds(child)
        if shared[:] != last:
            last, since, spent = shared[:], time.monotonic(), used
        elif last[8] and (used - spent > SECONDS or time.monotonic() > since + WAITING):
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"more than {SECONDS:g} s, or waits"
        time.sleep(0.005)


def _cpu_seconds(process: int) -> float:
    """Return what a process has computed, which other processes do not slow down."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _child(plan: Plan, at: int, shared: mmap.mmap, report: Path, work: str) -> None:
    code = 1
    try:
        if not plan.verbose:  # what libraries print is no outcome
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        warnings.simplefilter("error")
        name, targets, good = "", [], {}
        for index in range(at, len(plan.jobs)):
            if plan.jobs[index][0] != name:
                shared[:] = index.to_bytes(8, "little") + b"\0"  # not timed
                name = plan.jobs[index][0]
                targets = _prepare(name, Path(work) / name)
                good = {path: path.read_bytes() for path, _ in targets}
            shared[:] = index.to_bytes(8, "little") + b"\1"
            number = plan.jobs[index][1]
            path, read = targets[number % len(targets)]
            rng = random.Random(f"{name} {plan.seed} {number}")
            raw = FORMATS[name].mutate(rng, good[path])
            path.write_bytes(raw)
            kind = _outcome(read, path, plan.verbose)
            path.write_bytes(good[path])
            if kind:
                with report.open("a") as out:
                    out.write(json.dumps([index, kind]) + "\n")
                if plan.keep is not None:
                    plan.keep.mkdir(exist_ok=True)
                    (plan.keep / f"{name}_{number}_{path.name}").write_bytes(raw)
        code = 0
    except BaseException:
        with report.open("a") as out:
            kind = f"cannot be fuzzed: {traceback.format_exc()}"
            out.write(json.dumps([index, kind]) + "\n")
    finally:
        os._exit(code)


def _prepare(name: str, folder: Path) -> list[tuple[Path, Read]]:
    """Write good files, read them, and limit the memory from there on."""
    folder.mkdir()
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    variant.ensure()
    targets = FORMATS[name].prepare(folder)
    for path, read in targets:
        read(path)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * mmap.PAGESIZE + MEMORY, most))
    return targets


def _outcome(read: Read, path: Path, verbose: bool) -> str:
    try:
        read(path)
    except NerfAttackError as err:
        if verbose:
            print(err, flush=True)
        long = len(str(err)) > LONGEST
        return f"a message of {len(str(err))} characters" if long else ""
    except Exception as err:
        if verbose:
            traceback.print_exc()
        frames = traceback.extract_tb(err.__traceback__)
        ours = [f for f in frames if "mi_nerfattack" in f.filename] or frames
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
        return f"{where}: {type(err).__name__}: {str(err)[:120]}"
    return ""


if __name__ == "__main__":
    sys.exit(main())
