"""``python -m bench imports``: what the package adds to an import of Mitsuba."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

from mi_nerfattack.commands.shared.result import Result

WANTED_S = 0.5
_TIMED = """
import json, time
wall, cpu = time.perf_counter(), time.process_time()
import mitsuba
{ours}
mitsuba.set_variant("llvm_ad_rgb")
print(json.dumps([time.perf_counter() - wall, time.process_time() - cpu]))
"""


@dataclass(frozen=True)
class BenchImports:
    """Measure imports up to a set variant, of Mitsuba alone and of the package too.

    Each in a process of its own, in turns; medians count, after a turn that fills the
    caches. Setting the variant registers the plugins. Exit code 1 where the package
    adds more than 0.5 s of processor time.
    """

    repeats: int = 7
    """Turns."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Import, and print."""
        from mi_nerfattack.commands.shared.options import check_positive

        check_positive(self, "repeats")
        sides = {"mitsuba": "", "both": "import mi_nerfattack"}
        times: dict[str, list[Any]] = {name: [] for name in sides}
        for turn in range(self.repeats + 1):
            for name, ours in sides.items():
                measured = _measure(_TIMED.format(ours=ours))
                times[name] += [measured] * (turn > 0)
        medians = {
            name: [statistics.median(column) for column in zip(*rows, strict=True)]
            for name, rows in times.items()
        }
        pairs = zip(medians["both"], medians["mitsuba"], strict=True)
        medians["added"] = [both - alone for both, alone in pairs]
        document = {
            name: dict(zip(("wall_s", "cpu_s"), values, strict=True))
            for name, values in medians.items()
        }

        def show() -> None:
            for name, values in document.items():
                print(f"{name:8} {values['wall_s']:.3f} s, {values['cpu_s']:.3f} s CPU")

        return Result(document, show, int(document["added"]["cpu_s"] > WANTED_S))


def _measure(code: str) -> tuple[float, float]:
    """Return the seconds, and those of the processor, that a process tells."""
    known = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=known, stdout=subprocess.PIPE, check=True)
    wall_s, cpu_s = json.loads(done.stdout)
    return wall_s, cpu_s
