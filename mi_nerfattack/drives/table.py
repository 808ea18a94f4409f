"""Tables with one row per drive: labels and figures, in memory and as CSV files."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import RANDOM, Drive, Lane

MAX_BYTES = 1 << 30
#: Columns that tell the drives of one policy apart.
LABELS = ("route", "environment", "case", "run")
#: Pandas' types of columns in which values can be missing.
TEXT, INTEGER, NUMBER, TRUTH = "string", "Int64", "float64", "boolean"
#: Columns of a table with one row per drive and step.
STEPS = {
    **dict.fromkeys(("environment", "route", "case"), TEXT),
    **dict.fromkeys(("run", "seed", "step"), INTEGER),
    **dict.fromkeys(("time_s", "x_m", "y_m", "heading_rad", "control"), NUMBER),
    "cross_track_m": NUMBER,
    "departed": INTEGER,
}
#: Columns after them, a number each: ``state_3`` is row 3, from 0, of the state, and
#: ``control_1`` the second of several controls, the first of which is ``control``.
FURTHER = re.compile(r"(state|control)_[0-9]+")
_REMEDY = "give the command that wrote the table again"


def drives_table(
    drives: Iterable[Drive],
    lanes: Mapping[str, Lane],
    costs: Mapping[Drive, float | None] | None = None,
    **labels: Any,
) -> pd.DataFrame:
    """Return a table with one row per drive.

    Columns, e being the distance from the lane centre after each step:

    - `route`, `environment`, `case`, `run`, `seed`: of the drive;
    - `steps`: number of steps;
    - `cross_track_mean_m`, `cross_track_max_m`: mean and maximum of e;
    - `cross_track_total`: sum of e (metre-steps: it grows when the step shrinks);
    - `steps_departed`, `departed`: steps beyond the departure limit, whether any is;
    - `wheel_out_s`, `centre_out_s`: seconds beyond the limit, and with the centre of
      the car out of the lane;
    - `departed_time_s`: of the first step out; `returned_s`: of the first step in the
      lane after the last step out; NaN if there is none;
    - `start_x_m`, `start_y_m`, `start_heading_rad`: first state;
    - `worst_time_s`, `worst_x_m`, `worst_y_m`: when and where e is largest;
    - `objective`, with `costs`: that of the drive; NaN where it is not known.

    Args:
        drives: in any order; lengths may differ.
        lanes: of each route.
        costs: the scenario's objective of each drive.
        labels: further columns, such as ``attack="a1"``: a value for all rows.

    Raises:
        InputError: the same run twice, or a route without a lane.
    """
    rows = []
    for drive in drives:
        row = labels | _row(drive, lane_of(drive.route, lanes))
        if costs is not None:
            cost = costs[drive]
            row["objective"] = np.nan if cost is None else cost
        rows.append(row)
    table = pd.DataFrame(rows, columns=None if rows else [*labels, *LABELS])
    if (again := table.duplicated(list(LABELS))).any():
        *where, run = table.loc[again, list(LABELS)].iloc[0]
        raise InputError(f"{' / '.join(where)}: run {run} twice; number runs")
    return table


def write_steps(
    path: str | Path, drives: Iterable[Drive], lanes: Mapping[str, Lane]
) -> None:
    """Write a CSV file with one row per drive and step.

    Row `step` t = 1..T holds the state reached at `time_s`, the control that led to
    the state, and its signed cross-track error; `departed` is 1 beyond the limit. The
    rows of the state after the heading follow as `state_3`, `state_4`, ...; they are
    empty where an environment has none. Of several controls `control` is the first, and
    the others follow as `control_1`, ...
    """
    tables = []
    for drive in drives:
        out = drive.departed(lane_of(drive.route, lanes).wheel_m).astype(int)
        labels = (drive.environment, drive.route, drive.case, drive.run, drive.seed)
        figures = (drive.first_controls, drive.cross_track_m, out)
        steps = range(1, len(out) + 1)
        columns = (*labels, steps, drive.time_s, *drive.poses[1:].T, *figures)
        named = dict(zip(STEPS, columns, strict=True))
        state_rows = enumerate(drive.states[1:, 3:].T, start=3)
        named |= {f"state_{row}": values for row, values in state_rows}
        others = drive.controls.reshape(len(out), -1).T[1:]
        named |= {f"control_{k}": values for k, values in enumerate(others, start=1)}
        tables.append(pd.DataFrame(named))
    write_csv(path, pd.concat(tables))


def lane_of(route: str, lanes: Mapping[str, Lane]) -> Lane:
    """Return a route's lane; InputError if it has none."""
    if route not in lanes:
        known = ", ".join(sorted(lanes)) or "none"
        raise InputError(f"lanes: no lane for route {route!r}; given: {known}")
    return lanes[route]


