"""Evaluation of policies in an environment of known geometry, its card and page."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.stats
from support.faults.refusals import refused_at
from support.worlds.places import (
    Grey,
    PaintedEnvironment,
    small_grid,
    straight,
    surroundings,
)

from mi_nerfattack.deploy.place import Conditions, bundled_place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.deploy.sites import PlaceSite
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import (
    EvaluateSettings,
    ExpertPolicy,
    drive,
    evaluate,
    evaluate_run,
    make_card,
    random_start,
)
from mi_nerfattack.evaluation.identity import EnvironmentUnder
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.rollout.drive import NO_OBJECT, RANDOM, departure_limit
from mi_nerfattack.training.presets import EVALUATIONS
from mi_nerfattack.vehicle.expert import expert_for
from mi_nerfattack.vehicle.route.route import Route, load_routes

pytestmark = pytest.mark.usefixtures("variant")


class Counting(AbstractPolicy):
    """Gives one control, and remembers images, goals and memories."""

    def __init__(self, value: float = 0.0) -> None:
        self.value = value
        self.inputs: list[tuple[np.ndarray, int, int]] = []

    def initial_memory(self, count):
        assert count == 1
        return (0,)

    def step(self, image, goal, memory, numbers=None):
        self.inputs.append((image.numpy().copy(), goal, memory[0]))
        return dr.opaque(mi.Float, self.value, 1), (memory[0] + 1,)

    def control(self, image, goal):
        raise AssertionError("a policy is asked for steps")

    def vjp(self, image, goal, cotangent):
        raise AssertionError("an evaluation needs no derivative")


def surrogate(name: str = "surrogate") -> PaintedEnvironment:
    environment = PaintedEnvironment(from_fov(8, 4, 90.0), Grey())
    environment.name = name
    return environment


def test_a_straight_drive_beside_the_centre_has_a_known_error():
    """At 0.3 m and an angle, control 0: the error is 0.3 + v t sin(psi)."""
    environment, policy = surrogate(), Counting()
    pose = np.array([1.0, 0.3, 0.05])
    driven = drive(environment, policy, straight(), pose, 7, 20)
    expected = 0.3 + 5.0 * driven.time_s * math.sin(0.05)
    np.testing.assert_allclose(driven.cross_track_m, expected, atol=1e-9)
    np.testing.assert_allclose(driven.time_s, 0.1 * np.arange(1, 21))
    np.testing.assert_allclose(driven.states[0], pose)
    assert environment.seeds == [7]
    # the memory grows step by step, the goal is the route's
    assert [row[1:] for row in policy.inputs] == [(0, step) for step in range(20)]
    # a heading rate of w for T seconds turns the car by w T
    driven = drive(surrogate(), Counting(0.5), straight(), np.zeros(3), 0, 10)
    assert driven.states[-1, 2] == pytest.approx(0.5)
    np.testing.assert_allclose(driven.controls, 0.5)


def test_the_policy_sees_srgb_in_the_unit_interval():
    environment, policy = surrogate(), Counting()
    drive(environment, policy, straight(), np.array([1.0, 0.3, 0.0]), 0, 1)
    image = policy.inputs[0][0]
    assert image.shape == (1, 4, 8, 3) and image.dtype == np.float32
    # levels 128 + 1 / 0.2, 128 + 0.3 / 0.2 and 128
    np.testing.assert_allclose(image[0, 2, 3], np.array([133, 130, 128]) / 255, 1e-6)


def test_starts_are_cut_and_depend_on_seed_route_and_run_alone():
    settings, rng = EvaluateSettings(), np.random.default_rng(0)
    poses = np.array([random_start(straight(), settings, rng) for _ in range(400)])
    assert 0.2 < poses[:, 1].std() < 0.3
    assert np.abs(poses[:, 1]).max() <= 0.75
    assert np.rad2deg(poses[:, 2].std()) == pytest.approx(3.0, rel=0.2)
    assert np.abs(np.rad2deg(poses[:, 2])).max() <= 9.0
    np.testing.assert_array_equal(poses[:, 0], 0)
    few, many = EvaluateSettings(runs=2, horizon=2), EvaluateSettings(horizon=2)
    arguments = (Counting(), straight(), NO_OBJECT, 1, [], None)
    one = evaluate_run(surrogate(), *arguments, few)
    other = evaluate_run(surrogate("mujoco"), *arguments, many)
    np.testing.assert_array_equal(one.states, other.states)
    assert one.seed == other.seed


def test_objects_are_the_same_in_every_environment_and_keep_their_textures():
    grid, route, settings = small_grid(), straight(), EvaluateSettings(horizon=3)
    around, positions = surroundings(route), []
    for name in ("surrogate", "mitsuba"):
        environment = surrogate(name)
        runs = [
            evaluate_run(
                environment, Counting(), route, case, run, [grid], around, settings
            )
            for case in settings.cases
            for run in range(2)
        ]
        assert [item.case for item in runs] == [NO_OBJECT] * 2 + [RANDOM] * 2
        shown = environment.shown
        assert not any(shown[:8]) and all(len(item) == 1 for item in shown[8:])
        assert environment.objects == []
        positions.append([shown[8][0].pose.translation, shown[12][0].pose.translation])
        # clean and with objects from the same start
        np.testing.assert_array_equal(runs[0].states[0], runs[2].states[0])
    np.testing.assert_array_equal(positions[0], positions[1])
    assert not np.array_equal(positions[0][0], positions[0][1])
    np.testing.assert_array_equal(grid.texture.numpy(), 0)


def test_the_card_counts_drives_that_left_the_lane():
    """Limit (3.5 - 1.8) / 2 = 0.85 m: 0.8 m stays, 0.9 m left."""
    drives = [
        drive(surrogate(), Counting(), straight(), np.array([0, y, 0]), 3, 4, run=run)
        for run, y in enumerate([0.0, 0.8, -0.9, 0.8, 0.0])
    ]
    key = ("surrogate", "straight", "no_object")
    card = make_card({key: drives}, {"straight": 0.85})
    figures = card["surrogate"]["straight"]["no_object"]
    assert (figures["n"], figures["drives_departed"]) == (5, 1)
    assert figures["cross_track_mean_m"] == pytest.approx(2.5 / 5)
    assert figures["cross_track_max_m"] == pytest.approx(0.9)
    assert [run["departed"] for run in figures["per_run"]] == [
        False,
        False,
        True,
        False,
        False,
    ]
    last = figures["per_run"][2]
    assert last["departed_time_s"] == pytest.approx(0.1)
    assert last["start"] == [0, -0.9, 0]
    ends = scipy.stats.binomtest(1, 5).proportion_ci(method="wilson")
    assert figures["departure_rate_ci95"] == pytest.approx(list(ends))
    json.dumps(figures, allow_nan=False)


@pytest.mark.parametrize(
    ("objects", "change", "named"),
    [
        (0, {"car_width_m": 4.0}, "route 'straight': .* 3.5 m .* 4.0"),
        (1, {"runs": 2}, "'left': places for 0 of 1 .* 0.0 to 2.5 m"),
        (1, {"objects": (2,)}, "objects: 2, .* 1 "),
    ],
)
def test_what_cannot_be_measured_is_told_before_the_first_drive(objects, change, named):
    short = Route("left", 1, np.array([[0.0, 0.0], [5.0, 0.0]]))
    policy, settings = Counting(), EvaluateSettings(**({"runs": 1} | change))
    fields = [small_grid() for _ in range(objects)]
    routes, around = [straight(), short], surroundings(straight(), short)
    with pytest.raises(InputError, match=named):
        evaluate(policy, [surrogate()], routes, fields, around, settings)
    assert not policy.inputs


def test_the_expert_drives_by_the_state():
    environment, route = surrogate(), straight()
    expert = ExpertPolicy(environment, expert_for("rad/s", route, 0.1))
    driven = drive(environment, expert, route, np.array([0, 0.5, 0.1]), 0, 60)
    assert driven.distance_m[0] > 0.5
    assert driven.distance_m[-20:].max() < 0.01
    with pytest.raises(InputError, match="no derivative"):
        expert.vjp(None, 0, None)


def test_drives_end_before_an_open_route_and_with_a_closed_one():
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
    loop = Route("loop", 0, square, closed=True)
    assert EvaluateSettings().steps(straight()) == 76  # (40 - 2) m at 0.5 m a step
    assert EvaluateSettings().steps(loop) == 80
    assert EvaluateSettings(horizon=9).steps(loop) == 9


def test_the_room_has_starts_in_its_lane_and_objects_that_find_a_place():
    room, settings = bundled_place("room"), EVALUATIONS["room"]
    (route,) = load_routes(room.routes)
    limit = departure_limit(route.lane_width_m, settings.car_width_m)
    rng = np.random.default_rng(0)
    starts = np.array([random_start(route, settings, rng) for _ in range(100)])
    assert np.abs(route.cross_track_numpy(starts)).max() < limit
    tiny = replace(room, camera=from_fov(8, 3, 90.0))
    environment = make_environment("mitsuba", tiny, Conditions(spp=1))
    around = PlaceSite("mitsuba", room).load_surroundings()
    grid, few = load_grid(room.objects[0]), replace(settings, horizon=2)
    for run in range(8):
        arguments = (route, RANDOM, run, [grid], around, few)
        driven = evaluate_run(environment, Counting(), *arguments)
        assert not driven.departed(limit).any()


def test_conditions_that_no_identity_has_are_refused():
    EnvironmentUnder("mitsuba", Conditions("evening", exposure_ev=1.0, spp=4))
    built_in: Any = ("an object",)
    for keys in ({"blur_px": 1.0}, {"noise_sd": 0.1}, {"built_in": built_in}):
        with refused_at("environment 'mitsuba'"):
            EnvironmentUnder("mitsuba", Conditions(**keys))
