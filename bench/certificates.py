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
    """Print one line of JSON in place of the table."""

    def run(self) -> Result:
        """Certify what has no certificate yet, and print the table."""
        if not self.runs:
            raise InputError("RUNS: none given; give folders of finished attacks")
        parts: list[pd.DataFrame] = []
        for folder in self.runs:
            target = self.output / folder.name
            if not (target / DOCUMENT).exists():
                run_command(["certify", "gradient", str(folder), "-o", str(target)])
            document = files.read_json(target / DOCUMENT)
            part = pd.DataFrame(document["rows"]).reindex(columns=_COLUMNS)
            part.insert(0, "attack", folder.name)
            parts.append(part)
            text = pd.concat(parts).to_csv(index=False, float_format="%.6g")
            files.write_text(self.output / TABLE, text)
        rows = pd.concat(parts, ignore_index=True)
        document = {"rows": rows.to_dict("records")}
        return Result(document, lambda: print(table(rows)))


def table(rows: pd.DataFrame) -> str:
    """Return a line of Markdown for each horizon: true gradients, and medians.

    The share along the gradient is the real change, divided by the predicted one.
    Horizons at which nothing changes, as where no object is in view, are left out.
    """
    lines = []
    for time_s, part in rows[rows["is_true"].notna()].groupby("time_s"):
        true = int(part["is_true"].astype(bool).sum())
        along = part["along_real"] / part["along_predicted"]
        medians = [part["slope"].median(), part["cosine"].median(), along.median()]
        cells = [f"{time_s} s", f"{true} of {len(part)}"]
        lines.append([*cells, *(f"{float(value):.2f}" for value in medians)])
    return markdown(["up to", "true", "slope", "cosine", "along"], lines)
