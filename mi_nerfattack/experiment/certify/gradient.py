"""The certificate of a gradient: what it predicts, and what whole drives do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.backend.determinism import deterministic, one_thread
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.drives.spec import short_digest
from mi_nerfattack.drives.table import write_csv
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.certificate import (
    LEAST_COSINE,
    SLOPES,
    Agreement,
    agreement,
)
from mi_nerfattack.experiment.certify.directions import (
    Ended,
    product,
    scenario_of,
)
from mi_nerfattack.experiment.certify.robustness import (
    DOCUMENT,
    PICTURE,
    SCHEMA,
    TABLE,
    OnStage,
    certificate_folder,
)
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit
from mi_nerfattack.report.plots.certificate import plot_gradient
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.system.workers import AbstractWork, AbstractWorkers, OnUnits, tally

FORMAT = "mi_nerfattack difference 1"
DIFFERENCES, DIFFERENCES_TABLE = "differences", "differences.csv"


class Measured(Record):
    """Record next to the changes along a direction; it holds nothing."""


@dataclass(frozen=True, eq=False)
class Differences(AbstractWork):
    """Changes of the objective along directions, a file each.

    Pieces are the random directions; the last piece is the direction of the gradient.

    Args:
        folder: of the files.
        run: folder of the attack.
        scenario: of the run.
        identity: what decides about all of them.
        directions: random ones.
        step: to each side, in units of the drawn directions, see `Ended.drawn`.
        ended: the attack of this process; another process takes it up itself.
    """

    folder: Path
    run: Path
    scenario: Scenario
    identity: Mapping[str, str]
    directions: int
    step: float
    ended: Ended | None

    def open(self) -> Ended:
        """Take up the attack, unless it is there."""
        return self.ended or Ended.of(self.run, self.scenario)

    def do(self, opened: Ended, index: int, report: OnUnits) -> None:
        """Predict and drive to both sides; a unit is a direction."""
        with one_thread(), deterministic(self.scenario.attack.deterministic):
            gradients = self.gradients(opened)
            random = index < self.directions
            drawn = opened.drawn(index) if random else opened.downhill(gradients[-1])
            change = {key: self.step * value for key, value in drawn.items()}
            predicted = [2 * product(gradient, change) for gradient in gradients]
            back = {key: -value for key, value in change.items()}
            real = opened.costs(change) - opened.costs(back)
        tensors = {"predicted": np.array(predicted), "real": real}
        self._unit(self._name(index)).write(tensors, Measured())
        report(1)

    def close(self, opened: Ended) -> None:
        """Let go of nothing."""
        del opened

    def gradients(self, opened: Ended) -> list[dict[str, np.ndarray]]:
        """Return the gradient of each horizon; computed once for all processes."""
        unit, horizons = self._unit("gradients"), opened.horizons
        content = unit.read()
        if content is None:
            files.make_folder(self.folder)
            gradients = [opened.gradient(horizon) for horizon in horizons]
            named = zip(horizons, gradients, strict=True)
            tensors = {f"{h}.{k}": v for h, one in named for k, v in one.items()}
            unit.write(tensors, Measured())
            content = unit.read()
            assert content is not None, "it was written"
        keys = opened.drawn(0)
        return [{key: content.tensors[f"{h}.{key}"] for key in keys} for h in horizons]

    def read(self, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return predicted and real changes (horizons,); None where there are none."""
        content = self._unit(self._name(index)).read()
        return (
            None
            if content is None
            else (content.tensors["predicted"], content.tensors["real"])
        )

    def remove_others(self, count: int) -> None:
        """Remove files of other runs and steps, and of further directions."""
        names = ["gradients", *(self._name(index) for index in range(count))]
        paths = {self._unit(name).path for name in names}
        for path in self.folder.glob("*.safetensors"):
            if path not in paths:
                path.unlink()

    def _name(self, index: int) -> str:
        return f"direction_{index:04d}" if index < self.directions else "along"

    def _unit(self, name: str) -> Unit[Measured]:
        identity = {"format": FORMAT, **self.identity, "piece": name}
        path = self.folder / f"{name}-{short_digest(identity)}.safetensors"
        return Unit(path, identity, Measured, remedy="remove the file")

    def __getstate__(self) -> dict[str, Any]:
        """Leave the attack behind, whose world no process can send."""
        return {**self.__dict__, "ended": None}


