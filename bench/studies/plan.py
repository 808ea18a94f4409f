"""Read bench/results.toml, and count which rows of each study exist."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import Field, ValidationError, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.grid import GridReader, Label, load_cells
from mi_nerfattack.experiment.sweep.table import (
    LABELS,
    MADE_OF,
    RESULTS,
    read_made,
    read_table,
)
from mi_nerfattack.io import files
from mi_nerfattack.io.overrides import tell
from mi_nerfattack.ranges import Count, Positive
from mi_nerfattack.scenario.section import Section, problems, refuse

ROOT = Path(__file__).resolve().parents[2]
PLAN = ROOT / "bench/results.toml"
#: Folder of the runs, which git ignores and `make clean` keeps.
RUNS = ROOT / "runs/results"

#: Source of rows that are older than its stamp.
UNKNOWN = "unknown"


class Input(Section):
    """A file that studies read and one command makes."""

    file: str
    command: str


class Study(Section):
    """A study: a grid or a list of commands, its committed table, and its page.

    All paths start in the root of the checkout. In commands, ``{work}`` is the folder
    of the study's runs.
    """

    name: Label
    question: str
    table: str  # folder with the committed rows
    grid: str | None = None
    take: bool = True  # committed rows; false if other studies need their run folders
    commands: tuple[str, ...] = ()  # instead of a grid
    keep: tuple[str, ...] = ()  # files of {work} that the table's folder gets
    rows: str = RESULTS  # table (.csv) in `table`, or a pattern of result files
    unit: str = (
        "cell"  # column of the table; each of its values, or a file, counts as one
    )
    cells: Count | None = None  # how many units there will be; a grid says it itself
    core_hours: Positive  # of one unit
    basis: str  # how we know core_hours
    inputs: tuple[str, ...] = ()  # files of [[inputs]]
    reads: tuple[str, ...] = ()  # names of studies whose runs the commands read
    report: str | None = None  # command that writes the figures of a page
    pages: tuple[str, ...] = ()  # that quote the table
    finding: str | None = None  # name of the page in docs/results/findings
    threats: tuple[str, ...] = ()
    note: str = ""  # one more sentence of the page

    @model_validator(mode="after")
    def _check_work(self) -> Any:
        """Refuse a study that has both or none of a grid and a number of units."""
        if (self.grid is None) == (self.cells is None):
            refuse("grid", "give a grid, or cells, the number of units")
        return self

    @property
    def units(self) -> str:
        """What a unit is, in the plural."""
        return "attacks" if self.unit == "cell" else f"{self.unit}s"

    @property
    def folder(self) -> Path:
        """The folder of the committed table."""
        return ROOT / self.table

    @property
    def work(self) -> Path:
        """The folder of the runs."""
        return RUNS / self.name

    def read(self) -> pd.DataFrame | None:
        """Return the committed rows; None if there is no table of them."""
        path = self.folder / self.rows
        if path.suffix != ".csv" or not path.exists():
            return None
        return read_table(path) if self.grid else pd.read_csv(path)


class Plan(Section):
    """The content of bench/results.toml."""

    inputs: tuple[Input, ...] = ()
    studies: tuple[Study, ...] = Field(min_length=1)


@dataclass(frozen=True)
class State:
    """How far a study is.

    Attributes:
        done: units that the committed table has.
        wanted: units in all.
        current: units of `done` that today's program would make of equal files and
            settings; None where nobody can say, because an input file is missing.
        sources: versions of the source that made the rows; `UNKNOWN` is one of them.
        hours_left: core-hours of the units that are not current; of those that are
            not done where nobody can say.
    """

    done: int
    wanted: int
    current: int | None
    sources: frozenset[str]
    hours_left: float


@cache
def read_plan(path: Path = PLAN) -> Plan:
    """Read the studies.

    Raises:
        InputError: a key is wrong, with file and line.
    """
    try:
        return Plan.model_validate(files.read_toml(path))
    except ValidationError as err:
        text = files.read_text(path)
        raise InputError(tell(path, text, problems(err))) from err


def choose(names: tuple[str, ...]) -> list[Study]:
    """Return the studies of these names, in the order of the file; all without names.

    Raises:
        InputError: there is no study of a name.
    """
    studies = read_plan().studies
    known = [study.name for study in studies]
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--only: {unknown[0]}; the studies are {', '.join(known)}")
    return [study for study in studies if not names or study.name in names]


def done_labels(table: pd.DataFrame) -> dict[tuple[Any, ...], str]:
    """Return the cell of each complete attack of a sweep's table, by its labels."""
    rows = table[table["status"] == "complete"].drop_duplicates("cell")
    plain = rows[list(LABELS)].astype(object)
    cells = plain.where(plain.notna(), None).itertuples(index=False, name=None)
    return {labels: cell for cell, *entries in cells if (labels := tuple(entries))}


def state(study: Study, compare: bool = True) -> State:
    """Count the rows of a study.

    Args:
        study: of the plan.
        compare: also compare the rows with what today's program would make, which
            draws all places and takes seconds.
    """
    table, sources, current = study.read(), frozenset[str](), None
    if study.grid is None:
        assert study.cells is not None
        total = study.cells
        count = len(list(study.folder.glob(study.rows)))
        done = count if table is None else int(table[study.unit].nunique())
        done = min(done, total)
    else:
        labels = list(GridReader(ROOT / study.grid).labels())
        have = {} if table is None else done_labels(table)
        total, done = len(labels), len(have.keys() & set(labels))
        if (study.folder / MADE_OF).exists():
            made = read_made(study.folder).values()
            versions = (record["versions"] or {} for record in made)
            sources = frozenset(one.get("source", UNKNOWN) for one in versions)
        if compare:
            current = _current(study, set(have.values()))
    left = total - (done if current is None else current)
    return State(done, total, current, sources, left * study.core_hours)


def _current(study: Study, have: set[str]) -> int | None:
    """Count the cells that today's grid has under the same digest."""
    assert study.grid is not None
    try:
        return len(have & {cell.id for cell in load_cells(ROOT / study.grid)})
    except InputError:  # for example bricks that nobody has baked yet
        return None
