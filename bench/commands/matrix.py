"""``python -m bench matrix``: the best attacks of sweeps in every environment."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class BenchMatrix:
    """Drive past the best attacks of sweeps in every environment and condition.

    Takes the eight best of each route, gives them to one transfer in FOLDER, first in
    its default environments, then with what is left of them built in, and writes the
    page once all is driven. Attacks of which there is but the table are made again,
    in FOLDER/remade. The same command goes on.
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
        import pyarrow as pa
        import pyarrow.parquet

        from bench import results
        from bench.commands.quality import run_command
        from bench.matrix import best_attacks, drives_of, page
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
        from mi_nerfattack.experiment.transfer.columns import ENVIRONMENTS
        from mi_nerfattack.experiment.transfer.run import DOCUMENT
        from mi_nerfattack.io import files

        tables = [(path, read_table(path / RESULTS)) for path in self.sweeps]
        chosen = self._made(best_attacks(tables))
        words = ["transfer", *map(str, chosen), "-o", str(self.folder)]
        words += ["--cases", "no_object", "attack", "--starts", str(self.starts)]
        words += ["--spp", str(self.spp)]
        words += [] if self.workers is None else ["--workers", str(self.workers)]
        run_command(words)
        run_command([*words, "--environments", *ENVIRONMENTS])
        document = files.read_json(self.folder / DOCUMENT)
        command = "python -m bench matrix FOLDER TABLE2 METHODS"
        made = results.stamp({}, [command])
        buffer = io.BytesIO()
        table = pa.Table.from_pylist(drives_of(document))
        pyarrow.parquet.write_table(table, buffer)
        files.make_folder(self.output)
        files.write_bytes(self.output / "drives.parquet", buffer.getvalue())
        files.write_text(self.output / "README.md", page(document, made))
        print(f"{self.output / 'README.md'}: written")
        return 0

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
                run_command(["replay", str(sweep), *rows, "-o", str(remade), *workers])
        return list(found.values())