def certify_gradient(
    run: Path,
    output: Path,
    directions: int,
    step: float,
    workers: AbstractWorkers,
    on_stage: OnStage = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Compare the gradient at the end of an attack with differences of whole drives.

    Args:
        run: folder of a finished attack by a gradient.
        output: folder, which keeps finished differences.
        directions: random ones, at least 3.
        step: standard deviation of the changes, see `Ended.drawn`.
        workers: who drives.
        on_stage: called with a stage, units done and all units.

    Returns:
        the document that ``certificate.json`` holds.

    Raises:
        InputError: a number is out of range; as of `Ended.of`; or another process works
            in the folder.
    """
    if directions < 3 or not step > 0:
        raise InputError(
            f"--directions, --step: {directions}, {step}; at least 3, and more than 0"
        )
    scenario = scenario_of(run)
    with certificate_folder(output, DIFFERENCES, DIFFERENCES_TABLE):
        ended = Ended.of(run, scenario)
        identity = {**versions(), **scenario.identity(), "step": f"{step}"}
        identity["best"] = ended.digest
        count = directions + 1
        work = Differences(
            folder=output / DIFFERENCES,
            run=run,
            scenario=scenario,
            identity=identity,
            directions=directions,
            step=step,
            ended=ended,
        )
        on_stage("differentiating", 0, 1)
        with one_thread(), deterministic(scenario.attack.deterministic):
            work.gradients(ended)
        on_stage("differentiating", 1, 1)
        left = [index for index in range(count) if work.read(index) is None]

        def progress(done: int, total: int) -> None:
            on_stage("driving to both sides", done, total)

        workers.run(work, left, tally(progress, count - len(left), count))
        work.remove_others(count)
        document = _document(work, ended)
        _write(output, document)
    return document


def _document(work: Differences, ended: Ended) -> dict[str, Any]:
    """Summarise differences."""
    changes = [work.read(index) for index in range(work.directions + 1)]
    if any(item is None for item in changes):
        raise InputError(f"{work.folder}: a difference is missing; it was removed")
    predicted, real = np.array(changes).transpose(1, 2, 0)  # (horizons, directions + 1)
    dt, rows = ended.world.scenario.vehicle.dt_s, []
    for number, horizon in enumerate(ended.horizons):
        p, r = predicted[number], real[number]
        both = agreement(p[:-1], r[:-1])
        # There is nothing to judge, for example before an object comes into view.
        unchanged = not p.any() and not r.any()
        rows.append(
            {
                "periods": horizon,
                "time_s": horizon * dt,
                **({} if both is None else _figures(both)),
                "is_true": None if unchanged else both is not None and both.is_true,
                "along_predicted": float(p[-1]),
                "along_real": float(r[-1]),
                "predicted": p[:-1].tolist(),
                "real": r[:-1].tolist(),
            }
        )
    scenario = ended.world.scenario
    document = {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "seed": scenario.seed,
        "method": scenario.attack.method.kind,
        "attached": scenario.attack.attached,
        "levels": "all",
        "attack_one_level": ended.attack.one_level,
        "attack_follow": ended.attack.plan.follow,
        "directions": work.directions,
        "step": work.step,
        "true_until_s": _true_until_s(rows),
        "rows": rows,
    }
    return document | {"flags": _flags(document)}


def _true_until_s(rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the last true horizon before an untrue one; skip those without changes."""
    until = 0.0
    for row in rows:
        if row["is_true"] is False:
            break
        if row["is_true"]:
            until = row["time_s"]
    return until


def _figures(both: Agreement) -> dict[str, Any]:
    """Return an agreement in JSON types."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(both).items()}


def _flags(document: Mapping[str, Any]) -> list[str]:
    """Say where the gradient is untrue."""
    rows, until = document["rows"], document["true_until_s"]
    end = rows[-1]["time_s"]
    if all(row["is_true"] is None for row in rows):
        return [
            f"in {end:g} s, neither the gradient nor the drives change the objective, "
            "so there is nothing to judge; take a longer horizon"
        ]
    if all(row["is_true"] is not False for row in rows):
        return []
    low, high = SLOPES
    where = f"up to {until:g} s of {end:g} s" if until else "over no part of the drive"
    why = ""
    if not document["attached"]:
        why = (
            "; attack.attached is false, so the gradient leaves out that images "
            "follow the vehicle"
        )
    return [
        f"the gradient predicts the objective {where}; elsewhere its cosine may be "
        f"below {LEAST_COSINE:g}, or its slope is not from {low:g} to {high:g}{why}"
    ]


def _write(output: Path, document: Mapping[str, Any]) -> None:
    table, changes = [], []
    for row in document["rows"]:
        flat = {k: v for k, v in row.items() if k not in ("predicted", "real")}
        for name in ("slope", "cosine"):
            ends = flat.pop(f"{name}_ci95", (None, None))
            flat[f"{name}_low"], flat[f"{name}_high"] = ends
        table.append(flat)
        pairs = zip(
            [*row["predicted"], row["along_predicted"]],
            [*row["real"], row["along_real"]],
            strict=True,
        )
        for number, (predicted, real) in enumerate(pairs):
            labels = {"direction": number, "periods": row["periods"]}
            changes.append(labels | {"predicted": predicted, "real": real})
    write_csv(output / TABLE, pd.DataFrame(table))
    write_csv(output / DIFFERENCES_TABLE, pd.DataFrame(changes))
    plot_gradient(output / PICTURE, document)
    files.write_json(output / DOCUMENT, document)


def sentences(document: Mapping[str, Any]) -> Sequence[str]:
    """Say in words what a certificate found."""
    said = [f"flag: {line}" for line in document["flags"]] or [
        "The gradient predicts the objective at all horizons with changes, up to "
        f"{document['true_until_s']:g} s."
    ]
    if document["attack_one_level"]:
        said.append(
            "The attack stepped along the gradient of one level; this one is of all "
            "levels."
        )
    if document["attached"] and document["attack_follow"] != "always":
        said.append(
            "Not all gradients of the attack were attached, see method.follow; this "
            "one is."
        )
    return said
