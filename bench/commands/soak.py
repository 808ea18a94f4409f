"""``python -m bench soak``: thousands of iterations without growth or drift."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchSoak:
    """Attack a tiny scene for thousands of iterations, and look for growth and drift.

    In the deterministic mode, on one thread, once in one go and once resumed half way,
    each by a process of its own. Exit code 1 where memory, open files or threads grow,
    a kernel is compiled late, the resumed attack ends in other bits, or the best
    objective is another when it is judged anew.
    """

    iterations: int = 2000
    """Of the attack, a multiple of 20."""
    settled: int = 200
    """First iterations, which may take memory and compile."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Also write the figures with machine, versions and date: a .json file, or a folder
    in which it is named by date and machine."""
    json: bool = False
    """Print one line of JSON in place of the sentences."""

    def run(self) -> Result:
        """Attack, compare and print."""
        from bench import results
        from bench.soak.run import Soak, faults, run

        soak = Soak(self.iterations, self.settled)
        command = ["python", "-m", "bench", "soak"]
        command += ["--iterations", str(self.iterations)]
        command += ["--settled", str(self.settled)]
        document = results.stamp(run(soak), command)
        found = faults(document)
        if self.output is not None:
            path = results.write(self.output, "soak", document)
            print(f"written to {path}", file=sys.stderr)
        return Result(document, lambda: _print(document, found), int(bool(found)))


def _print(document: dict[str, Any], found: list[str]) -> None:
    first, last = document["resident_mb"]
    count, settled = document["iterations"], document["settled"]
    growth = document["growth_b_per_iteration"]
    print(
        f"resident after {settled} and {count} iterations: {first:.1f}, {last:.1f} MB"
    )
    print(f"growth by least squares: {growth:.0f} bytes an iteration")
    print(f"kernels compiled after {settled}: {document['kernels_compiled']}")
    for name in ("descriptors", "threads"):
        print(f"{name}: {document[name][0]} to {document[name][1]}")
    for kind in ("cpu", "wall"):
        times = [document[f"{end}_{kind}_ms"] for end in ("first", "last")]
        print(
            f"an iteration, {kind}: {times[0]:.1f} ms at first, {times[1]:.1f} at last"
        )
    objective = document["objective"]
    print(f"best objective: {objective['tracked']}, anew {objective['judged']}")
    print(f"tensors that differ when resumed half way: {len(document['differing'])}")
    for line in found:
        print(f"wrong: {line}")
