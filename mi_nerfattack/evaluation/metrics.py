"""Cross-track metrics of closed-loop drives and the document `metrics.json`.

The error is measured from the lane centre, positive to the left of the direction of
travel. A step departs when its distance exceeds half a lane width less half a car
width: the car then touches the lane's edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import pydantic

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.intervals import mean_interval, share_interval
from mi_nerfattack.rollout.drive import CASES, ENVIRONMENTS, RANDOM, Drive, Lane

SCHEMA = 2


def summarise(
    drives: Iterable[Drive], lanes: Mapping[str, Lane], seed: int = 0
) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Summarise drives by route, environment and case.

    The figures of one case of n runs, |e| being the distance from the lane centre:

    - `n`: number of runs;
    - `cross_track_mean_m`: mean of |e| over all steps of all runs;
    - `cross_track_mean_ci95_m`: of `random`, where every run has a texture of its own,
      the 95 % interval (BCa bootstrap) of the mean over runs of each run's mean of
      |e|; null for a single run, and for cases that show one look, however many starts
      they are driven from: starts tell nothing about other attacks;
    - `cross_track_mean_worst_run_m`: largest of the runs' means;
    - `cross_track_max_m`: largest |e| of any step;
    - `cross_track_total`: plain sum of |e| over the steps of a run (unit: metre-steps,
      so it grows when the time step shrinks), averaged over the runs;
    - `steps_departed`: number of steps beyond the limit, summed over the runs;
    - `drives_departed`: number of runs with at least one such step;
    - `wheel_out_s`: seconds beyond the limit, averaged over the runs;
    - `centre_out_s`: seconds with the car's centre out of the lane, likewise;
    - `per_run`: the figures of each run, ordered by its index; `returned_s` is the time
      at which it was back in the lane after its last departure, null if it never left
      or never came back.

    Args:
        drives: in any order; lengths may differ.
        lanes: of each route.
        seed: seed of the bootstrap.

    Returns:
        {route: {environment: {case: figures}}} of plain Python values.

    Raises:
        InputError: for the same run twice, or a route without a lane.
    """
    groups: dict[tuple[str, str, str], dict[int, Drive]] = {}
    for drive in drives:
        key = (drive.route, drive.environment, drive.case)
        runs = groups.setdefault(key, {})
        if drive.run in runs:
            raise InputError(f"{' / '.join(key)}: run {drive.run} twice; number runs")
        runs[drive.run] = drive
    result: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for route, environment, case in sorted(groups, key=_order):
        runs = groups[route, environment, case]
        ordered = [runs[index] for index in sorted(runs)]
        figures = _case_figures(ordered, lane_of(route, lanes), seed)
        result.setdefault(route, {}).setdefault(environment, {})[case] = figures
    return result


def card_figures(
    drives: Sequence[Drive], limit: float, seed: int = 0
) -> dict[str, Any]:
    """Summarise the drives of one environment, route and case for a policy card.

    - `n`, `cross_track_mean_m`, `cross_track_max_m`, `cross_track_mean_ci95_m`: as of
      `summarise`;
    - `drives_departed`: number of drives that left the lane;
    - `departure_rate_ci95`: 95 % interval of their share (Wilson);
    - `per_run`: by run its seed and steps, its figures, its start (x, y, heading),
      where and when its error was largest, and when it left the lane (null if it did
      not).

    Args:
        drives: at least one.
        limit: departure limit, metres.
        seed: of the bootstrap.
    """
    ordered = sorted(drives, key=lambda drive: drive.run)
    means = np.array([drive.distance_m.mean() for drive in ordered])
    left = sum(bool(drive.departed(limit).any()) for drive in ordered)
    return {
        "n": len(ordered),
        "cross_track_mean_m": float(means.mean()),
        "cross_track_max_m": max(float(drive.distance_m.max()) for drive in ordered),
        "drives_departed": left,
        "cross_track_mean_ci95_m": mean_interval(means, seed),
        "departure_rate_ci95": share_interval(left, len(ordered)),
        "departure_limit_m": limit,
        "per_run": [_card_run(drive, limit) for drive in ordered],
    }


