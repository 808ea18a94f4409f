"""The verdict and the flags of a run, raised and not raised by known figures."""

from __future__ import annotations

import copy
import re

import numpy as np
import pandas as pd
import pytest

from mi_nerfattack.attack import plan
from mi_nerfattack.evaluation import flags
from mi_nerfattack.evaluation.flags import black_box_better, noise_larger, run_flags
from mi_nerfattack.evaluation.pairs import compare
from mi_nerfattack.evaluation.verdict import verdict


def case(means, departed: int = 0, largest: float = 0.2) -> dict[str, object]:
    """Return figures of drives of mean errors, or of five that differ by a fifth."""
    if isinstance(means, float):
        means = means * np.array([0.8, 0.9, 1.0, 1.1, 1.2])
    rows = [
        {"run": k, "seed": k, "cross_track_mean_m": mean, "steps_departed": 0}
        for k, mean in enumerate(means)
    ]
    return {
        "per_run": rows,
        "cross_track_mean_m": np.mean(means),
        "cross_track_max_m": largest,
        "drives_departed": departed,
        "n": len(means),
    }


def curve(frames: list[float], objective: list[float]) -> dict[str, list[float]]:
    return {"frames": frames, "objective": objective}


@pytest.fixture
def judged():
    cases = {
        "no_object": case(0.04),
        "own": case(0.05, largest=0.11),
        "random": case(0.05),
        "best_random": case(0.1),
        "attack": case(0.3, 3, 1.1),
    }
    weak = {**cases, "attack": case(0.06)}
    return {
        "routes": {"right": {"mitsuba": weak, "surrogate": cases}},
        "departure_limits_m": {"right": 0.85},
        "scenario": {"name": "a"},
        "seed": 0,
        "converged": True,
        "textures": {"ball": {"saturated_share": 0.3}, "car": {"saturated_share": 0}},
    }


def test_each_sentence_says_what_the_figures_say(judged):
    lane, policy, attack, transfer, search, texture = verdict(judged, "surrogate")
    for sentence, words in (
        (lane, ["leaves its lane in 3 of 5 drives in surrogate (at most 0.25 m"]),
        (lane, ["0 of 5 drives in mitsuba (0.65 m to spare)", "0.85 m"]),
        (policy, ["is sound", "0.20 m", "0.85 m"]),
        # both sides by the same factor
        (attack, ["beats", "0.300 m, 6.0 times", "5 starts: 6.0 to 6.0)"]),
        (attack, ["3.0 times that of the best of them"]),
        (transfer, ["does not transfer to mitsuba", "1.2 times"]),
        (search, ["converged"]),
        (texture, ["30%"]),
    ):
        assert all(word in sentence for word in words), sentence


def test_fewer_random_textures_than_the_attack_pays_for_are_told(judged):
    for equal, words in (
        (5, "times that of 5 random textures"),
        (12, "times that of 5 of the 12 random textures that its cost pays for"),
    ):
        judged["baseline"] = {"equal_textures": equal}
        _, _, attack, transfer, *_ = verdict(judged, "surrogate")
        assert words in attack and "times that of 5 random textures" in transfer


def test_the_interval_is_that_of_equal_starts(judged):
    """The attack is strong from one start alone, so that its ratio is uncertain."""
    cases = judged["routes"]["right"]["surrogate"]
    cases["attack"] = case([0.04, 0.05, 0.05, 0.05, 1.06])
    _, _, attack, *_ = verdict(judged, "surrogate")
    low, high = map(float, re.findall(r"starts: ([\d.]+) to ([\d.]+)\)", attack)[0])
    assert low < 1.1 and high > 10
    for figures in cases.values():
        figures["per_run"] = figures["per_run"][:4]
    _, _, attack, *_ = verdict(judged, "surrogate")
    assert "interval" not in attack


def test_what_speaks_against_an_attack_is_said(judged):
    cases = judged["routes"]["right"]["surrogate"]
    cases["own"], cases["attack"] = case(0.5, 4, 6.0), case(0.08)
    judged |= {"converged": False, "textures": {"ball": {"saturated_share": 0.8}}}
    judged["routes"]["right"]["mitsuba"]["attack"] = case(0.2)
    _, policy, attack, transfer = verdict(judged, "surrogate")
    assert "not sound" in policy and "in surrogate (unattacked)" in policy
    assert "does not beat" in attack and "It transfers to mitsuba" in transfer


def with_objectives(cases, **objectives):
    """Give each drive of cases an objective; None where there is none."""
    for name, values in objectives.items():
        rows = cases[name]["per_run"]
        for row, value in zip(rows, np.broadcast_to(values, len(rows)), strict=True):
            row["objective"] = value
        known = None not in [row["objective"] for row in rows]
        mean = float(np.mean([row["objective"] for row in rows])) if known else None
        cases[name]["objective"] = mean


