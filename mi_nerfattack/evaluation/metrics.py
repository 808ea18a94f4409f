"""Cross-track metrics of closed-loop drives and the document `metrics.json`.

The error is measured from the lane centre, positive to the left of the direction of
travel. A step departs when its distance exceeds half a lane width less half a car
width: the car then touches the lane's edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import pandas as pd
import pydantic

from mi_nerfattack.drives.table import drives_table, lane_of, records, with_starts
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.summary import summary
from mi_nerfattack.ranges import Count, Natural, NonNegative, Positive, Share
from mi_nerfattack.rollout.drive import CASES, ENVIRONMENTS, RANDOM, Drive, Lane

SCHEMA = 2


#: Of `per_run` in a document: the row of a drive in its table.
_OF_RUN = (
    *("run", "seed", "steps", "cross_track_mean_m", "cross_track_max_m"),
    *("cross_track_total", "steps_departed", "wheel_out_s", "centre_out_s"),
    "returned_s",
)
_OF_CASE = (
    *("cross_track_mean_m", "cross_track_mean_ci95_m", "cross_track_mean_worst_run_m"),
    *("cross_track_max_m", "cross_track_total", "steps_departed", "drives_departed"),
    *("wheel_out_s", "centre_out_s"),
)
_OF_CARD = (
    *("cross_track_mean_m", "cross_track_max_m", "drives_departed"),
    *("cross_track_mean_ci95_m", "departure_rate_ci95"),
)
_GROUP = ["route", "environment", "case"]


def summarise(
    drives: Iterable[Drive],
    lanes: Mapping[str, Lane],
    seed: int = 0,
    costs: Mapping[Drive, float | None] | None = None,
) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Summarise drives by route, environment and case.

    The figures of one case are the columns of `summary` and of `drives_table`:

    - `n`: number of runs;
    - means are over the runs, each of which counts once, whatever its length;
    - `cross_track_mean_ci95_m`: of `random`, where each run has its own texture; null
      for fewer than five, and for cases with one texture, however many starts they are
      driven from, because starts say nothing about other attacks;
    - `per_run`: the figures of each run, ordered by its index;
    - `objective`, with `costs`: of each run, and the mean; None where one is missing.

    Args:
        drives: in any order; lengths may differ.
        lanes: of each route.
        seed: seed of the bootstrap.
        costs: the scenario's objective of each drive.

    Returns:
        {route: {environment: {case: figures}}} of plain Python values.

    Raises:
        InputError: for the same run twice, or a route without a lane.
    """
    table = drives_table(drives, lanes, costs).sort_values("run", kind="stable")
    cost = () if costs is None else ("objective",)
    table["texture"] = table["run"].where(table["case"] == RANDOM, 0)
    result: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for row in sorted(
        records(summary(table, _GROUP, ["texture"], seed=seed)), key=_order
    ):
        route, environment, case = (row[name] for name in _GROUP)
        own = table[(table[_GROUP] == [route, environment, case]).all(axis=1)]
        result.setdefault(route, {}).setdefault(environment, {})[case] = {
            "n": row["drives"],
            **{name: row[name] for name in (*_OF_CASE, *cost)},
            "per_run": records(own[[*_OF_RUN, *cost]]),
        }
    return result


def card_figures(
    drives: Sequence[Drive], limit: float, seed: int = 0
) -> dict[str, Any]:
    """Summarise the drives of one environment, route and case for a policy card.

    - `n` and columns of `summary`, in which each drive counts once;
    - `per_run`: figures of each drive, as of `drives_table`.

    Args:
        drives: at least one.
        limit: departure limit, metres.
        seed: of the bootstrap.
    """
    lanes = {drives[0].route: Lane(limit, limit)}
    table = drives_table(drives, lanes).sort_values("run", kind="stable")
    [figures] = records(summary(table, _GROUP, ["run"], seed=seed))
    return {
        "n": figures["drives"],
        **{name: figures[name] for name in _OF_CARD},
        "departure_limit_m": limit,
        "per_run": [
            {
                **{name: row[name] for name in _OF_RUN[:5]},
                "start": [row[f"start_{k}"] for k in ("x_m", "y_m", "heading_rad")],
                "worst_at_m": [row["worst_x_m"], row["worst_y_m"]],
                **{k: row[k] for k in ("worst_time_s", "departed", "departed_time_s")},
            }
            for row in records(table)
        ],
    }


def cells(tree: Mapping[str, Any], *names: str) -> Iterator[dict[str, Any]]:
    """Yield the figures in nested tables, each after the keys that lead to it.

    Args:
        tree: tables in tables, as deep as there are names.
        names: of the keys of each table.
    """
    for key, value in tree.items():
        for figures in cells(value, *names[1:]) if names[1:] else (value,):
            yield {names[0]: key, **figures}


def drives_of_run(document: Mapping[str, Any]) -> pd.DataFrame:
    """Return the drives of a finished run as a table with one row per drive.

    Args:
        document: that ``metrics.json`` of the run holds.

    Returns:
        `scenario` (name), `seed` (of the scenario), `route`, `environment`, `case`,
        `run`, `start` (index of the first pose), `drive_seed`, and the figures of
        `per_run` with `departed`.
    """
    rows = [
        {
            "scenario": document["scenario"]["name"],
            **{name: case[name] for name in _GROUP},
            **{("drive_seed" if k == "seed" else k): v for k, v in run.items()},
            "seed": document["seed"],
        }
        for case in cells(document["routes"], *_GROUP)
        for run in case["per_run"]
    ]
    table = with_starts(pd.DataFrame(rows), "scenario")
    return table.assign(departed=table["steps_departed"] > 0)


