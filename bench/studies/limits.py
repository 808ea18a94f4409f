"""The finding about the reach of objects: where they can take the car off the lane."""

from __future__ import annotations

from typing import Any

import pandas as pd

from bench.studies.charts import draw_shares
from bench.studies.content import Finding

#: By the name in the tables of places.
_OBJECTS: dict[Any, str] = {
    "patch": "a patch",
    "billboard": "a billboard",
    "3_cars_3_hydrants": "three cars and three hydrants",
}


def limits(places: pd.DataFrame) -> Finding:
    """Count the places where objects could take the car off the lane.

    Args:
        places: table of ``python -m bench reach``.
    """
    names = places["place"].str.extract(r"^(?P<route>\w+?)-(?P<objects>.+)-\d+$")
    rows = places.join(names)
    rows["farthest"] = rows[["up_m", "down_m"]].max(axis=1)
    rows["out"] = (rows["farthest"] > rows["limit_m"]).astype(float)
    columns = ["out", "pixels", "moved", "original_m", "farthest"]
    lines, shares, medians = [], {}, {}
    for (kind, route), own in rows.groupby(["objects", "route"], sort=False):
        out, *middle = [own["out"].sum(), *own[columns[1:]].median()]
        medians[f"{_OBJECTS[kind]} on the route `{route}`"] = middle[1]
        shares[f"{kind}, {route}"] = float(out / len(own))
        counts = f"{out:.0f}/{len(own)}"
        figures = [f"{middle[0]:.0f}", *(f"{value:.2f}" for value in middle[1:])]
        lines.append([_OBJECTS[kind], str(route), counts, *figures])
    weakest = min(medians, key=lambda name: medians[name])
    counts = [
        f"{own['out'].sum():.0f} of {len(own)} places with {_OBJECTS[kind]}"
        for kind, own in rows.groupby("objects", sort=False)
    ]
    return Finding(
        title="With a picture of its own in each frame, objects take the car off the "
        f"lane at {rows['out'].sum():.0f} of {len(rows)} places",
        sentences=(
            "The reach is the largest change of the control that the pixels of the "
            "objects can cause, in rad/s. Each pixel takes its worst value in each "
            f"frame. Then the car leaves the lane at {', '.join(counts)}.",
            f"The reach is smallest for {weakest}: {medians[weakest]:.2f} rad/s in the "
            "median.",
            "Over all places, the largest error with the original colours has a median "
            f"of {rows['original_m'].median():.2f} m.",
        ),
        head=[
            *("objects", "route", "places off the lane", "pixels, median"),
            "reach, median (rad/s)",
            *("largest error, original, median (m)", "with the reach, median (m)"),
        ],
        rows=lines,
        draw=lambda figure: draw_shares(
            figure, shares, "share of places where the reach takes the car off the lane"
        ),
        pandas='drives["route"] = drives.place.str.split("-").str[0]\n'
        'print(drives.groupby("route")[["moved", "up_m", "down_m"]].median())',
    )
