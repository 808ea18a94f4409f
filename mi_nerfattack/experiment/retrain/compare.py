"""Before and after: attacks on a policy driven again with the one retrained on some."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from mi_nerfattack.drives.store import Store
from mi_nerfattack.drives.table import write_csv
from mi_nerfattack.experiment.run_folder import SCENARIO
from mi_nerfattack.experiment.transfer.columns import make_columns
from mi_nerfattack.experiment.transfer.figures import (
    DRIVES,
    check_output,
    drives_of,
    run_transfer,
)
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.experiment.transfer.work import TransferDrives
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.system.workers import AbstractWorkers

OLD, HELD_OUT, ADAPTIVE = "old", "held_out", "adaptive"
BEFORE, AFTER = "before", "after"
_CASES = (NO_OBJECT, ATTACK)
_SEED = 1

#: Called with control periods done and wanted.
OnSteps = Callable[[int, int], None]
#: `transfer.json` by group.
Documents = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Comparison:
    """Drives past attacks and without objects, from starts that no run has seen.

    Args:
        groups: attacks by `OLD` and `HELD_OUT`.
        environments: see `transfer.columns.ENVIRONMENTS`.
        starts: drives of each attack, case and environment.
        spp: samples per pixel of path-traced images.
        folder: gets a folder of `mi-nerfattack transfer` for each group and stage.
    """

    groups: Mapping[str, Sequence[FoundAttack]]
    environments: tuple[str, ...]
    starts: int
    spp: int
    folder: Path

    def work(self, group: str, stage: str, policy: str = "") -> TransferDrives:
        """Describe the drives of a group; InputError for starts that a run has seen.

        Args:
            group: of attacks.
            stage: `BEFORE` or `AFTER`.
            policy: that drives, see :func:`with_policy`; the attacked one by default.
        """
        attacks = [
            with_policy(attack, policy) if policy else attack
            for attack in self.groups[group]
        ]
        columns = make_columns(self.environments, ("day",), self.spp)
        store = Store(self._output(group, stage) / DRIVES)
        return TransferDrives(
            store,
            tuple(attacks),
            columns,
            cases=_CASES,
            starts=self.starts,
            seed=_SEED,
        )

    def drive(
        self,
        stage: str,
        workers: AbstractWorkers,
        progress: Callable[[str], OnSteps],
        policy: str = "",
    ) -> dict[str, dict[str, Any]]:
        """Do the drives that are not there yet; return `transfer.json` by group."""
        documents = {}
        for group in self.groups:
            output = self._output(group, stage)
            check_output(output)
            work = self.work(group, stage, policy)
            show = progress(f"{stage}, {group}")
            documents[group] = run_transfer(work, output, workers, progress=show)
        return documents

    def _output(self, group: str, stage: str) -> Path:
        return self.folder / f"{group}_{stage}"


def with_policy(attack: FoundAttack, policy: str) -> FoundAttack:
    """Let another policy drive past what was found.

    Args:
        attack: that was found.
        policy: key and value that replace those of its scenario, as of ``--set``; see
            `new_policy.setting`.

    Raises:
        InputError: the scenario with this policy is not usable.
    """
    scenario, _ = read_with_policy(attack, policy)
    return replace(attack, scenario=scenario, identity=scenario.identity())


def read_with_policy(attack: FoundAttack, policy: str) -> tuple[Scenario, str]:
    """Read the scenario of :func:`with_policy`; return its text, too."""
    return load_scenario(attack.folder / SCENARIO, settings=(policy,))


def write_comparison(
    path: Path, document: dict[str, Any], before: Documents, after: Documents
) -> None:
    """Write the result of a retraining, and the drives behind its table.

    Args:
        path: of the result, ``NAME-retrain.json``. The drives are written to
            ``NAME-retrain.csv``, one row each: `group`, `policy` (`BEFORE` or `AFTER`)
            and the columns of `transfer.figures.TABLE`.
        document: other keys of the result; gets `table`, see :func:`table_rows`.
        before: of the drives before the retraining.
        after: of the drives after the retraining.
    """
    document["table"] = table_rows(before, after)
    tables = []
    for policy, documents in ((BEFORE, before), (AFTER, after)):
        for group, of_group in documents.items():
            drives = drives_of(of_group)
            drives.insert(0, "group", group)
            drives.insert(1, "policy", policy)
            tables.append(drives)
    write_csv(path.with_suffix(".csv"), pd.concat(tables))
    files.write_json(path, document)


def table_rows(before: Documents, after: Documents) -> list[dict[str, Any]]:
    """Write both stages into one table.

    Args:
        before: of the drives before the retraining.
        after: of the drives after the retraining.

    Returns:
        one row per group and environment: figures by stage and case, as in the columns
        of `transfer.json`, and two ratios of mean errors. ``attack_to_clean``, by
        stage: the error with attacks as a multiple of the error without objects.
        ``clean_ratio``: the error without objects after the retraining, as a multiple
        of the error before. A multiple of 0 m is None.
    """
    rows = []
    for group, first in before.items():
        for old, new in zip(first["columns"], after[group]["columns"], strict=True):
            stages = {BEFORE: old["cases"], AFTER: new["cases"]}
            clean, attack = (
                {k: cases[case]["cross_track_mean_m"] for k, cases in stages.items()}
                for case in _CASES
            )
            rows.append(
                {
                    "group": group,
                    "environment": old["environment"],
                    "attacks": old["attacks"],
                    **stages,
                    "attack_to_clean": {k: _ratio(attack[k], clean[k]) for k in stages},
                    "clean_ratio": _ratio(clean[AFTER], clean[BEFORE]),
                }
            )
    return rows


def _ratio(error_m: float, reference_m: float) -> float | None:
    return error_m / reference_m if reference_m else None