def metrics_document(
    scenario: Mapping[str, Any],
    seed: int,
    drives: Iterable[Drive],
    lanes: Mapping[str, Lane],
    cost: Mapping[str, float],
    costs: Mapping[Drive, float | None] | None = None,
) -> dict[str, Any]:
    """Build the validated content of `metrics.json`.

    Args:
        scenario: the scenario as run, in JSON types.
        seed: the run's seed; also that of the bootstrap.
        drives: all drives of the run, at least one.
        lanes: of each route.
        cost: `wall_s`, `peak_memory_mb`, `renders` and, as of `Effort`, more.
        costs: the scenario's objective of each drive.

    Returns:
        A document for `files.write_json`.
    """
    routes = summarise(drives, lanes, seed, costs=costs)
    document = {
        "schema": SCHEMA,
        "scenario": dict(scenario),
        "seed": seed,
        "departure_limits_m": {name: lane_of(name, lanes).wheel_m for name in routes},
        "routes": routes,
        "flags": [],
        "cost": dict(cost),
    }
    validate(document)
    return document


def validate(document: Any) -> None:
    """Check a metrics document against schema 2.

    Raises:
        InputError: naming the first key that is missing, of a wrong type, negative or
            not finite, or a case whose `n` is not its number of runs.
    """
    try:
        _Document.model_validate(document)
    except pydantic.ValidationError as err:
        first = err.errors()[0]
        key = ".".join(["metrics", *map(str, first["loc"])])
        value = "" if first["type"] == "missing" else f", got {first['input']!r:.60}"
        raise InputError(f"{key}: {first['msg']}{value}; see schema {SCHEMA}") from err


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")


class _Run(_Model):
    run: Natural
    seed: Natural
    steps: Count
    cross_track_mean_m: NonNegative
    cross_track_max_m: NonNegative
    cross_track_total: NonNegative
    steps_departed: Natural
    wheel_out_s: NonNegative
    centre_out_s: NonNegative
    returned_s: Positive | None
    objective: float | None = None


class _Case(_Model):
    n: Count
    cross_track_mean_m: NonNegative
    cross_track_mean_ci95_m: list[NonNegative] | None
    cross_track_mean_worst_run_m: NonNegative
    cross_track_max_m: NonNegative
    cross_track_total: NonNegative
    steps_departed: Natural
    drives_departed: Natural
    wheel_out_s: NonNegative
    centre_out_s: NonNegative
    objective: float | None = None
    per_run: list[_Run]

    @pydantic.model_validator(mode="after")
    def _count_runs(self) -> _Case:
        if self.n != len(self.per_run):
            raise ValueError(f"n is {self.n} but per_run has {len(self.per_run)} runs")
        return self


class _Cost(_Model):
    wall_s: NonNegative
    peak_memory_mb: NonNegative
    renders: Natural
    checkpoint_s: NonNegative = 0.0
    processes: Natural = 1
    forward_s: NonNegative = 0.0
    backward_s: NonNegative = 0.0


class _Cases(_Model):
    no_object: _Case | None = None
    own: _Case | None = None
    random: _Case | None = None
    best_random: _Case | None = None
    attack: _Case | None = None


class _Baseline(_Model):
    textures: Count
    equal_textures: Count | None = None  # unknown in runs of earlier versions
    deployment_textures: Count
    backward_multiple: NonNegative
    best: Natural
    objectives: list[float]
    attack_objective: float


class _Objective(_Model):
    name: str
    missing: dict[str, str]


class _Curve(_Model):
    frames: list[Count]
    objective: list[float]
    cross_track_mean_m: list[NonNegative]

    @pydantic.model_validator(mode="after")
    def _count_rows(self) -> _Curve:
        counts = {len(column) for _, column in self}
        if len(counts) > 1:
            raise ValueError("columns of different lengths")
        return self


class _Optimised(_Model):
    cross_track_mean_m: NonNegative
    field_cross_track_mean_m: NonNegative


class _Gain(_Model):
    first: Natural
    predicted: float
    gain: float


class _Bricks(_Optimised):
    file: str


class _Texture(_Model):
    l2: NonNegative
    linf: NonNegative
    saturated_share: Share
    total_variation: NonNegative
    spectrum: list[float]
    picture_share: Share | None = None


class _Document(_Model):
    schema_version: int = pydantic.Field(alias="schema", ge=SCHEMA, le=SCHEMA)
    scenario: dict[str, Any]
    seed: Natural
    departure_limits_m: dict[str, Positive]
    routes: dict[str, dict[str, _Cases]] = pydantic.Field(min_length=1)
    cost: _Cost
    flags: list[str]
    converged: bool | None = None
    saturated_share: Share | None = None
    total_variation: NonNegative | None = None
    textures: dict[str, _Texture] | None = None
    verdict: list[str] | None = None
    baseline: _Baseline | None = None
    objective: _Objective | None = None
    curve: _Curve | None = None
    least_gain: _Gain | None = None
    bricks: _Bricks | None = None
    one_level: _Optimised | None = None
    object_poses: dict[str, Any] | None = None
    ignored_changes: list[str] | None = None
    replay: dict[str, Any] | None = None


def environment_order(name: str) -> tuple[int, str]:
    """Return what sorts environments for documents and plots."""
    known = ENVIRONMENTS.index(name) if name in ENVIRONMENTS else len(ENVIRONMENTS)
    return known, name


def _order(row: Mapping[str, Any]) -> tuple[str, tuple[int, str], int]:
    case = CASES.index(row["case"])
    return row["route"], environment_order(row["environment"]), case
