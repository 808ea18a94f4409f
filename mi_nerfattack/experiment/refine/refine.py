"""Search around a found attack in a deployment environment, and drive what it gave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from mi_nerfattack.attack.black_box.bayesian import MOST
from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.prior import PriorJudge, PriorSearch
from mi_nerfattack.attack.black_box.search import BlackBoxAttack, Proposal
from mi_nerfattack.attack.texture.colours import Colours, vertex_colours
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.registry import environment_versions
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.intervals import mean_interval
from mi_nerfattack.experiment.refine.judge import EnvironmentJudge
from mi_nerfattack.experiment.run_folder import object_path
from mi_nerfattack.experiment.transfer.columns import Column, Condition
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.experiment.transfer.run import DRIVES, check_output, run_transfer
from mi_nerfattack.experiment.transfer.work import TransferWork
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.resumable import Record, Unit, flatten
from mi_nerfattack.ranges import Count, Positive, Seed, checked
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import World, build_world
from mi_nerfattack.system.workers import AbstractWorkers

DOCUMENT, SEARCH, UNSEEN = "refine.json", "search.safetensors", "unseen"
FORMAT = "mi_nerfattack refine 1"
REFINED = "refined"
_SEED = 1  # of unseen starts, as of transfer
_REMEDY = "choose another folder with -o, or remove this file"

#: Called with drives done and wanted.
OnDrives = Callable[[int, int], None]


class _NoRecord(Record):
    """Nothing beside the tensors."""


@dataclass(frozen=True, eq=False)
@checked("refine")
class Refinement:
    """What is searched, where, and how long.

    Args:
        found: the attack.
        column: where it is to work.
        drives: budget, there.
        starts: drives of each case and environment at the end.
        prior: whether drives in the surrogate guide them.
        candidates: textures that the surrogate judges before each proposal.
        coefficients: of all objects, at most.
        reach: largest change of colours from the attack's, sRGB.
        seed: of all draws.

    Raises:
        InputError: a number is out of range, the column is the surrogate's or one that
            the vehicle cannot drive in, the attack may not change textures, or starts
            do not vary.
    """

    found: FoundAttack
    column: Column
    drives: Count = 32
    starts: Count = 8
    prior: bool = True
    candidates: Count = 16
    coefficients: Annotated[int, Field(ge=1, le=MOST)] = MOST
    reach: Positive = 0.25
    seed: Seed = 0

    def __post_init__(self) -> None:
        """Check what the types do not."""
        if self.column.environment == SURROGATE:
            raise InputError(
                "--environment: surrogate, in which the attack was made; give another"
            )
        self.column.check(self.found.scenario)
        if self.found.scenario.attack.freedom.build().texture_rate is None:
            raise InputError(
                f"{self.found.folder}: its scenario lets textures alone "
                "(attack.parameters); there is nothing to refine"
            )
        self.found.check_starts(_SEED, self.starts)

    @property
    def poses(self) -> int:
        """Drives of a judgement."""
        return self.found.scenario.attack.poses

    @property
    def expected_drives(self) -> int:
        """Of the whole search, those in the surrogate included."""
        judged = -(-self.drives // self.poses)
        guessed = 1 + self.candidates * (judged - 1) if self.prior else 0
        return self.poses * (judged + guessed)

    def identity(self) -> dict[str, str]:
        """Return all that decides about a search but its length."""
        names = {**versions(), **environment_versions(self.column.name)}
        options = {
            "prior": self.prior,
            "candidates": self.candidates,
            "coefficients": self.coefficients,
            "reach": self.reach,
            "seed": self.seed,
            "found": self.found.digest,
            "column": self.column.identity(),
        }
        return {
            "format": FORMAT,
            **{f"version.{name}": value for name, value in names.items()},
            **flatten("refine", options),
            **self.found.identity,
        }


@dataclass(eq=False)
class _Guesses:
    """What the prior said, in order; what is known already is not driven again."""

    judge: PriorJudge
    known: list[float] = field(default_factory=list)
    _next: int = 0

    def __call__(self, proposal: Proposal) -> float:
        if self._next == len(self.known):
            self.known.append(self.judge(proposal))
        self._next += 1
        return self.known[self._next - 1]


def refine(
    task: Refinement,
    output: Path,
    workers: AbstractWorkers,
    progress: Callable[[str], OnDrives] = lambda stage: lambda done, total: None,
) -> dict[str, Any]:
    """Search, keep what was best, and drive past it from starts that no run has seen.

    Args:
        task: see there.
        output: folder; one of the same search goes on.
        workers: who does the drives from unseen starts.
        progress: gives a function of what is done and wanted for a stage.

    Returns:
        the document that ``refine.json`` holds.

    Raises:
        InputError: the folder is of a run, in use or of another search, or whatever a
            drive raises.
    """
    check_output(output)
    with locks.exclusive(output):
        locks.remove_partial(output)
        world = build_world(task.found.scenario, task.found.scenario.policy.build())
        attack, guesses, scale = _search(task, world, output, progress("searching"))
        assert attack.best is not None  # at least one drive
        _save_objects(task, world, attack.best, output)
        frames, objective, means = attack.curve().T
        document = {
            "schema": 1,
            "run": task.found.label,
            "found_sha256": task.found.digest,
            "environment": task.column.environment,
            "drives": task.poses * len(attack.history),
            "surrogate_drives": task.poses * guesses,
            "prior_scale": scale if task.prior else None,
            "curve": {
                "frames": frames.astype(int).tolist(),
                "objective": objective.tolist(),
                "cross_track_mean_m": means.tolist(),
            },
        }
        document["unseen"] = _drive_unseen(
            task, output, workers, progress("driving from unseen starts")
        )
        files.write_json(output / DOCUMENT, document)
    return document


def _search(
    task: Refinement, world: World, output: Path, progress: OnDrives
) -> tuple[BlackBoxAttack, int, float]:
    """Return the finished search, judgements of the prior, and its last scale."""
    done = 0

    def on_drive() -> None:
        nonlocal done
        done += 1
        progress(done, task.expected_drives)

    surrogate = Column(SURROGATE, Condition(), task.column.spp)
    judges = [
        EnvironmentJudge(world, task.found, column, on_drive)
        for column in (task.column, surrogate)
    ]
    guesses = _Guesses(judges[1].guess)
    search = PriorSearch(
        _basis(task, world),
        guesses if task.prior else None,
        task.reach,
        task.candidates,
        task.seed,
    )
    attack = BlackBoxAttack(search, judges[0], task.drives * world.horizon)
    unit = Unit(output / SEARCH, task.identity(), _NoRecord, _REMEDY)
    try:
        if (kept := unit.read()) is not None:
            guesses.known = kept.tensors["guesses"].tolist()
            attack.load_tensors(kept.tensors)
            done = task.poses * (len(attack.history) + len(guesses.known))
        while not attack.is_over:
            attack.step()
            known = np.array(guesses.known, np.float64)
            unit.write({**attack.tensors(), "guesses": known}, _NoRecord())
    finally:
        for judge in judges:
            judge.close()
    return attack, len(guesses.known), search.scale


def _basis(task: Refinement, world: World) -> LowFrequency:
    """Return changes of the attack's colours, within what it may change."""
    freedom = task.found.scenario.attack.freedom.build()
    colourings = [freedom.colouring(grid) for grid in world.fields]
    colourings = [item for item in colourings if isinstance(item, Colours)]  # all are
    world.show(task.found.looks(world)[ATTACK])
    middle = [
        vertex_colours(grid, colouring.level).clip(1e-4, 1 - 1e-4)
        for grid, colouring in zip(world.fields, colourings, strict=True)
    ]
    return LowFrequency(colourings, task.coefficients, middle)


