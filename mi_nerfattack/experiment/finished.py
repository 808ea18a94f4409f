"""What a run came to: in memory, before anything is written, and in its folder."""

from __future__ import annotations

import base64
import html
import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from PIL import Image

from mi_nerfattack.attack.base import AbstractAttack
from mi_nerfattack.evaluation.metrics import drives_of_run
from mi_nerfattack.experiment.run_folder import read_finished
from mi_nerfattack.report.table import metrics_table
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.scenario.world import Appearance, World

#: Which frames of a drive become files: see :func:`pictures.frames.frame_steps`.
Frames = Literal["all", "worst"] | int
_WIDTH = 100  # characters of the table in a notebook


@dataclass(frozen=True)
class Finished:
    """What a run came to.

    Attributes:
        world: of all drives; functions that show a case change its textures.
        drives: all drives.
        attack: the finished attack.
        looks: by case, the appearance and place of the objects; None: no objects.
        ignored: changes between interruption and resumption that were ignored.
        baseline: figures of the random textures.
        flags: findings of the checks before the attack.
    """

    world: World
    drives: list[Drive]
    attack: AbstractAttack
    looks: Mapping[str, Appearance | None]
    ignored: list[str]
    baseline: dict[str, Any]
    flags: list[str]

    def look(self, case: str) -> Appearance:
        """Return how the objects look in a case that has any."""
        look = self.looks[case]
        assert look is not None, "objects are there"
        return look

    @property
    def history(self) -> list[dict[str, Any]]:
        """Rows for ``attack.json``, one per iteration.

        Without gains where changes were ignored, as :attr:`curve`.
        """
        rows, gains = self.attack.rows(), ("predicted_gain", "gain")
        if not self.ignored:
            return rows
        return [{k: v for k, v in row.items() if k not in gains} for row in rows]

    @property
    def curve(self) -> dict[str, list[float]] | None:
        """What the attack had found after how many frames, for ``metrics.json``.

        None where changes were ignored: then its objectives may have several units.
        """
        if self.ignored:
            return None
        multiple = self.baseline["backward_multiple"]
        frames, objectives, means = self.attack.curve(multiple).T
        return {
            "frames": np.rint(frames).astype(int).tolist(),
            "objective": objectives.tolist(),
            "cross_track_mean_m": means.tolist(),
        }

    @property
    def replayed(self) -> list[Drive]:
        """The drives of recordings."""
        return [d for d in self.drives if self.world.is_open_loop(d.environment)]

    @property
    def driven(self) -> list[Drive]:
        """The drives in closed loops."""
        return [d for d in self.drives if not self.world.is_open_loop(d.environment)]

    @cached_property
    def costs(self) -> dict[Drive, float | None]:
        """The scenario's objective of each drive in a closed loop, by itself.

        Neither the reduction over poses nor penalties on textures are in it. None where
        it has no value, of which `uncosted` says why.
        """
        pairs = self._costs_or_reasons.items()
        return {k: None if isinstance(v, str) else v for k, v in pairs}

    @cached_property
    def uncosted(self) -> dict[str, str]:
        """Environments in which the objective of a drive has no value, and why."""
        reasons = dict(self._other_models)
        for drive, reason in self._costs_or_reasons.items():
            if isinstance(reason, str):
                reasons.setdefault(drive.environment, reason)
        return reasons

    @cached_property
    def _costs_or_reasons(self) -> dict[Drive, float | str]:
        return {drive: self._cost(drive) for drive in self.driven}

    def _cost(self, drive: Drive) -> float | str:
        """Return the objective of a drive, or why there is none."""
        world, size = self.world, self.world.motion.dynamics.state_size
        states = drive.states[1:]
        if reason := self._other_models.get(drive.environment):
            return reason
        if len(states) != world.horizon:
            return "a drive ended before the others"
        if not world.scenario.objective.reads_all_rows:
            states = drive.poses[1:]
        elif states.shape[1] < size:
            return (
                f"an older version recorded {states.shape[1]} of the state's {size} "
                "rows; remove the folder drives, and give the command again"
            )
        dt = world.scenario.vehicle.dt_s
        cost = float(world.objective.costs(states[None, :, :size], dt)[0])
        return cost if np.isfinite(cost) else f"it is {cost} for a drive"

    @cached_property
    def _other_models(self) -> dict[str, str]:
        """Environments whose vehicle lacks what the objective reads, and why."""
        world = self.world
        size, section = world.motion.dynamics.state_size, world.scenario.objective
        if size == 3 or not section.reads_all_rows:
            return {}
        return {
            label: f"the vehicle there is not the scenario's model, whose {size} rows "
            "of the state the objective takes"
            for label, deployment in world.deployments.items()
            if not (deployment.moves_by_model or deployment.is_open_loop)
        }

    @property
    def lane(self) -> Lane:
        """Of the route."""
        return Lane.of(self.world.route, self.world.scenario.vehicle.width_m)


@dataclass(frozen=True)
class Run:
    """A finished attack.

    Args:
        folder: the run folder, with pictures, drives and the attacked fields.

    Raises:
        InputError: the folder holds no finished run, or its ``metrics.json`` is
            damaged.
    """

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))
        _ = self.metrics

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        return read_finished(self.folder)

    @cached_property
    def drives(self) -> pd.DataFrame:
        """A table with one row per drive, see `metrics.drives_of_run`."""
        return drives_of_run(self.metrics)

    @property
    def frames(self) -> list[Path]:
        """The files of all frames, by environment and case, in the order of time."""
        return sorted((self.folder / "frames").glob("*/*.png"))

    def plot(self) -> Image.Image:
        """Draw the first drives from above; InputError if a file is missing."""
        from mi_nerfattack.experiment.page.run import draw_above  # it loads plots

        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "overhead.png"
            draw_above(path, [self.folder])
            with Image.open(path) as image:
                return image.convert("RGB")

    def _repr_html_(self) -> str:
        """Show the verdict, the table and the drives from above, in a notebook."""
        from rich.console import Console

        console = Console(record=True, file=io.StringIO(), width=_WIDTH, markup=False)
        console.print(metrics_table(self.metrics))
        layout = '<pre style="line-height: 1.2">{code}</pre>'
        table = console.export_html(inline_styles=True, code_format=layout)
        sentences = "".join(f"<p>{html.escape(s)}</p>" for s in self.metrics["verdict"])
        overhead = self.folder / "overhead.png"  # missing where frames is None
        image = ""
        if overhead.is_file():
            data = base64.b64encode(overhead.read_bytes()).decode()
            image = f'<img width="600" src="data:image/png;base64,{data}">'
        return f"<div>{sentences}{table}{image}</div>"
