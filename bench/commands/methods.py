"""``python -m bench methods``: methods of attack at equal frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class BenchMethods:
    """Write the page of sweeps of scenes/tuning.toml and scenes/methods.toml.

    OUTPUT gets README.md, the second's results.parquet and summary.json, and in
    OUTPUT/tuning the first's results.parquet. Of unfinished sweeps it shows what is
    there.
    """

    tuning: tyro.conf.Positional[Path]
    """Folder of the sweep that settings are chosen by."""
    folder: tyro.conf.Positional[Path | None] = None
    """Folder of the sweep that compares; without it, the page tells of the settings."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("docs/methods")
    """Folder of the page."""

    def run(self) -> int:
        """Read, write and copy."""
        from bench import results
        from bench.methods.page import page
        from mi_nerfattack.experiment.sweep.summary import SUMMARY
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
        from mi_nerfattack.io import files

        tuning = results.summary_of(self.tuning)
        summary = None if self.folder is None else results.summary_of(self.folder)
        table = read_table((self.folder or self.tuning) / RESULTS)
        words = ["python -m bench methods TUNING"]
        words += [] if self.folder is None else ["FOLDER"]
        grid, compared = (
            files.read_toml(ROOT / "scenes" / name)
            for name in ("tuning.toml", "methods.toml")
        )
        made = results.stamp({}, words)
        text = page(summary, table, tuning, grid, compared, made)
        results.copy_files([RESULTS], self.tuning, self.output / "tuning")
        if self.folder is not None:
            files.write_json(self.output / SUMMARY, summary)
            results.copy_files([RESULTS], self.folder, self.output)
        files.write_text(self.output / "README.md", text)
        print(f"{self.output / 'README.md'}: written")
        return 0
