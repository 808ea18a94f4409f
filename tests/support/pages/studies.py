"""Tables of drives for the tests of studies and findings."""

from __future__ import annotations

import pandas as pd

from mi_nerfattack.drives.table import with_starts
from mi_nerfattack.experiment.sweep.table import make_table


def table(errors: dict[str, list[float]], **labels: str) -> pd.DataFrame:
    """Return one drive per case and place of a sweep, with these mean errors (m)."""
    labels = {"method": "gradient", "route": "left", "objects": "car"} | labels
    rows = [
        labels
        | {"cell": f"{labels['method']}{seed}", "seed": seed, "case": case, "run": 0}
        | {"environment": "surrogate", "frames": 9, "steps": 4, "status": "complete"}
        | {"cross_track_mean_m": error, "wheel_out_s": 0.0, "departed": error > 1}
        for case, values in errors.items()
        for seed, error in enumerate(values)
    ]
    return make_table(rows)


def drives(*tables: pd.DataFrame) -> pd.DataFrame:
    rows = with_starts(pd.concat(tables), "cell")
    return rows.assign(scenario=rows["route"] + ", " + rows["objects"])