def objective_of(judged, attack, random=-155.0, best=-178.0):
    """Return the sentence on an attack by an objective that is -150 unattacked."""
    judged["objective"] = {"name": "rail.py:keeps_going", "missing": {"mitsuba": "so"}}
    route = judged["routes"]["right"]
    route["mitsuba"] = copy.deepcopy(route["mitsuba"])
    own = np.array([-148, -149, -150, -151, -152])
    shown = {"best_random": best, "random": random, "attack": attack}
    with_objectives(route["surrogate"], no_object=-180.0, own=own, **shown)
    names = ("no_object", "own", "random", "best_random", "attack")
    with_objectives(route["mitsuba"], **dict.fromkeys(names))
    _, _, sentence, missing, *_ = verdict(judged, "surrogate")
    assert "no value in mitsuba" in missing and missing.endswith(": so.")
    return sentence


@pytest.mark.parametrize(
    ("figures", "beats"),
    [
        ({"attack": -180.0}, True),  # a gain of 30; random textures 5, the best 28
        ({"attack": -177.0}, False),  # the best of them gains more
        ({"attack": -180.0, "random": -166.0}, False),  # less than twice 16
        ({"attack": -149.0, "random": -140.0, "best": -145.0}, False),  # no gain
        ({"attack": -151.0, "random": -140.0, "best": -145.0}, True),
        ({"attack": 7.0, "random": 90.0, "best": 8.0}, False),
    ],
)
def test_an_objective_is_judged_by_what_it_falls(judged, figures, beats):
    sentence = objective_of(judged, **figures)
    assert sentence.startswith("The attack beats" if beats else "The attack does not")


def test_the_sentence_on_an_objective_has_its_numbers(judged):
    """From -150 to -180, as without objects: all that they add."""
    sentence = objective_of(judged, np.array([-178, -179, -180, -181, -182]))
    words = ["keeps_going is -180.0 with it and -150.0 unattacked", "gain of 30 "]
    words += ["over 5 starts: 30 to 30); without objects it is -180.0", "removes 100%"]
    words += ["random textures gain 5 in the mean and the best of them 28."]
    assert all(word in sentence for word in words), sentence


def test_noise_is_that_of_the_objective(judged):
    objective_of(judged, np.array([-100, -200, -150, -150, -190]), best=-150.0)
    judged |= {"baseline": {"objectives": []}, "textures": {}}
    flags = list(run_flags(judged, (), False))
    [flag] = [flag for flag in flags if "objective in surrogate" in flag]
    assert "is 3, " in flag  # from -155 to -158
    assert not [flag for flag in flags if "mitsuba" in flag and "noise" in flag]


@pytest.fixture
def document():
    """A run that no flag speaks against."""
    cases = {"random": case([0.05] * 11, 1), "attack": case([0.3, 0.5], 2)}
    return {
        "routes": {"right": {"surrogate": cases, "mitsuba": {"own": case([0.02])}}},
        "converged": True,
        "curve": curve([10, 30, 50, 70, 90, 110], [0.0, -3.0, -4.0, -6.0, -8.0, -10.0]),
        "baseline": {"objectives": [-1.0, -1.5, -3.0, -0.5]},
        "textures": {"ball": {"saturated_share": 0.49, "picture_share": 0.001}},
    }


def check(document, name, *numbers, without=(), by_gradient=True) -> None:
    """Check that one flag is raised, and what it gives; without a name, none."""
    flags = list(run_flags(document, without, by_gradient))
    assert len(flags) == bool(name), flags
    for flag in flags:
        assert flag.startswith(f"{name}: ")
        assert all(number in flag for number in numbers), flag


def test_a_good_run_raises_none(document):
    """Random looks reach -3 after 40 frames, as the gradient; one in eleven departs."""
    check(document, "")
    check(document, "gradient zero", "ball, car", without=["ball", "car"])


def test_a_gradient_of_which_hardly_anything_comes_is_told(document):
    document["least_gain"] = {"first": 7, "predicted": 40.0, "gain": 0.4}
    check(document, "")
    document["least_gain"]["gain"] = 0.399
    check(document, "gradient misleads", "from 7 on", "falls by 40", "by 0.399")


def test_random_looks_that_find_more_are_an_alarm_on_gradients_alone(document):
    """After 40 frames, of which a look takes 10, the gradient is at -3."""
    document["baseline"]["objectives"][1] = -9.0
    check(document, "black box better", "40 frames", "-9,", "-3 ")
    check(document, "", by_gradient=False)
    del document["curve"]  # of an attack that went on by force
    check(document, "")


def test_random_textures_without_limits_say_nothing_of_a_limited_attack(document):
    document["baseline"]["objectives"][1] = -9.0
    freedom = {"linf": None, "lowest": None, "fixed_m": [], "total_variation": 0.0}
    document["scenario"] = {"attack": {"freedom": freedom, "method": {}}}
    check(document, "black box better")
    for limit in ({"linf": 0.1}, {"l2": 0.1}, {"lowest": 0.2}, {"gamut": "cmyk.icc"}):
        document["scenario"]["attack"]["freedom"] = freedom | limit
        check(document, "")


