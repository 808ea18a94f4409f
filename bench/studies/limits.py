"""The finding about the reach of objects: where they take the car out of its lane."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from bench.studies.charts import draw_reach
from bench.studies.content import Finding
from mi_nerfattack.evaluation.summary import share_interval

#: In the order of the page, by their names in the table of places.
_OBJECTS: dict[Any, str] = {
    "billboard": "a billboard",
    "patch": "a patch",
    "3_cars_3_hydrants": "three cars and three hydrants",
}
_MEDIANS = ["in_view", "pixels", "moved", "original_m", "farthest_m"]


def limits(places: pd.DataFrame) -> Finding:
    """Count the places where objects could take the car out of its lane.

    Args:
        places: table of ``python -m bench reach``.
    """
    names = places["place"].str.extract(r"^(?P<route>\w+?)-(?P<kind>.+)-\d+$")
    rows = places.join(names)
    rows["kind"] = pd.Categorical(rows["kind"], list(_OBJECTS), ordered=True)
    rows = rows.sort_values("kind", kind="stable")
    rows["farthest_m"] = rows[["up_m", "down_m"]].max(axis=1)
    rows["out"] = rows["farthest_m"] > rows["limit_m"]
    by_kind = rows.groupby("kind", observed=True)
    by_route: Any = rows.groupby(["kind", "route"], observed=True, sort=False)
    weakest, moved = by_kind["out"].mean().idxmin(), by_route["moved"].median()
    least, most = moved[weakest].min(), moved[weakest].max()
    others = [kind for kind, _ in by_kind if kind != weakest]
    original = rows["original_m"] > rows["limit_m"]
    return Finding(
        title=f"If it changed in each frame, {_OBJECTS[weakest]} would take the car "
        f"out of its lane at {_count(by_kind.get_group(weakest)['out'])} places",
        sentences=(
            "In each frame, a local search gives each pixel of the objects the value "
            "that changes the steering most. The *reach* of a place is the median of "
            "this change over the frames of the original drive with the objects in "
            "view, in rad/s. Two more drives search in each of their own frames: one "
            "always steers more to the left, the other one more to the right.",
            "A place counts if at least one of the two drives leaves the lane. "
            + " ".join(
                f"With {_OBJECTS[kind]}, {_count(own['out'])} places count"
                f"{_ends(own['out'])}."
                for kind, own in by_kind
            )
            + " With the original colours, the car leaves the lane at "
            f"{_count(original)} places.",
            f"The reach of {_OBJECTS[weakest]} has medians of {least:.2f} to "
            f"{most:.2f} rad/s on the routes"
            + "".join(f", of {_OBJECTS[k]} {_range(moved[k])}" for k in others)
            + ". The largest control of the car is 1.5 rad/s. "
            + _threshold(rows),
        ),
        head=[
            *("objects", "route", "places out of the lane"),
            *("frames in view, median", "pixels in such a frame, median"),
            "reach, median (rad/s)",
            "largest distance from the lane centre, original, median (m)",
            "the same with the reach, the larger of two drives, median (m)",
        ],
        rows=[
            [_OBJECTS[kind], f"`{route}`", _count(own["out"])]
            + [f"{value:.0f}" for value in own[_MEDIANS[:2]].median()]
            + [f"{value:.2f}" for value in own[_MEDIANS[2:]].median()]
            for (kind, route), own in by_route
        ],
        draw=lambda figure: draw_reach(figure, rows),
        pandas='drives["kind"] = drives.place.str.split("-").str[1]\n'
        'print(drives.groupby("kind")[["moved", "up_m", "down_m"]].median())',
    )


def _range(values: Any) -> str:
    return f"{values.min():.2f} to {values.max():.2f}"


def _count(out: pd.Series) -> str:
    """Say at how many places something holds."""
    return f"{out.sum()} of {len(out)}"


def _threshold(rows: pd.DataFrame) -> str:
    """Say from which reach on the car leaves its lane everywhere."""
    staying, leaving = rows[~rows["out"]]["moved"], rows[rows["out"]]["moved"]
    if staying.empty or leaving.empty:
        return ""
    most = math.ceil(1e3 * staying.max()) / 1e3
    least = math.floor(1e3 * leaving.min()) / 1e3
    return (
        f"The car stays in its lane at no place where the reach is over {most:.3f} "
        "rad/s. It leaves its lane at no place where the reach is under "
        f"{least:.3f} rad/s."
    )


def _ends(out: pd.Series) -> str:
    """Say in which interval the share of such places lies."""
    ends = share_interval(int(out.sum()), len(out))
    return (
        f" (95 % interval {100 * ends[0]:.0f} to {100 * ends[1]:.0f} %)" if ends else ""
    )
