"""``python -m bench reach``: how far objects can move the control, at each place."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro

from bench.results import progress
from bench.tables import markdown, number
from mi_nerfattack import variant
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.reach import DRIVES, Reach, measure_reach
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.rollout.drive import departure_limit
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.scenario.world import World, build_world

#: Columns of the file that say what was measured: place, digest of the scenario and
#: its files, and digest of the program.
LABELS = ("place", "scenario", "source")
#: Columns of the table, by the keys of a row.
HEADS = {
    "place": "place",
    "in_view": "frames in view",
    "pixels": "pixels, median",
    "most_pixels": "largest",
    "moved": "reach, median",
    "most_moved": "largest",
    **{f"{name}_m": f"{name}, m" for name in DRIVES},
    "limit_m": "limit, m",
}


@dataclass(frozen=True)
class BenchReach:
    """Measure how far the objects can move the control, whatever they look like.

    In each frame, each pixel of the objects takes the value that moves the first
    control most: no texture moves it farther. The table has, at each place, the frames
    in which the objects change pixels by 0.1 or more, the pixels and the reach of
    these frames (median and most, in the unit of the control), and the largest error
    of three drives from the nominal start: as the objects look, and with all frames'
    controls raised or lowered. A place takes a minute, with six objects some minutes.

    A table in a file continues: a place is not measured again if the file has a row of
    it with the same scenario, as its digest in the file says. Otherwise the new row
    replaces the old one.
    """

    file: tyro.conf.Positional[Path]
    """Scenario or grid file (TOML). Of a grid, each place is measured once."""
    only: tuple[str, ...] = ()
    """Places of a grid, as the table names them: right-patch-1. All by default."""
    settings: Settings = ()
    """Set a key of the scenario: drive.length_m=45. A grid sets keys itself."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Table (.csv), which a second run continues."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure each place that has no row yet, and print the table."""
        variant.ensure()
        rows = []
        if self.output is not None:
            files.make_folder(self.output.parent)
            if self.output.exists():
                rows = read_rows(self.output)
        with progress() as show:
            for place, scenario in self._scenarios():
                labels = {"place": place, "scenario": scenario.digest()}
                if any(labels.items() <= item.items() for item in rows):
                    continue
                labels["source"] = versions()["source"]
                world = build_world(scenario, scenario.build_policy())
                on_step = partial(_shown, show, place, world.horizon)
                figures = row(world, measure_reach(world, on_step=on_step))
                rows = [item for item in rows if item["place"] != place]
                rows.append(labels | figures)
                if self.output is not None:
                    text = pd.DataFrame(rows).to_csv(index=False, float_format="%.6g")
                    files.write_text(self.output, text)
                del world
                gc.collect()
        return Result({"places": rows}, lambda: print(table(rows)))

    def _scenarios(self) -> Iterator[tuple[str, Scenario]]:
        if "scenario" not in files.read_toml(self.file):
            yield self.file.stem, load_scenario(self.file, settings=self.settings)[0]
            return
        if self.settings:
            raise InputError(f"--set: {self.file} is a grid; set the key in it")
        cells = {f"{c.route}-{c.objects}-{c.seed}": c for c in load_cells(self.file)}
        if unknown := sorted({*self.only} - {*cells}):
            raise InputError(f"--only: {unknown[0]!r}; places: {', '.join(cells)}")
        for place in self.only or cells:
            text = cells[place].text
            yield place, Scenario.model_validate(parse_toml(self.file, text))


def _shown(show: Any, place: str, horizon: int, step: int) -> None:
    show(place, step + 1, horizon, "")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a table; a row without digests gets empty ones."""
    kinds = dict.fromkeys(LABELS, str)
    stored = pd.read_csv(path, dtype=kinds, na_filter=False).to_dict("records")
    none = dict.fromkeys(LABELS, "")
    return [none | {str(key): value for key, value in item.items()} for item in stored]


def row(world: World, reach: Reach) -> dict[str, Any]:
    """Return the figures of a place."""
    in_view = reach.pixels > 0
    farthest = np.abs(reach.cross_track_m).max(1)
    width = world.scenario.vehicle.width_m
    middle = {"pixels": 0.0, "moved": 0.0}
    if in_view.any():
        middle["pixels"] = float(np.median(reach.pixels[in_view]))
        middle["moved"] = float(np.median(reach.moved[in_view]))
    return {
        "frames": len(in_view),
        "in_view": int(in_view.sum()),
        "most_pixels": int(reach.pixels.max()),
        "most_moved": float(reach.moved.max()),
        **middle,
        **{f"{name}_m": float(m) for name, m in zip(DRIVES, farthest, strict=True)},
        "limit_m": departure_limit(world.route.lane_width_m, width),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table in Markdown."""
    cells = []
    for item in rows:
        shown = {key: number(item[key]) for key in HEADS if key != "place"}
        shown["in_view"] = f"{item['in_view']} of {item['frames']}"
        cells.append([item["place"], *shown.values()])
    return markdown(list(HEADS.values()), cells)