def test_methods_are_compared_at_frames_that_both_reach():
    gradient = curve([10, 30, 50], [0.0, -3.0, -4.0])
    blocks = curve([10, 20, 30, 40], [-1.0, -2.0, -3.5, -9.0])
    [flag] = black_box_better(gradient, {"blocks": blocks, "cma_es": gradient})
    assert all(word in flag for word in ("40 frames, blocks", "-9, ", "-3 "))
    shorter = curve([10, 30], [-1.0, -3.5])  # the gradient's last then is -3
    assert len(list(black_box_better(gradient, {"blocks": shorter}))) == 1
    soon = curve([10, 20], [-1.0, -2.0])  # before its first iteration has ended
    assert list(black_box_better(gradient, {"blocks": soon})) == []
    assert list(black_box_better(blocks, {"cma_es": gradient})) == []
    late = curve([60], [-99.0])  # none of it with 50 frames
    assert list(black_box_better(gradient, {"blocks": late})) == []


def test_random_looks_that_suffice(document):
    document["routes"]["right"]["surrogate"]["random"] = case([0.05] * 10, 1)
    check(document, "random enough", "in surrogate", "1 of 10")


def test_drives_that_differ_more_than_an_attack_adds(document):
    """Means 0.3 and 0.1; variances 0.5 and 0.02, so that the noise is 0.51."""
    cases = {"attack": case([-0.2, 0.8]), "random": case([0.0, 0.2])}
    document["routes"]["right"]["mitsuba"] = cases
    check(document, "noise larger", "in mitsuba (m), is 0.2,", "drive to drive 0.51;")
    cases["random"] = case([0.1])  # one says nothing
    check(document, "")


def test_seeds_that_differ_more_than_an_effect():
    """Differences 0.1 and 0.5: mean 0.3, standard deviation sqrt(0.08) = 0.28."""
    columns = {"scenario": "bend", "environment": "surrogate", "run": 0, "start": 0}
    own = pd.DataFrame({"seed": [0, 1], "e": [0.0, 0.0]}).assign(case="own", **columns)
    attack = own.assign(case="attack", e=[0.1, 0.5])
    assert list(noise_larger(compare(attack, own, "e"), "error")) == []
    attack["e"] = [-0.1, 0.5]  # 0.2, sqrt(0.18) = 0.42
    [flag] = noise_larger(compare(attack, own, "e"), "error")
    assert "error, is 0.2," in flag and "seed to seed 0.424;" in flag
    assert list(noise_larger(compare(attack[:1], own, "e"), "error")) == []


def test_an_attack_that_had_more_to_gain(document):
    """No share is told: the document does not hold that of the criterion."""
    document["converged"] = False
    check(document, "not converged")
    assert "%" not in next(run_flags(document, (), True))
    del document["curve"]  # of an attack that went on by force
    check(document, "not converged", "still gaining, had gained nothing, or")


@pytest.mark.parametrize(
    ("objectives", "words"),
    [
        ([-1.0 * k for k in range(13)], "9 iterations at full rates, and 10"),  # of 12
        ([-1.0 * k for k in range(14)], "it was still gaining;"),
        ([-1.0] * 14, "it gained nothing;"),
    ],
)
def test_why_an_attack_has_not_converged(document, objectives, words):
    """Rates are full for three quarters of the iterations."""
    document |= {"converged": False, "baseline": {"objectives": [0.0]}}
    document["curve"] = curve([10 + 20 * k for k in range(len(objectives))], objectives)
    check(document, "not converged", words)
    assert flags.FEWEST == plan._FEWEST


def test_random_textures_are_not_compared_with_the_tries_of_an_opening(document):
    """A quarter of 16 iterations, of 20 frames each: the tries end with 90 frames."""
    document["curve"] = curve([10 + 20 * k for k in range(17)], [-2.0] * 17)
    method = {"opening": "sides", "opening_share": 0.25, "max_iterations": 16}
    document["scenario"] = {"attack": {"method": method}}
    document["baseline"]["objectives"] = [-9.0] * 9
    check(document, "")
    document["baseline"]["objectives"] = [-9.0] * 10
    check(document, "black box better")
    method["opening"] = "none"
    document["baseline"]["objectives"] = [-9.0] * 9
    check(document, "black box better")


def test_textures_at_their_bounds_and_out_of_view(document):
    document["textures"]["car"] = {"saturated_share": 0.5, "picture_share": 0.1}
    check(document, "texture at its bounds", "50%", "car")
    document["textures"]["car"] = {"saturated_share": 0.0, "picture_share": 0.00099}
    check(document, "object hardly in view", "car takes 0.099 %")
