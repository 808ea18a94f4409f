"""What a page of results is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_nerfattack.report.pages.scrubber import Scrubber
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT, RANDOM

#: Cases that stand beside each other.
SHOWN_CASES = (NO_OBJECT, RANDOM, ATTACK)
#: Sections of a page that have pictures of each run, with what the folder may lack.
ABOVE, COST, SEEN, TEXTURES, WHEN = "above", "cost", "seen", "textures", "when"


@dataclass(frozen=True, eq=False)
class RunPart:
    """A finished run, as a page shows it.

    Attributes:
        label: that tells it from the others.
        document: as of `metrics.metrics_document`, with all that follows.
        scenario: the scenario file as run.
        made_with: version of each program by its name.
        digests: SHA-256 of files by their keys.
        repeat: the command that makes the run again.
        pictures: image files by title, by section.
        scrubbers: by section.
        missing: by section, why there is nothing, and what makes it.
    """

    label: str
    document: Mapping[str, Any]
    scenario: str
    made_with: Mapping[str, str]
    digests: Mapping[str, str]
    repeat: str
    pictures: Mapping[str, Mapping[str, Path]]
    scrubbers: Mapping[str, Sequence[Scrubber]]
    missing: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class SweepPart:
    """A sweep.

    Attributes:
        label: that tells it from the others.
        document: as of `sweep.summary.summarise`.
        attacks: a row for each cell and environment: labels, figures by case, and the
            command that repeats it.
        shown: of each route and method the cell of middle damage.
        pictures: image files by title.
        notes: what is missing, and what makes it.
    """

    label: str
    document: Mapping[str, Any]
    attacks: Sequence[Mapping[str, Any]]
    shown: Sequence[RunPart]
    pictures: Mapping[str, Path]
    notes: Sequence[str]


@dataclass(frozen=True, eq=False)
class TransferPart:
    """A transfer.

    Attributes:
        label: that tells it from the others.
        document: whole, as of `transfer.figures.make_document`.
        quality: plot against the quality of surrogates, None without.
    """

    label: str
    document: Mapping[str, Any]
    quality: Path | None


@dataclass(frozen=True, eq=False)
class RetrainPart:
    """A retraining.

    Attributes:
        label: that tells it from the others.
        document: with `table`, of `retrain.compare.table_rows`.
    """

    label: str
    document: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Parts:
    """All that a page shows.

    Attributes:
        runs: that were named one by one.
        sweeps: likewise.
        transfers: likewise.
        retrainings: likewise.
        damage: plots of several attacks by title.
    """

    runs: Sequence[RunPart] = ()
    sweeps: Sequence[SweepPart] = ()
    transfers: Sequence[TransferPart] = ()
    retrainings: Sequence[RetrainPart] = ()
    damage: Mapping[str, Path] = field(default_factory=dict)

    @property
    def shown(self) -> list[RunPart]:
        """Runs of which there are pictures: all that were named, some of each sweep."""
        return [*self.runs, *(run for sweep in self.sweeps for run in sweep.shown)]
