"""How to step in colour: parametrisations and rates over six places.

Settled before the first result: places, variants, rates, iterations and what is
reported. Every row is kept. An attack is better if its mean error is larger at equal
numbers of rendered frames; the best of a variant's rates is that of the largest
geometric mean over the six places, and each variant is judged at its best rate.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rich.table

from bench.study import rows
from bench.study.places import NATURAL_M, ROUTES, Place
from bench.study.tables import geometric_mean, markdown
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.attack.schedule import Schedule
from mi_nerfattack.attack.texture.colours import AbstractColouring, Colours
from mi_nerfattack.attack.texture.statistics import seen_weights, texture_statistics
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import World, build_attack, build_world

ITERATIONS = 24
KEYS = """
[drive]
horizon = 50

[attack]
adjoint = "kept_backgrounds"
"""
#: Near and far: distances from the lane centre, metres.
LATERAL_M = {"near": (2.0, 3.0), "far": (4.0, 5.0)}
#: Of the way from the start of a drive of 25 m.
ARC_M = (8.0, 20.0)


class Raw(AbstractColouring):
    """Raw values of all levels, which add up; the rate is in raw values.

    Args:
        field: of the object.
    """

    def __init__(self, field: GridField) -> None:
        self.start = field.texture.numpy().copy()

    def texture(self, value: np.ndarray) -> np.ndarray:
        """See the base class."""
        return value

    def gradient(self, value: np.ndarray, by_texture: np.ndarray) -> np.ndarray:
        """See the base class."""
        return by_texture


class Coarse(Raw):
    """Raw values in shares proportional to resolution**-2, the rate in colours.

    Args:
        field: of the object.
    """

    def __init__(self, field: GridField) -> None:
        super().__init__(field)
        self._original = self.start
        self.start = np.zeros_like(self._original)
        levels = field.levels()
        shares = np.array([float(level.resolution) for level in levels]) ** -2
        self._weights = np.zeros((field.n_vertices, 1), np.float32)
        for level, share in zip(levels, 4 * shares / shares.sum(), strict=True):
            self._weights[level.vertices] = share  # 4: 1 / slope of the sigmoid

    def texture(self, value: np.ndarray) -> np.ndarray:
        """See the base class."""
        return self._original + self._weights * value

    def gradient(self, value: np.ndarray, by_texture: np.ndarray) -> np.ndarray:
        """See the base class."""
        return self._weights * by_texture


@dataclass(frozen=True)
class Variant:
    """A parametrisation with the rates that are tried.

    Attributes:
        colouring: makes the parameters of a field.
        rates: of Adam.
        final_rate: share of the rate at the end.
    """

    colouring: Callable[[GridField], AbstractColouring]
    rates: tuple[float, float, float]
    final_rate: float = 0.1


VARIANTS: Mapping[str, Variant] = {
    "raw": Variant(Raw, (0.3, 0.05, 0.02), 1.0),
    "coarse": Variant(Coarse, (0.3, 0.1, 0.03)),
    "vertices": Variant(partial(Colours, smoothing=0), (0.3, 0.1, 0.03)),
    "smoothed": Variant(partial(Colours, smoothing=1), (0.3, 0.1, 0.03)),
}


def keys() -> list[dict[str, Any]]:
    """Return what tells one row from another, middle rates first."""
    return [
        {
            "route": route,
            "distance": distance,
            "variant": name,
            "rate": variant.rates[i],
        }
        for i in (1, 0, 2)
        for route, distance in itertools.product(ROUTES, LATERAL_M)
        for name, variant in VARIANTS.items()
    ]


def attack_row(key: rows.Key) -> rows.Row:
    """Attack once, and describe it."""
    place = Place(key["route"], LATERAL_M[key["distance"]], ARC_M, 0)
    with tempfile.TemporaryDirectory() as name:
        scenario, _ = load_scenario(place.write(2 * NATURAL_M, KEYS, Path(name)))
        world = build_world(scenario, scenario.policy.build())
    variant = VARIANTS[key["variant"]]
    attack = make_attack(
        world,
        Freedom(key["rate"], colouring=variant.colouring),
        Schedule(ITERATIONS, variant.final_rate),
    )
    return {"scenario": scenario.model_dump(mode="json")["objects"], **do(attack)}


def make_attack(world: World, freedom: Freedom, schedule: Schedule) -> GradientAttack:
    """Make the attack of a world with other freedom and schedule."""
    plain = build_attack(world)
    return GradientAttack(plain.rollout, plain.route, plain.initial, freedom, schedule)


def do(attack: GradientAttack) -> rows.Row:
    """Do all iterations, and describe what came of them.

    Returns:
        curves by iteration, seconds of each iteration, and the texture's figures.
    """
    sensor = attack.sensor
    [field] = sensor.fields
    original, seconds = field.texture, []
    states = attack.rollout.run(attack.initial).trajectory.states
    weights = seen_weights(sensor, [field], states[:: len(states) // 12])[0]
    while attack.iteration < attack.schedule.max_iterations:
        start = time.perf_counter()
        attack.step()
        seconds.append(round(time.perf_counter() - start, 3))
    last = attack.measure()
    attack.restore_best()
    curve = [*attack.history, last]
    return {
        "objective": [record.objective for record in curve],
        "mean_m": [record.cross_track_mean_m for record in curve],
        "max_m": [record.cross_track_max_m for record in curve],
        "best_mean_m": attack.best_mean_m,
        "converged": attack.has_converged,
        "seen_vertices": int((weights > 0).sum()),
        "texture": asdict(texture_statistics(field, original, weights)),
        "iteration_s": seconds,
    }


def table(found: Sequence[rows.Row]) -> rich.table.Table:
    """Compare variants and rates.

    Columns: mean errors by place, their geometric mean, by how much it is that of raw
    values at each of two rates, the iterations after which each place had their error
    (the most of the six), saturated share, total variation.
    """
    cells = {(r["variant"], r["rate"]): [] for r in found}
    for row in found:
        cells[row["variant"], row["rate"]].append(row)
    peers = [cells.get(("raw", rate), []) for rate in VARIANTS["raw"].rates[:2]]
    is_whole = [len(peer) == len(ROUTES) * len(LATERAL_M) for peer in peers]
    places = [f"{route}, {distance}" for route in ROUTES for distance in LATERAL_M]
    header = ["variant", "rate", *places, "geometric mean", "to raw 0.3", "to raw 0.05"]
    header += ["iterations to raw 0.3", "to raw 0.05", "saturated", "variation"]
    lines = []
    for (variant, rate), some in cells.items():
        if len(some) < len(places):
            continue
        means = [row["best_mean_m"] for row in some]
        mean = geometric_mean(means)
        ratios = [
            mean / geometric_mean(r["best_mean_m"] for r in p) if whole else ""
            for p, whole in zip(peers, is_whole, strict=True)
        ]
        most = [
            _iterations(some, peer) if whole else ""
            for peer, whole in zip(peers, is_whole, strict=True)
        ]
        of_texture = [
            float(np.mean([row["texture"][key] for row in some]))
            for key in ("saturated_share", "total_variation")
        ]
        lines.append([variant, f"{rate}", *means, mean, *ratios, *most, *of_texture])
    return markdown(header, lines)


def _iterations(some: Sequence[rows.Row], peer: Sequence[rows.Row]) -> str:
    """Say after how many iterations the last of six attacks had its peer's error."""
    most = 0
    for row, other in zip(some, peer, strict=True):
        reached = np.array(row["mean_m"]) >= other["best_mean_m"]
        if not reached.any():
            return "never"
        most = max(most, int(reached.argmax()))
    return str(most)
