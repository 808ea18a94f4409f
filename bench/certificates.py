"""``python -m bench certificates``: how far gradients of several attacks predict."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pandas as pd
import tyro

from bench.results import run_command
from bench.tables import markdown
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.drives.table import records
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.certify.robustness import DOCUMENT
from mi_nerfattack.io import files

TABLE = "certificates.csv"
_COLUMNS = ["time_s", "slope", "cosine", "is_true", "along_predicted", "along_real"]


@dataclass(frozen=True)
class BenchCertificates:
    """Certify the gradient at the end of each attack, see `certify gradient`.

    Prints, by horizon, how many of these gradients are true, and medians of slope and
    cosine. A second run continues the table.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of finished runs of attack, by a gradient."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the certificates, and for the table, certificates.csv."""
    json: bool = False
    """Print one line of JSON instead of the table."""

    def run(self) -> Result:
        """Certify what has no certificate yet, and print the table."""
        names = [folder.name for folder in self.runs]
        if not names or len(set(names)) < len(names):
            raise InputError(
                f"RUNS: {names}; give folders of finished attacks, each name once"
            )
        tables: list[pd.DataFrame] = []
        for folder in self.runs:
            target = self.output / folder.name
            if not (target / DOCUMENT).exists():
                run_command(["certify", "gradient", str(folder), "-o", str(target)])
            document = files.read_json(target / DOCUMENT)
            own = pd.DataFrame(document["rows"]).reindex(columns=_COLUMNS)
            own.insert(0, "attack", folder.name)
            tables.append(own)
            text = pd.concat(tables).to_csv(index=False, float_format="%.6g")
            files.write_text(self.output / TABLE, text)
        rows = pd.concat(tables, ignore_index=True)
        document = {"rows": records(rows)}
        return Result(document, lambda: print(table(rows)))


def table(rows: pd.DataFrame) -> str:
    """Return a line of Markdown for each horizon: true gradients, and medians.

    The share along the gradient is the real change, divided by the predicted one.
    Horizons at which nothing changes, as where no object is in view, are left out.
    """
    lines = []
    judged = rows[rows["is_true"].notna()]
    for time_s, own in judged.groupby(judged["time_s"].round(6)):
        true = int(own["is_true"].astype(bool).sum())
        along = own["along_real"] / own["along_predicted"]
        medians = [own["slope"].median(), own["cosine"].median(), along.median()]
        cells = [f"{time_s} s", f"{true} of {len(own)}"]
        lines.append([*cells, *(f"{float(value):.2f}" for value in medians)])
    return markdown(["up to", "true", "slope", "cosine", "along"], lines)
