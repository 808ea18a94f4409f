"""Summarise the drives of a sweep with pandas."""

from pathlib import Path

import mi_nerfattack as nf
from mi_nerfattack.experiment.sweep.sweep import FinishedSweep

# of a sweep, or a copy of its tables
folder = Path(__file__).parents[1] / "results/table2"
drives = FinishedSweep(folder).drives  # a DataFrame with one row per drive
drives = drives[drives["environment"] == "mitsuba"]

# An attack is a cell of the sweep: its drives are averaged first.
figures = nf.summary(drives, by=["route", "case"], once=["cell"])
attacked = figures[figures["case"] == "attack"].set_index("route")
for route, row in attacked.iterrows():
    low, high = row["cross_track_mean_ci95_m"]
    interval = f"95 % interval {low:.3f} to {high:.3f} m"
    print(f"{route}: {interval}, mean error {row['cross_track_mean_m']:.3f} m")

# Anything else that pandas can do: the attack with the largest error of a drive.
worst = drives.loc[drives["cross_track_mean_m"].idxmax()]
print(f"{worst['cell']}, run {worst['run']}: {worst['cross_track_mean_m']:.3f} m")