def metrics_document(
    scenario: Mapping[str, Any],
    seed: int,
    drives: Iterable[Drive],
    lanes: Mapping[str, Lane],
    cost: Mapping[str, float],
) -> dict[str, Any]:
    """Build the validated content of `metrics.json`.

    Args:
        scenario: the scenario as run, in JSON types.
        seed: the run's seed; also that of the bootstrap.
        drives: all drives of the run, at least one.
        lanes: of each route.
        cost: `wall_s`, `peak_memory_mb`, `renders` and, as of `Effort`, more.

    Returns:
        A document for `files.write_json`.
    """
    routes = summarise(drives, lanes, seed)
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


def lane_of(route: str, lanes: Mapping[str, Lane]) -> Lane:
    """Return a route's lane; InputError if it has none."""
    if route not in lanes:
        known = ", ".join(sorted(lanes)) or "none"
        raise InputError(f"lanes: no lane for route {route!r}; given: {known}")
    return lanes[route]


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
    run: pydantic.NonNegativeInt
    seed: pydantic.NonNegativeInt
    steps: pydantic.PositiveInt
    cross_track_mean_m: pydantic.NonNegativeFloat
    cross_track_max_m: pydantic.NonNegativeFloat
    cross_track_total: pydantic.NonNegativeFloat
    steps_departed: pydantic.NonNegativeInt
    wheel_out_s: pydantic.NonNegativeFloat
    centre_out_s: pydantic.NonNegativeFloat
    returned_s: pydantic.PositiveFloat | None


class _Case(_Model):
    n: pydantic.PositiveInt
    cross_track_mean_m: pydantic.NonNegativeFloat
    cross_track_mean_ci95_m: list[pydantic.NonNegativeFloat] | None
    cross_track_mean_worst_run_m: pydantic.NonNegativeFloat
    cross_track_max_m: pydantic.NonNegativeFloat
    cross_track_total: pydantic.NonNegativeFloat
    steps_departed: pydantic.NonNegativeInt
    drives_departed: pydantic.NonNegativeInt
    wheel_out_s: pydantic.NonNegativeFloat
    centre_out_s: pydantic.NonNegativeFloat
    per_run: list[_Run]

    @pydantic.model_validator(mode="after")
    def _count_runs(self) -> _Case:
        if self.n != len(self.per_run):
            raise ValueError(f"n is {self.n} but per_run has {len(self.per_run)} runs")
        return self


class _Cost(_Model):
    wall_s: pydantic.NonNegativeFloat
    peak_memory_mb: pydantic.NonNegativeFloat
    renders: pydantic.NonNegativeInt
    checkpoint_s: pydantic.NonNegativeFloat = 0.0
    processes: pydantic.NonNegativeInt = 1
    forward_s: pydantic.NonNegativeFloat = 0.0
    backward_s: pydantic.NonNegativeFloat = 0.0


class _Cases(_Model):
    no_object: _Case | None = None
    own: _Case | None = None
    random: _Case | None = None
    best_random: _Case | None = None
    attack: _Case | None = None


class _Baseline(_Model):
    textures: pydantic.PositiveInt
    deployment_textures: pydantic.PositiveInt
    backward_multiple: pydantic.NonNegativeFloat
    best: pydantic.NonNegativeInt
    objectives: list[float]
    attack_objective: float


class _Curve(_Model):
    frames: list[pydantic.PositiveInt]
    objective: list[float]
    cross_track_mean_m: list[pydantic.NonNegativeFloat]

    @pydantic.model_validator(mode="after")
    def _count_rows(self) -> _Curve:
        counts = {len(column) for _, column in self}
        if len(counts) > 1:
            raise ValueError("columns of different lengths")
        return self


_Share = Annotated[float, pydantic.Field(ge=0, le=1)]


class _Bricks(_Model):
    file: str
    cross_track_mean_m: pydantic.NonNegativeFloat
    field_cross_track_mean_m: pydantic.NonNegativeFloat


class _Texture(_Model):
    l2: pydantic.NonNegativeFloat
    linf: pydantic.NonNegativeFloat
    saturated_share: _Share
    total_variation: pydantic.NonNegativeFloat
    spectrum: list[float]
    picture_share: _Share | None = None


