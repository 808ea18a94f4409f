"""``python -m bench matrix``: the best attacks of sweeps in every environment."""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro


@dataclass(frozen=True)
class BenchMatrix:
    """Drive past the best attacks of sweeps in every environment and condition.

    Takes the eight best of each route and gives them to transfers in FOLDER, some
    conditions at a time, the plain one first. The table beside the page grows after
    each; attacks that it has under all of some conditions are not driven past again,
    on whatever machine. The same command goes on. Attacks of which there is but the
    table are made again, in FOLDER/remade.
    """

    folder: tyro.conf.Positional[Path]
    """Of the transfer."""
    sweeps: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of finished sweeps on the same routes, or copies of their tables."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("docs/matrix")
    """Folder of the page."""
    starts: int = 1
    """Unseen starts; the attacks, not their drives, are what intervals are over."""
    spp: int = 8
    """Samples per pixel of path-traced images: those of Table 2."""
    workers: int | None = None
    """Processes; one a core by default."""

    def run(self) -> int:
        """Choose, drive and write."""
        from bench.matrix import (
            best_attacks,
            check_same,
            columns_of,
            left,
            passes,
            table_rows,
        )
        from mi_nerfattack import variant
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
        from mi_nerfattack.experiment.transfer.found import read_found
        from mi_nerfattack.experiment.transfer.run import DOCUMENT
        from mi_nerfattack.io import files

        tables = [(path, read_table(path / RESULTS)) for path in self.sweeps]
        chosen = {path.name: path for path in best_attacks(tables)}
        variant.ensure()
        document = self._drives / DOCUMENT
        if document.exists():  # of an interrupted pass
            self._add(table_rows(files.read_json(document), self._settings), chosen)
        for conditions in passes():
            columns, rows = columns_of(conditions), self._rows()
            names = left(rows, chosen, columns)
            if not names:
                continue
            folders = self._made([chosen[name] for name in names])
            found = {item.label: item.digest for item in read_found(folders)}
            check_same(rows, found, self._table)
            environments = list(dict.fromkeys(name for name, _ in columns))
            self._drive(folders, environments, conditions)
            self._add(table_rows(files.read_json(document), self._settings), chosen)
        return 0

    @property
    def _settings(self) -> dict[str, Any]:
        """Of all rows of a table."""
        from mi_nerfattack.backend.versions import versions

        told = json.dumps(versions())
        return {"starts": self.starts, "spp": self.spp, "versions": told}

    @property
    def _drives(self) -> Path:
        """Folder of the transfers with these settings."""
        return self.folder / f"starts_{self.starts}_spp_{self.spp}"

    @property
    def _table(self) -> Path:
        return self.output / "drives.parquet"

    def _rows(self) -> list[dict[str, Any]]:
        """Return what the table has so far."""
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.sweep.table import require_parquet

        require_parquet()
        import pyarrow.parquet

        if not self._table.exists():
            return []
        rows = pyarrow.parquet.read_table(self._table).to_pylist()
        for name, value in self._settings.items():
            if others := {row[name] for row in rows} - {value}:
                raise InputError(
                    f"{self._table}: has drives with {name} {others.pop()}, here "
                    f"{value}; take the same, or choose another folder with -o"
                )
        return rows

    def _add(self, new: Iterable[dict[str, Any]], labels: Collection[str]) -> None:
        """Add rows to the table, and write the page if a column is whole."""
        import pyarrow as pa
        import pyarrow.parquet

        from bench import results
        from bench.matrix import check_same, document_of, merged, page
        from mi_nerfattack.io import files
        from mi_nerfattack.report.plots.transfer import plot_transfer

        known, new, buffer = self._rows(), list(new), io.BytesIO()
        found = {row["attack"]: row["found_sha256"] for row in new}
        check_same(known, found, self._table)
        rows = merged(known, new)
        if rows == known:
            return
        pyarrow.parquet.write_table(pa.Table.from_pylist(rows), buffer)
        files.make_folder(self.output)
        files.write_bytes(self._table, buffer.getvalue())
        document = document_of(rows, labels)
        if document["columns"]:
            made = results.stamp({}, ["python -m bench matrix FOLDER TABLE2 METHODS"])
            files.write_text(self.output / "README.md", page(document, made))
            plot_transfer(self.folder / "matrix.png", document)
            print(f"{self.output / 'README.md'}: written", flush=True)

    def _drive(
        self,
        folders: Sequence[Path],
        environments: Sequence[str],
        conditions: Sequence[str],
    ) -> None:
        from bench.commands.quality import run_command
        from bench.matrix import CASES, SEED

        words = ["transfer", *map(str, folders), "-o", str(self._drives)]
        words += ["--environments", *environments, "--conditions", *conditions]
        words += ["--cases", *CASES, "--starts", str(self.starts)]
        words += ["--seed", str(SEED), "--spp", str(self.spp)]
        words += [] if self.workers is None else ["--workers", str(self.workers)]
        run_command(words)

    def _made(self, chosen: Sequence[Path]) -> list[Path]:
        """Return the run folders of cells; those that are not there are made again."""
        from bench.commands.quality import run_command
        from mi_nerfattack.experiment.run_folder import METRICS

        found = {path: path for path in chosen}
        for number, sweep in enumerate(self.sweeps):
            left = [path for path in chosen if path.parents[1] == sweep]
            left = [path for path in left if not (path / METRICS).exists()]
            remade = self.folder / "remade" / str(number)
            found |= {path: remade / path.relative_to(sweep) for path in left}
            rows = [f"{path.name}:surrogate:attack:0" for path in left]
            workers = [] if self.workers is None else ["--workers", str(self.workers)]
            if any(not (found[path] / METRICS).exists() for path in left):
                run_command(
                    ["reproduce", str(sweep), *rows, "-o", str(remade), *workers]
                )
        return list(found.values())