def with_starts(table: pd.DataFrame, attack: str) -> pd.DataFrame:
    """Return a table with the column `start`: the index of each drive's first pose.

    Drives of one `run` begin at the same pose in all cases but `random`, whose
    textures repeat these poses.

    Args:
        table: with `case` and `run`.
        attack: column with a different value for each attack.
    """
    others = table[table["case"] != RANDOM]
    starts = others.groupby(attack)["run"].max() + 1
    count = table[attack].map(starts).fillna(1).astype("int64")
    return table.assign(start=table["run"].astype("int64") % count)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows as plain Python values; None where a value is missing."""
    plain = table.astype(object)
    rows = plain.where(plain.notna(), None).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def write_csv(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table; each number reads back to the same float64."""
    files.write_text(path, table.to_csv(index=False, lineterminator="\n"))


def read_csv(
    path: str | Path, types: Mapping[str, str], further: re.Pattern[str] | None = None
) -> pd.DataFrame:
    """Read a table of :func:`write_csv`.

    Args:
        path: CSV file.
        types: pandas' types of all its columns; empty fields are missing values.
        further: matches the names of further columns, of numbers.

    Raises:
        InputError: the file is missing, too large or damaged, or has other columns.
    """
    raw = files.read_bytes(path, MAX_BYTES)
    header = raw[: raw.find(b"\n")].decode(errors="replace").split(",")
    if further is not None:
        types = {**dict.fromkeys(filter(further.fullmatch, header), NUMBER), **types}
    if wrong := sorted(set(header) ^ set(types)):
        raise InputError(
            f"{path}: not a table of this kind: columns {', '.join(wrong):.200} are "
            f"missing or unknown; {_REMEDY}"
        )
    try:
        if not raw.endswith(b"\n"):
            raise ValueError("the last line is cut off")
        return pd.read_csv(
            io.BytesIO(raw),
            dtype={name: kind for name, kind in types.items() if kind != NUMBER},
            converters={n: _exact for n, kind in types.items() if kind == NUMBER},
            keep_default_na=False,
            na_values=[""],
        )
    except ValueError as err:
        raise InputError(f"{path}: damaged ({err}); {_REMEDY}") from err


def _exact(text: str) -> float:
    """Return the float64 of a field; pandas' own reader differs in last bits."""
    return float(text) if text else np.nan


def _row(drive: Drive, lane: Lane) -> dict[str, Any]:
    distance, time = drive.distance_m, drive.time_s
    out, beyond = drive.departed(lane.wheel_m), drive.departed(lane.centre_m)
    seconds = np.diff(time, prepend=0.0)
    steps, worst = np.flatnonzero(out), int(distance.argmax())
    start, place = drive.poses[0].tolist(), drive.states[1 + worst].tolist()
    came_back = len(steps) > 0 and not out[-1]
    return {
        **{name: getattr(drive, name) for name in (*LABELS, "seed")},
        "steps": len(distance),
        "cross_track_mean_m": float(distance.mean()),
        "cross_track_max_m": float(distance.max()),
        "cross_track_total": float(distance.sum()),
        "steps_departed": len(steps),
        "departed": len(steps) > 0,
        "wheel_out_s": float(seconds[out].sum()),
        "centre_out_s": float(seconds[beyond].sum()),
        "departed_time_s": float(time[steps[0]]) if len(steps) else np.nan,
        "returned_s": float(time[steps[-1] + 1]) if came_back else np.nan,
        **dict(
            zip(("start_x_m", "start_y_m", "start_heading_rad"), start, strict=True)
        ),
        "worst_time_s": float(time[worst]),
        "worst_x_m": place[0],
        "worst_y_m": place[1],
    }