class _Document(_Model):
    schema_version: int = pydantic.Field(alias="schema", ge=SCHEMA, le=SCHEMA)
    scenario: dict[str, Any]
    seed: pydantic.NonNegativeInt
    departure_limits_m: dict[str, pydantic.PositiveFloat]
    routes: dict[str, dict[str, _Cases]] = pydantic.Field(min_length=1)
    cost: _Cost
    flags: list[str]
    converged: bool | None = None
    saturated_share: _Share | None = None
    total_variation: pydantic.NonNegativeFloat | None = None
    textures: dict[str, _Texture] | None = None
    verdict: list[str] | None = None
    baseline: _Baseline | None = None
    curve: _Curve | None = None
    bricks: _Bricks | None = None
    object_poses: dict[str, Any] | None = None
    ignored_changes: list[str] | None = None
    replay: dict[str, Any] | None = None


def _case_figures(drives: list[Drive], lane: Lane, seed: int) -> dict[str, Any]:
    per_run = [_run_figures(drive, lane) for drive in drives]
    of_textures = drives[0].case == RANDOM
    means = np.array([run["cross_track_mean_m"] for run in per_run])
    return {
        "n": len(drives),
        "cross_track_mean_m": float(means.mean()),
        "cross_track_mean_ci95_m": mean_interval(means, seed) if of_textures else None,
        "cross_track_mean_worst_run_m": float(means.max()),
        "cross_track_max_m": max(float(drive.distance_m.max()) for drive in drives),
        "cross_track_total": float(np.mean([r["cross_track_total"] for r in per_run])),
        "steps_departed": sum(run["steps_departed"] for run in per_run),
        "drives_departed": sum(run["steps_departed"] > 0 for run in per_run),
        "wheel_out_s": float(np.mean([r["wheel_out_s"] for r in per_run])),
        "centre_out_s": float(np.mean([r["centre_out_s"] for r in per_run])),
        "per_run": per_run,
    }


def _run_figures(drive: Drive, lane: Lane) -> dict[str, Any]:
    out = drive.departed(lane.wheel_m)
    beyond = drive.departed(lane.centre_m)
    seconds = np.diff(drive.time_s, prepend=0.0)
    return {
        "run": drive.run,
        "seed": drive.seed,
        "steps": len(drive.distance_m),
        "cross_track_mean_m": float(drive.distance_m.mean()),
        "cross_track_max_m": float(drive.distance_m.max()),
        "cross_track_total": float(drive.distance_m.sum()),
        "steps_departed": int(out.sum()),
        "wheel_out_s": float(seconds[out].sum()),
        "centre_out_s": float(seconds[beyond].sum()),
        "returned_s": _returned_s(drive, out),
    }


def _returned_s(drive: Drive, out: np.ndarray) -> float | None:
    """Return the time of the first step after the last one that is out."""
    steps = np.flatnonzero(out)
    if not len(steps) or out[-1]:
        return None
    return float(drive.time_s[steps[-1] + 1])


def _card_run(drive: Drive, limit: float) -> dict[str, Any]:
    worst = int(drive.distance_m.argmax())
    out = np.flatnonzero(drive.departed(limit))
    return {
        "run": drive.run,
        "seed": drive.seed,
        "steps": len(drive.distance_m),
        "cross_track_mean_m": float(drive.distance_m.mean()),
        "cross_track_max_m": float(drive.distance_m.max()),
        "start": drive.states[0].tolist(),
        "worst_at_m": drive.states[1 + worst, :2].tolist(),
        "worst_time_s": float(drive.time_s[worst]),
        "departed": bool(len(out)),
        "departed_time_s": float(drive.time_s[out[0]]) if len(out) else None,
    }


def environment_order(name: str) -> tuple[int, str]:
    """Return what sorts environments for documents and plots."""
    known = ENVIRONMENTS.index(name) if name in ENVIRONMENTS else len(ENVIRONMENTS)
    return known, name


def _order(key: tuple[str, str, str]) -> tuple[str, tuple[int, str], int]:
    return key[0], environment_order(key[1]), CASES.index(key[2])
