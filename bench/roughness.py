"""``python -m bench roughness``: how rough the objective is, by rays per pixel."""

from __future__ import annotations

import gc
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro

from bench.results import Progress, progress
from bench.tables import markdown
from mi_nerfattack import variant
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.ranges import Count
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import World, build_attack, build_world

PLACES = Path(__file__).with_name("roughness.toml")
RAYS = (4, 1, 9)  # an attack with the first makes the texture
ITERATIONS = 3  # of each attack
CHANGE = 1e-4  # of all raw colour values, up or down
SMOOTH = 1e-3  # largest standard deviation of a smooth objective, of its mean


@dataclass(frozen=True)
class BenchRoughness:
    """Measure the objective's standard deviation under changes that nobody can see.

    At each of six places, an attack does three iterations with 4 rays per pixel. Then
    all raw colours change by 1e-4, up or down, again and again, and the drive is
    judged with 1, 4 and 9 rays per pixel. The cost is the processor time of one
    iteration; for it, attacks with 1 and 9 rays do three iterations, too. Takes about
    half an hour. A second run continues the table.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Table (.csv): a row for each place and number of rays."""
    changes: Count = 10
    """Random changes of each."""
    json: bool = False
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Measure what has no row yet, and print the table."""
        variant.ensure()
        files.make_folder(self.output.parent)
        rows = pd.read_csv(self.output) if self.output.exists() else pd.DataFrame()
        with progress() as show:
            for cell in load_cells(PLACES):
                place = f"{cell.route}, {cell.objects}"
                if rows.empty or place not in set(rows["place"]):
                    scenario = Scenario.model_validate(parse_toml(PLACES, cell.text))
                    measured = pd.DataFrame(_measure(scenario, self.changes, show))
                    measured.insert(0, "place", place)
                    rows = pd.concat([rows, measured], ignore_index=True)
                    text = rows.to_csv(index=False, float_format="%.6g")
                    files.write_text(self.output, text)
                    gc.collect()
        document = {"rows": rows.to_dict("records")}
        return Result(document, lambda: print(*lines(rows), sep="\n"))


def _measure(scenario: Scenario, changes: int, show: Progress) -> list[dict[str, Any]]:
    """Return a row for each number of rays."""
    textures: list[np.ndarray] = []
    rows = []
    for spp in RAYS:
        world = _world(scenario, spp)
        attack = build_attack(world)
        assert isinstance(attack, GradientAttack)
        seconds = []
        for _ in range(ITERATIONS):
            begin = time.process_time()
            attack.step()
            seconds.append(time.process_time() - begin)
        if not textures:
            attack.finish()
            textures = attack.best
        random, values = np.random.default_rng(0), []
        for k in range(changes):
            show(f"{spp} rays", k + 1, changes, "")
            world.set_textures(
                [t + CHANGE * random.choice([-1, 1], t.shape) for t in textures]
            )
            values.append(attack.rollout.measure(attack.initial).value)
        mean, sd = statistics.mean(values), statistics.stdev(values)
        cost = statistics.median(seconds[1:])
        figures = {"objective": mean, "sd": sd, "iteration_cpu_s": cost}
        rows.append({"rays": spp, "changes": changes, **figures})
    return rows


def _world(scenario: Scenario, spp: int) -> World:
    scene = scenario.scene.model_copy(update={"spp": spp})
    changed = scenario.model_copy(update={"scene": scene})
    return build_world(changed, changed.build_policy())


def lines(rows: pd.DataFrame) -> list[str]:
    """Return the table, and the numbers of rays that are smooth at all places."""
    rows = rows.sort_values(["place", "rays"])
    share = (rows["sd"] / rows["objective"].abs()).rename("share")
    worst = share.groupby(rows["rays"]).max()
    smooth = [str(rays) for rays, most in worst.items() if most < SMOOTH]
    cost = rows.set_index(["place", "rays"])["iteration_cpu_s"].unstack()
    ratio = cost.div(cost[1], axis=0).median()
    table = [
        [row.place, str(row.rays), f"{row.objective:.4f}", f"{row.sd:.2g}", f"{s:.2%}"]
        for row, s in zip(rows.itertuples(), share, strict=True)
    ]
    head = ["place", "rays", "objective", "standard deviation", "share"]
    return [
        markdown(head, table),
        *(
            f"{rays} rays: at most {worst[rays]:.3%}; an iteration costs "
            f"{ratio[rays]:.2f} times that of 1 ray"
            for rays in worst.index
        ),
        f"smooth (below {SMOOTH:.1%} everywhere): {', '.join(smooth) or 'none'}",
    ]
