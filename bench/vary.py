"""``python -m bench vary``: what each part of a variation costs."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.results import Comparison, Progress, compare, timed
from bench.tables import markdown
from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.ranges import Count
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world
from mi_nerfattack.scenes import bundled

#: Settings of [attack.vary], by part.
SETTINGS = {
    "nothing": (),
    "sun": ("sun={elevation_deg = [15, 60], share = [0.0, 0.9]}",),
    "light": ("light_ev_sd=0.5", "light_colour_ev_sd=0.1"),
    "exposure": ("exposure_ev_sd=0.3", "colour_ev_sd=0.1"),
    "blur": ("blur_px_sd=0.5",),
    "noise": ("noise_sd=0.02",),
    "camera": ("pitch_deg_sd=0.3", "height_sd=0.05"),
    "vehicle": ("speed_sd=0.05", "steering_sd=0.1", "steering_lag_s_sd=0.1"),
}
DRIVE = ("drive.start_m=14", "drive.length_m=8")  # towards the hydrant
WARM_UP = 1


@dataclass(frozen=True)
class BenchVary(Comparison):
    """Measure what each part of [attack.vary] adds to an iteration.

    The attack is the one of the demo, over 8 m before the hydrant, from four poses. All
    parts drive in turns; the medians of the processor time count. Takes about five
    minutes.
    """

    poses: Count = 4
    """Initial poses, each with its own draws."""

    def run(self) -> Result:
        """Measure, print and write."""
        return compare("vary", self, measure, lines=lines)


def measure(options: BenchVary, folder: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    del folder
    turns: dict[str, list[float]] = {part: [] for part in SETTINGS}
    attacks = {part: _attack(options, part) for part in SETTINGS}
    for turn in range(WARM_UP + options.repeats):
        show("vary", turn, WARM_UP + options.repeats, "")
        for part, attack in attacks.items():
            turns[part].append(timed(attack.step))
    medians = {part: statistics.median(some[WARM_UP:]) for part, some in turns.items()}
    rows = {
        part: {"iteration_cpu_s": seconds, "ratio": seconds / medians["nothing"]}
        for part, seconds in medians.items()
    }
    return {"poses": options.poses, "parts": rows}


def _attack(options: BenchVary, part: str) -> AbstractAttack:
    """Return the attack with one part of the variation."""
    settings = [f"attack.poses={options.poses}", *DRIVE]
    settings += [f"attack.vary.{text}" for text in SETTINGS[part]]
    if options.quick:
        settings += ["drive.length_m=2", "camera.width=40", "camera.height=20"]
    scenario, _ = load_scenario(bundled("demo.toml"), settings=settings)
    return build_attack(build_world(scenario, scenario.build_policy()))


def lines(document: dict[str, Any]) -> list[str]:
    """Return the table."""
    rows = [
        (part, f"{row['iteration_cpu_s']:.2f}", f"{row['ratio']:.2f}")
        for part, row in document["parts"].items()
    ]
    header = ("part", "CPU s of an iteration", "to none")
    return [markdown(header, rows), f"{document['poses']} poses"]
