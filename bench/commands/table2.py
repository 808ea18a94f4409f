"""``python -m bench table2``: the page of Table 2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class BenchTable2:
    """Write the page of a sweep of scenes/table2.toml beside the paper's Table 2.

    OUTPUT gets README.md, and copies of results.parquet and summary.json, of which
    `mi-nerfattack reproduce` repeats any row.
    """

    folder: tyro.conf.Positional[Path]
    """Folder of the sweep, or an earlier OUTPUT."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the page."""
    retrained: Path | None = None
    """Folder of `mi-nerfattack retrain`, its --data, whose runs were the sweep's
    cells."""
    budgets: Path | None = None
    """Folder of the sweep of scenes/budgets.toml, finished or not; OUTPUT/budgets gets
    its table."""

    def run(self) -> int:
        """Read, write and copy."""
        from bench import results
        from bench.table2.page import page
        from bench.table2.rows import read_retrained
        from mi_nerfattack.experiment.sweep.summary import SUMMARY
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
        from mi_nerfattack.io import files

        summary = files.read_json(self.folder / SUMMARY)
        rows = read_table(self.folder / RESULTS)
        retrained, words = {}, ["python -m bench table2 FOLDER -o docs/table2"]
        if self.retrained is not None:
            retrained = read_retrained(self.retrained, {row["cell"] for row in rows})
            words.append("--retrained DATA")
        budgets = None
        if self.budgets is not None:
            budgets = results.summary_of(self.budgets)
            results.copy_files([RESULTS], self.budgets, self.output / "budgets")
            words.append("--budgets BUDGETS")
        text = page(summary, rows, retrained, results.stamp({}, words), budgets)
        results.copy_files((RESULTS, SUMMARY), self.folder, self.output)
        files.write_text(self.output / "README.md", text)
        print(f"{self.output / 'README.md'}: written")
        return 0
