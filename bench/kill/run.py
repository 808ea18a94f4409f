"""Kill an attack at random moments, and check that it always goes on.

``python -m bench.kill.run --kills 200`` attacks a tiny scenario in the
deterministic mode, kills the process (SIGKILL) at random or aimed moments, resumes it
in the same folder, and so on until the run is complete; then the next run begins.
Nothing may be lost but less than a checkpoint interval, and a run that was killed any
number of times must end with the bits of one that was not.

The interpreter and its imports are started once and forked: that takes nothing from
what is tested, since Dr.Jit and the variant's threads start in the fork.
"""

from __future__ import annotations

import json
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from bench.kill.scenario import EVERY, HORIZON, RUNS, WRITING, make_scenario, run_job
from mi_nerfattack.io import files, locks

_LIFE_S = 300.0  # after which a process is taken to hang
_AIMS = {
    "any moment": 8,
    "start": 2,
    "drive": 4,
    "checkpoint": 4,
    "write": 6,
    "results": 3,
}
# The attack is checked by itself; the attribution is a part of the results, which a
# resumed run writes anew.
_NOT_DRIVES = {"surrogate: optimisation", "surrogate: attribution", WRITING}
_RESULTS = ("attack.json", "objects/ball.safetensors", "steps.csv")


@dataclass
class Life:
    """What one process told before its end.

    Attributes:
        lines: (stage, steps done, remark) as they came.
        killed: whether it was killed; else it came to its end or failed.
        seconds: it lived.
    """

    lines: list[tuple[str, int, str]] = field(default_factory=list)
    killed: bool = False
    seconds: float = 0.0
    code: int | None = None

    @property
    def complete(self) -> bool:
        """Whether the job came to its end."""
        return self.code == 0

    def done(self, stage: str) -> int:
        """Steps done of a stage; 0 if it has not begun."""
        return max((done for name, done, _ in self.lines if name == stage), default=0)

    def place(self) -> str:
        """Where it was when it told the last."""
        stages = [name for name, _, _ in self.lines if name != WRITING]
        place = stages[-1] if stages else "start-up"
        if self.done("deployment: attack") == RUNS * HORIZON:
            place = "results"
        writing = self.lines and self.lines[-1][0] == WRITING
        return f"{place}, {WRITING}" if writing else place

    def first(self, stage: str) -> int | None:
        """Steps done before this process began a stage; None if it has not."""
        own = [
            d for name, d, remark in self.lines if name == stage and remark != "kept"
        ]
        return min(own) - 1 if own else None


def live(work: Callable[[int], None], stop: Callable[[Life], float | None]) -> Life:
    """Fork a process, listen to it, and kill it when told to.

    Args:
        work: what the process does; is given a descriptor to write lines to.
        stop: called with what was told so far, after each line and at the start;
            returns in how many seconds to kill, None to go on as before.
    """
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _work_and_exit(work, writer)
    os.close(writer)
    life, start, buffer = Life(), time.monotonic(), b""
    deadline = start + _LIFE_S
    while True:
        delay = stop(life)
        if delay is not None:
            deadline = min(deadline, time.monotonic() + delay)
        wait = max(0.0, deadline - time.monotonic())
        if not select.select([reader], [], [], wait)[0]:
            os.kill(pid, signal.SIGKILL)
            life.killed = True
            break
        chunk = os.read(reader, 1 << 16)
        if not chunk:
            break
        *whole, buffer = (buffer + chunk).split(b"\n")
        life.lines += [_parse(line) for line in whole]
    os.close(reader)
    life.code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    life.seconds = time.monotonic() - start
    return life


def _work_and_exit(work: Callable[[int], None], writer: int) -> None:
    code = 1
    try:
        work(writer)
        code = 0
    except BaseException:  # whatever it is, the parent must not run on in here
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _parse(line: bytes) -> tuple[str, int, str]:
    stage, done, remark = line.decode().split("\t")
    return stage, int(done), remark


