"""``mi-nerfattack reproduce``: rows of a sweep's table, repeated."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mi_nerfattack.commands.shared.terminal import Result


@dataclass(frozen=True)
class Reproduce:
    """Repeat rows of a sweep's table, and say by how much they differ.

    Repeats the whole cell of each row, beginning with the attack, as results.csv and
    cells.json describe it. Refuses a row if a file that its cell was made of has other
    content now. Ends with 1 if a row differs by more than --tolerance, or its cell
    fails.
    """

    folder: tyro.conf.Positional[Path]
    """Folder with results.csv and cells.json: a sweep's, or a copy of both files."""
    row: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="ROW")]
    """Rows: index in the table, from 0, or CELL:ENVIRONMENT:CASE:RUN."""
    rows: int = 0
    """Draw so many rows at random, too."""
    seed: int = 0
    """Of these."""
    output: Path | None = None
    """Folder for the repeated cells, itself a sweep's: the same command continues
    there. By default one that is removed at the end."""
    drives_only: bool = False
    """Begin where the cells' own checkpoints in FOLDER end: keep their textures and
    repeat only the drives."""
    tolerance: float | None = None
    """Largest difference of a row's mean error, metres; by default any."""
    workers: int | None = None
    """Cells that are done at a time; by default as many as there are cores for."""
    cores: int = 1
    """Cores that each cell renders with."""
    json: bool = False
    """Print JSON instead of sentences."""

    @property
    def continues(self) -> bool:
        """Whether the same command finds what this one left."""
        return self.output is not None

    def run(self) -> Result:
        """Read, repeat, compare and tell."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.cells import cell_workers, do_cells
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.sweep.reproduce import (
            compare_rows,
            read_replay,
            sentences,
            take_checkpoints,
        )
        from mi_nerfattack.experiment.sweep.table import read_made, read_table
        from mi_nerfattack.io import files

        if self.rows < 0 or not (self.row or self.rows):
            raise InputError("reproduce: no row; give ROW, or --rows 1 or more")
        check_positive(self, "cores")
        if self.output is not None:
            files.check_folder(self.output)
        variant.ensure()
        replay = read_replay(self.folder, self.row, self.rows, seed=self.seed)
        workers = cell_workers(replay.cells, self.workers, self.cores)
        with self._place({cell.id for cell in replay.cells}) as place:
            output = Path(place)
            if self.drives_only:
                take_checkpoints(replay, self.folder, output)
            sweep = do_cells(replay.cells, output, self.cores, workers=workers)
            errors = {replay.cells[i].id: error for i, error in sweep.errors.items()}
            again, made = read_table(sweep.table), read_made(output)
            comparison = compare_rows(replay, again, made, errors=errors)
        code = int(bool(errors) or self._is_exceeded(comparison))
        return Result(comparison, lambda: print(*sentences(comparison), sep="\n"), code)

    def _place(self, cell_ids: Collection[str]) -> AbstractContextManager[str | Path]:
        """Return the folder of the repetition, which may be for a while."""
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table

        if self.output is None:
            return tempfile.TemporaryDirectory()
        if self.output.resolve() == self.folder.resolve():
            raise InputError(f"{self.output}: the sweep's own folder; choose another")
        if (path := self.output / RESULTS).exists():
            held = set(read_table(path)["cell"])
            if others := held.difference(cell_ids):
                raise InputError(
                    f"{path}: has rows of other cells, such as {min(others)}, which "
                    "would be lost; choose another folder"
                )
        return nullcontext(self.output)

    def _is_exceeded(self, comparison: Mapping[str, Any]) -> bool:
        """Whether a row differs by more than was allowed, or is not there."""
        limit = self.tolerance
        return limit is not None and any(
            row["difference"] is None or row["difference"]["cross_track_mean_m"] > limit
            for row in comparison["rows"]
        )
