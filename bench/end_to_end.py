"""``python -m bench end_to_end``: whole commands, in turns with another checkout."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pandas as pd
import tyro

from bench.results import data_folder, progress
from bench.studies.plan import ROOT
from bench.tables import markdown, number
from mi_nerfattack.commands.shared.options import check_positive
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.io import files

#: Names of commands, and their words; later ones read what earlier ones wrote.
COMMANDS = {
    "capture of a scene": """capture scene {scenes}/intersection/scene.xml --views 64
        --routes-file {scenes}/intersection/routes.json -o {work}/views""",
    "fit to the scene": """fit {work}/views -o {work}/place.safetensors --network small
        --steps 200""",
    "capture of photographs": """capture photographs {data}/fox/images --long-edge 800
        -o {work}/photographs""",
    "fit to photographs": """fit {work}/photographs -o {work}/fox.safetensors
        --network small --steps 200 --long-edge 320""",
    "asset of a mesh": """asset mesh {data}/assets/Duck.glb --height-m 0.3
        -o {work}/duck.safetensors""",
    "train": """train -o {work}/policy.safetensors --data {work}/frames --frames
        surrogate 512 mitsuba 512 --validation-frames surrogate 64 --epochs 2
        --dagger-rounds 0 --skies day --exposures-ev 0 --validate-every 100
        --validate-in surrogate --runs 1 --workers 2""",
    "attack": "attack {work}/short.toml -o {work}/attack",
    "transfer": """transfer {work}/attack -o {work}/transfer --environments surrogate
        mitsuba --conditions day --cases no_object attack --workers 2""",
}
#: Words of commands now, and at commit f8ba392c.
FORMER = {
    "capture scene ": "capture ",
    "capture photographs ": "capture ",
    "--routes-file": "--routes",
    "asset mesh ": "asset ",
}
#: The demo's scenario, shortened; the same keys stand in both checkouts.
SHORT = {"max_iterations": 4, "textures": 2, "runs": 2}
LABELS = ("round", "command", "checkout")
PEER = "other"


@dataclass(frozen=True)
class BenchEndToEnd:
    """Time each command from its start to its end, with a new process.

    With --other, the commands of another checkout run in turns with those of this one.
    Each has an environment of its own in .venv. Needs NERFATTACK_DATA for photographs
    and a mesh. A second run continues the table.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for what the commands write, and for the table, end_to_end.csv."""
    other: Path | None = None
    """Checkout of another version."""
    former: bool = False
    """The other checkout has the options of commit f8ba392c."""
    repeats: int = 3
    """Turns of each command."""
    json: bool = False
    """Print one line of JSON instead of the table."""

    def run(self) -> Result:
        """Run what has no row yet, and print medians."""
        check_positive(self, "repeats")
        data, checkouts = data_folder().resolve(), {"this": ROOT}
        if self.other is not None:
            checkouts[PEER] = self.other.resolve()
        path = files.make_folder(self.output) / "end_to_end.csv"
        rows = pd.read_csv(path).to_dict("records") if path.exists() else []
        done = {tuple(row[label] for label in LABELS) for row in rows}
        turns = list(itertools.product(range(self.repeats), COMMANDS, checkouts))
        with progress() as show:
            for index, (turn, command, name) in enumerate(turns):
                show("commands", index, len(turns), f"{name}: {command}")
                if (turn, command, name) in done:
                    continue
                work = files.make_folder(self.output.resolve() / f"{name}-{turn}")
                words = COMMANDS[command]
                if self.former and name == PEER:
                    for new, old in FORMER.items():
                        words = words.replace(new, old)
                labels = dict(zip(LABELS, (turn, command, name), strict=True))
                figures = _timed(checkouts[name], words, work=work, data=data)
                rows.append({**labels, **figures})
                text = pd.DataFrame(rows).to_csv(index=False, float_format="%.6g")
                files.write_text(path, text)
        return Result({"rows": rows}, lambda: print(table(pd.DataFrame(rows))))


def _timed(checkout: Path, words: str, *, work: Path, data: Path) -> dict[str, float]:
    """Run a command in a checkout.

    Returns:
        `seconds` of wall time, and `peak_mb`, the largest resident size of one of its
        processes.
    """
    scenes = checkout / "scenes"
    text = files.read_text(scenes / "demo.toml")
    for key, value in SHORT.items():
        text = re.sub(rf"^{key} = \d+", f"{key} = {value}", text, flags=re.MULTILINE)
    files.write_text(work / "short.toml", text)
    paths = {"scenes": scenes, "work": work, "data": data}
    quoted = {name: shlex.quote(str(path)) for name, path in paths.items()}
    line = shlex.split(words.format(**quoted))
    for option in {"-o", "--data"} & {*line}:  # a command that was stopped starts again
        for path in work.glob(Path(line[line.index(option) + 1]).stem + "*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    program = sys.executable if checkout == ROOT else checkout / ".venv/bin/python"
    begin = time.monotonic()
    with tempfile.TemporaryFile() as log:
        child = subprocess.Popen(
            [program, "-m", "mi_nerfattack.cli", *line],
            cwd=checkout,
            stdout=log,
            stderr=log,
        )
        _, status, usage = os.wait4(child.pid, 0)
        seconds = time.monotonic() - begin
        log.seek(0)
        files.write_bytes(work / "log.txt", log.read())  # of the last command
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        print(f"{checkout}: {shlex.join(line)}: see {work}/log.txt", file=sys.stderr)
        raise SystemExit(1)
    return {"seconds": seconds, "peak_mb": usage.ru_maxrss / 1e3}


def table(rows: pd.DataFrame) -> str:
    """Return medians of each command in Markdown, and the ratio of two checkouts."""
    medians = {
        key: (float(part["seconds"].median()), float(part["peak_mb"].median()))
        for key, part in rows.groupby(["command", "checkout"])
    }
    lines = []
    for command in COMMANDS:
        own, peer = medians[command, "this"], medians.get((command, PEER))
        others = ["–"] * 3
        if peer is not None:
            others = [*map(number, peer), f"{peer[0] / own[0]:.2f}"]
        lines.append([command, *map(number, own), *others])
    head = ["command", "s", "MB", "other, s", "other, MB", "other / this"]
    return markdown(head, lines)