class Campaign:
    """Kills, resumes and checks.

    Args:
        folder: to work in.
        kills: how many.
        seed: of the moments.
    """

    def __init__(self, folder: Path, kills: int, seed: int) -> None:
        self.folder, self.kills = folder, kills
        self.random = random.Random(seed)
        self.failures: list[str] = []
        self.landed: Counter[str] = Counter()
        self.lost: Counter[int] = Counter()
        self.resumes = self.partial = self.runs = 0

    def run(self) -> dict[str, Any]:
        """Do all kills and return the counts."""
        scenario = self.folder / "scenario"
        made = live(lambda _: make_scenario(scenario), lambda _: None)
        whole = self.folder / "whole"
        reference = live(lambda w: run_job(scenario, whole, w), lambda _: None)
        if not (made.complete and reference.complete):
            raise RuntimeError("the run that nothing interrupts failed, see above")
        killed = 0
        while killed < self.kills:
            output = self.folder / f"run{self.runs}"
            killed += self._one_run(scenario, output, reference, self.kills - killed)
            self._compare(whole, output)
            shutil.rmtree(output)
            self.runs += 1
        return {
            "kills": killed,
            "resumes": self.resumes,
            "runs_completed": self.runs,
            "checkpoint_every": EVERY,
            "iterations_lost": {str(k): n for k, n in sorted(self.lost.items())},
            "killed_in": dict(self.landed.most_common()),
            "kills_with_partial_files": self.partial,
            "failures": self.failures,
        }

    def _one_run(self, scenario: Path, output: Path, reference: Life, most: int) -> int:
        """Kill a run up to `most` times, and let it end."""
        killed, seen = 0, Life()
        while True:
            stop = self._aim(reference) if killed < most else lambda _: None
            life = live(lambda w: run_job(scenario, output, w), stop)
            if killed:
                self._check(output, seen, life)
            seen.lines += life.lines
            if not life.killed:
                if not life.complete:
                    self.failures.append(f"{output.name}: exit code {life.code}")
                return killed
            killed += 1
            self._note(output, life)
            print(f"{output.name}: killed in {life.place()}", file=sys.stderr)

    def _aim(self, reference: Life) -> Callable[[Life], float | None]:
        """Choose when to kill."""
        draw, whole = self.random, reference.seconds
        aim = draw.choices(list(_AIMS), list(_AIMS.values()))[0]
        if aim in ("any moment", "start"):
            moment = draw.uniform(0, (0.4 if aim == "any moment" else 0.1) * whole)
            return lambda life: None if life.lines else moment
        chance = draw.uniform(0.05, 0.5)

        def stop(life: Life) -> float | None:
            if not life.lines or draw.random() > chance:
                return None
            stage, done, _ = life.lines[-1]
            if aim == "write":
                return 0.0 if stage == WRITING else None
            if aim == "drive":
                return None if stage in _NOT_DRIVES else draw.uniform(0, 0.02)
            if aim == "results":
                late = life.done("deployment: attack") == RUNS * HORIZON
                return draw.uniform(0, 0.2 * whole) if late else None
            iteration, rest = divmod(done, 2 * HORIZON)
            due = (
                stage == "surrogate: optimisation"
                and rest == 0
                and iteration % EVERY == 0
            )
            return draw.uniform(0, 0.03) if due else None

        return stop

    def _note(self, output: Path, life: Life) -> None:
        """Count where a kill landed."""
        self.landed[life.place()] += 1
        names = list(output.rglob(".*.tmp")) if output.exists() else []
        self.partial += any(map(locks.is_partial, names))
        for path in output.rglob("*.safetensors"):
            files.read_safetensors(path)  # what has a name is whole

    def _check(self, output: Path, seen: Life, life: Life) -> None:
        """Check that a resumed process has lost no more than it may."""
        self.resumes += bool(life.lines) or life.complete
        begun = life.first("surrogate: optimisation")
        if begun is not None:
            lost = (seen.done("surrogate: optimisation") - begun) // (2 * HORIZON)
            self.lost[max(lost, 0)] += 1
            if lost > EVERY:
                self.failures.append(f"{output.name}: {lost} iterations lost")
        for stage in {name for name, _, _ in life.lines} - _NOT_DRIVES:
            first = life.first(stage)
            unit = HORIZON * (
                2 if stage == "surrogate: random" else 1
            )  # judged, driven
            if first is not None and seen.done(stage) - first > unit:
                self.failures.append(f"{output.name}: {stage}: drives were repeated")
        if any(map(locks.is_partial, output.rglob(".*.tmp"))) and life.complete:
            self.failures.append(f"{output.name}: temporary files are left")

    def _compare(self, whole: Path, output: Path) -> None:
        """Compare the results of a killed run with those of one that was not."""
        for name in _RESULTS:
            if (whole / name).read_bytes() != (output / name).read_bytes():
                self.failures.append(f"{output.name}: {name} differs")
        routes = [
            files.read_json(path / "metrics.json")["routes"] for path in (whole, output)
        ]
        if routes[0] != routes[1]:
            self.failures.append(f"{output.name}: metrics.json differs")


def main(kills: int = 200, seed: int = 0, output: Path | None = None) -> int:
    """Kill an attack at random moments; exit code 1 if a resumption failed.

    Args:
        kills: how many.
        seed: of the moments.
        output: also write the counts to this JSON file.
    """
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="kill-") as folder:
        document = Campaign(Path(folder), kills, seed).run()
    document["seconds"] = round(time.monotonic() - start, 1)
    print(json.dumps(document, indent=2))
    if output is not None:
        files.write_json(output, document)
    return int(bool(document["failures"]))


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