def _save_objects(
    task: Refinement, world: World, textures: list[np.ndarray], output: Path
) -> None:
    world.set_textures(textures)
    for grid, item in zip(world.fields, task.found.scenario.objects, strict=True):
        path = object_path(output, item.id)
        files.make_folder(path.parent)
        save_field(path, grid)


def _drive_unseen(
    task: Refinement,
    output: Path,
    workers: AbstractWorkers,
    progress: OnDrives,
) -> list[dict[str, Any]]:
    """Drive past both attacks as `transfer` does; a row an environment."""
    refined = task.found.with_objects(output, REFINED)
    surrogate = Column(SURROGATE, Condition(), task.column.spp)
    folder = output / UNSEEN
    files.make_folder(folder)
    work = TransferWork(
        (task.found, refined),
        (surrogate, task.column),
        (NO_OBJECT, ATTACK),
        task.starts,
        _SEED,
        folder / DRIVES,
    )
    rows = run_transfer(work, folder, workers, progress)["rows"]
    return [_compared(rows[k], rows[k + 2]) for k in range(2)]


def _compared(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Set the two attacks of one environment side by side, paired by start."""
    found, refined = before["cases"][ATTACK], after["cases"][ATTACK]
    pairs = zip(refined["per_run"], found["per_run"], strict=True)
    gains = [a["cross_track_mean_m"] - b["cross_track_mean_m"] for a, b in pairs]
    return {
        "environment": before["environment"],
        NO_OBJECT: before["cases"][NO_OBJECT],
        "found": found,
        REFINED: refined,
        "difference_m": float(np.mean(gains)),
        "difference_ci95_m": mean_interval(np.array(gains), _SEED),
    }
