"""``python -m bench results``: make the rows of the studies, and their pages."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from os.path import relpath
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from bench.results import (
    command_of,
    data_folder,
    run_command,
    run_for_output,
    stamp,
)
from bench.studies.pages import write_pages
from bench.studies.plan import (
    ROOT,
    RUNS,
    State,
    Study,
    choose,
    done_labels,
    read_plan,
    state,
)
from bench.tables import markdown, number
from mi_nerfattack import variant
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.commands.shared.terminal import Result, say
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.summary import (
    SUMMARY,
    summarised_attacks,
    write_summary,
)
from mi_nerfattack.experiment.sweep.table import (
    MADE_OF,
    RESULTS,
    read_made,
    read_table,
)
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import json_digest

QUICK = "quick"
SHARE = 0.1  # of the rows that a check makes again
_DRIVE = ["cell", "environment", "case", "run"]
_ERROR = "cross_track_mean_m"


@dataclass(frozen=True)
class BenchResults:
    """Make the rows of the studies of bench/results.toml, their tables and pages.

    Each study calls sweep, transfer or retrain in runs/results/NAME, and the same
    command continues after Ctrl-C. At the end of a study its committed table and its
    page in docs/results/findings are written again.
    """

    continues: ClassVar[bool] = True

    only: tuple[str, ...] = ()
    """Names of studies; all without one."""
    list: bool = False
    """Print how many rows each study has, and the core-hours that are left."""
    check: bool = False
    """Make a random tenth of the finished rows again, and print the differences."""
    quick: bool = False
    """Make the smallest study (one town, one route, two seeds) as in a fresh clone,
    and compare it with the committed rows. No committed file changes."""
    pages: bool = False
    """Only write the pages of docs/results/findings again."""
    seed: int = 0
    """Of the rows that --check draws."""
    workers: int | None = None
    """Cells that are done at a time; by default one per core."""
    json: bool = False
    """Print one line of JSON instead of tables."""

    def run(self) -> Result:
        """Do what the options say."""
        if sum((self.list, self.check, self.quick, self.pages)) > 1:
            raise InputError("--list, --check, --quick, --pages: give one of them")
        variant.ensure()
        studies = choose((QUICK,) if self.quick else self.only)
        if self.list:
            return _listed(studies)
        if self.check:
            return self._checked(studies)
        if self.quick:
            return self._quick(studies[0])
        failed = [] if self.pages else [s.name for s in studies if not self._do(s)]
        written = write_pages()
        document = {"failed": failed, "pages": [str(path) for path in written]}
        return Result(document, lambda: print(*written, sep="\n"), int(bool(failed)))

    def _do(self, study: Study, take: bool = True) -> bool:
        """Make the rows of a study that are missing; False if a command failed."""
        try:
            _make_inputs(study)
            if study.grid is None:  # commands write files next to each other there
                files.make_folder(study.work)
            try:
                for words in self._words(study, take and study.take):
                    run_command(words)
            finally:  # also after Ctrl-C
                if take:
                    refresh(study)
            if take and study.report is not None:
                run_command(_split(study.report, study))
            return True
        except (SystemExit, InputError) as err:
            say(f"{study.name}: failed ({err}); give the same command again")
            return False

    def _words(self, study: Study, take: bool) -> Iterator[Sequence[str]]:
        for line in study.commands:
            yield _split(line, study)
        if study.grid is not None:
            words = ["sweep", str(ROOT / study.grid), "-o", str(study.work)]
            if take and (study.folder / RESULTS).exists():
                words += ["--take", str(study.folder)]
            if self.workers is not None:
                words += ["--workers", str(self.workers)]
            yield words

    def _quick(self, study: Study) -> Result:
        """Make the quick study without committed rows, and compare it with them."""
        fresh = study.model_copy(update={"name": _fresh_name(study.name)})
        done, work = self._do(fresh, take=False), fresh.work
        made = read_table(work / RESULTS)
        document = {"table": str(work / RESULTS), "cells": len(done_labels(made))}
        if (stored := study.read()) is not None:
            document |= differences(stored, made)
        own = {"table": str(work.relative_to(ROOT)), "finding": "attack"}
        pages = write_pages([study.model_copy(update=own)], work, work)
        document["pages"] = [str(path) for path in pages]
        lines = [f"{name}: {value}" for name, value in document.items()]
        return Result(document, lambda: print(*lines, sep="\n"), int(not done))

    def _checked(self, studies: Sequence[Study]) -> Result:
        """Make a tenth of each table again; the results are written next to it.

        A study that fails gets a row with the reason, and its check.json stays.
        """
        rows = {}
        for study in studies:
            table = study.read()
            if study.grid is None or table is None:
                continue
            try:
                row = _check_row(self._repeated(study, table), len(table), self.seed)
            except InputError as err:
                rows[study.name] = _check_row([], len(table), self.seed, error=str(err))
                continue
            rows[study.name] = row
            document = stamp(row, command_of("results", self))
            files.write_json(study.folder / "check.json", document)
        head = ["study", "rows again", "of", "largest difference (m)"]
        lines = [
            [name, str(row["rows"]), str(row["of"]), row["error"] or _shown(row)]
            for name, row in rows.items()
        ]
        failed = any(row["failed"] or row["error"] for row in rows.values())
        return Result(rows, lambda: print(markdown(head, lines)), int(failed))

    def _repeated(self, study: Study, table: pd.DataFrame) -> list[dict[str, Any]]:
        """Make the drawn cells of a study again, and return how each one differs."""
        _make_inputs(study)
        names = drawn_rows(table, SHARE, self.seed)
        place = RUNS / _fresh_name(f"check-{study.name}-{self.seed}", *names)
        words = ["reproduce", str(study.folder), *names, "--json", "-o", str(place)]
        if self.workers is not None:
            words += ["--workers", str(self.workers)]
        code, text = run_for_output(words)
        try:  # a failed cell ends it with 1, after the document
            return json.loads(text)["cells"]
        except ValueError as err:
            why = f"reproduce ended with {code}; its message is above"
            raise InputError(why) from err


def _make_inputs(study: Study) -> None:
    """Make the files that a study reads and that are missing."""
    for item in read_plan().inputs:
        if item.file in study.inputs and not (ROOT / item.file).exists():
            try:
                run_command(shlex.split(item.command))
            except SystemExit as err:
                why = f"{item.file}: {item.command!r} ended with {err.code}"
                raise InputError(why) from err


def _fresh_name(name: str, *rows: str) -> str:
    """Return the name of a folder that only these rows and this program use.

    A sweep takes the complete cells of its folder, also those of an older program.
    """
    return f"{name}-{json_digest([versions(), rows])[:12]}"


def refresh(study: Study) -> None:
    """Write the committed table of a study again from its folder of runs.

    A table is never replaced by one with fewer complete cells.
    """
    work = study.work
    if study.grid is not None:
        if not (work / RESULTS).exists():
            return
        counts = [
            len(done_labels(read_table(folder / RESULTS)))
            if (folder / RESULTS).exists()
            else 0
            for folder in (work, study.folder)
        ]
        if counts[0] < max(counts[1], 1):
            say(f"{study.name}: {counts[0]} cells; {study.table} has {counts[1]}")
            return
        write_summary(work, summarised_attacks(study.folder))
    names = (RESULTS, MADE_OF, SUMMARY) if study.grid else study.keep
    if names and all((work / name).exists() for name in names):
        for name in names:
            files.make_folder((study.folder / name).parent)
            if name == MADE_OF:
                files.write_json(study.folder / name, _portable_cells(study))
                continue
            raw = files.read_bytes(work / name, files.MAX_TENSOR_BYTES)
            files.write_bytes(study.folder / name, raw)


def _portable_cells(study: Study) -> dict[str, Any]:
    """Return what the cells of a study are made of, without paths of this machine.

    Paths of files in the checkout begin in the parent of the table's folder, as
    `reproduce` reads them.
    """
    made, root = read_made(study.work), relpath(ROOT, study.folder.parent)
    for record in made.values():
        record["scenario"] = record["scenario"].replace(f'"{ROOT}/', f'"{root}/')
    return made


def drawn_rows(table: pd.DataFrame, share: float, seed: int) -> list[str]:
    """Draw cells until a share of the complete rows is theirs.

    A row needs the attack of its cell, so that all rows of a drawn cell are made again.

    Args:
        table: of a sweep.
        share: of the complete rows, in (0, 1].
        seed: of the draw.

    Returns:
        One row of each drawn cell, as ``CELL:ENVIRONMENT:CASE:RUN``.
    """
    drives = table[table["status"] == "complete"]
    counts = drives["cell"].value_counts(sort=False)
    order = np.random.default_rng(seed).permutation(len(counts))
    before = np.cumsum(counts.to_numpy()[order]) - counts.to_numpy()[order]
    cells = counts.index[order[before < share * len(drives)]]
    first = drives.drop_duplicates("cell").set_index("cell").loc[cells].reset_index()
    return [":".join(map(str, row)) for row in first[_DRIVE].to_numpy()]


def differences(stored: pd.DataFrame, made: pd.DataFrame) -> dict[str, Any]:
    """Compare the mean errors of equal drives of two tables.

    Returns:
        ``compared``, the number of drives in both, and ``largest_m``, the largest
        difference of their mean errors; None without a drive in both.
    """
    sides = [
        table[table["status"] == "complete"].set_index(_DRIVE)[_ERROR]
        for table in (stored, made)
    ]
    apart = (sides[0] - sides[1]).abs().dropna()
    largest = float(apart.max()) if len(apart) else None
    return {"compared": len(apart), "largest_m": largest}


def _check_row(
    cells: Sequence[dict[str, Any]], of: int, seed: int, error: str | None = None
) -> dict[str, Any]:
    """Return a row of the check.

    Args:
        cells: of ``reproduce``.
        of: number of the table's rows.
        seed: of the draw.
        error: why the study was not checked.
    """
    known = [cell["largest_difference"] for cell in cells]
    errors = [largest[_ERROR] for largest in known if largest is not None]
    return {
        "seed": seed,
        "cells": [cell["cell"] for cell in cells],
        "rows": sum(cell["rows"] for cell in cells),
        "unmatched": sum(cell["unmatched"] for cell in cells),
        "of": of,
        "largest_m": max(errors, default=None),
        "failed": [cell["cell"] for cell in cells if cell["error"] is not None],
        "changed_versions": {cell["cell"]: cell["versions"] for cell in cells},
        "program": versions(),
        "error": error,
    }


def _listed(studies: Sequence[Study]) -> Result:
    states = {study.name: state(study) for study in studies}
    head = ["study", "question", "done", "as today", "core-hours left", "of one unit"]
    rows = [_list_row(study, states[study.name]) for study in studies]
    hours = sum(one.hours_left for one in states.values())
    total_hours = sum(states[one.name].wanted * one.core_hours for one in studies)
    left = f"{number(hours)} of {number(total_hours)} core-hours are left"
    text = f"{markdown(head, rows)}\n{left}"
    document = {
        name: asdict(one) | {"sources": sorted(one.sources)}
        for name, one in states.items()
    }
    return Result(
        document | {"hours_left": hours, "hours": total_hours}, lambda: print(text)
    )


def _list_row(study: Study, one: State) -> list[str]:
    done = f"{one.done}/{one.wanted}"
    current = "?" if one.current is None else str(one.current)
    each = f"{number(study.core_hours)}, {study.basis}"
    return [study.name, study.question, done, current, number(one.hours_left), each]


def _shown(row: dict[str, Any]) -> str:
    value = row["largest_m"]
    return "none compared" if value is None else f"{value:g}"


def _split(line: str, study: Study) -> list[str]:
    """Return the words of a command of a study.

    Raises:
        InputError: it reads the folder of NERFATTACK_DATA, which is not set.
    """
    if "{data}" in line:
        line = line.replace("{data}", shlex.quote(str(data_folder())))
    words = shlex.split(line.replace("{work}", shlex.quote(str(study.work))))
    return [name for word in words for name in _expanded(word)]


def _expanded(word: str) -> list[str]:
    """Return the paths that a word with ``*`` matches, or the word."""
    if "*" not in word:
        return [word]
    paths = sorted(str(path) for path in ROOT.glob(word))
    if not paths:
        raise InputError(f"{word}: no file; run the study that makes it before")
    return paths
