"""Flags of a run and of several, each raised and not raised by known figures."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mi_nerfattack.evaluation.flags import black_box_better, noise_larger, run_flags
from mi_nerfattack.evaluation.pairs import Outcome, compare


def case(means: list[float], departed: int = 0) -> dict[str, object]:
    runs = [{"cross_track_mean_m": mean} for mean in means]
    return {"n": len(means), "drives_departed": departed, "per_run": runs}


def curve(frames: list[float], objective: list[float]) -> dict[str, list[float]]:
    return {"frames": frames, "objective": objective}


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


def only(document, name, without=(), by_gradient=True) -> str:
    [flag] = run_flags(document, without, by_gradient)
    assert flag.startswith(f"{name}: ")
    return flag


def test_a_good_run_raises_none(document):
    """Random looks reach -3 after 40 frames, as the gradient; one in eleven departs."""
    assert list(run_flags(document, [], True)) == []


def test_no_gradient(document):
    flag = only(document, "gradient zero", ["ball", "car"])
    assert "does not depend on ball, car; bring" in flag


def test_random_looks_that_find_more_are_an_alarm_on_gradients_alone(document):
    """After 40 frames, of which a look takes 10, the gradient is at -3."""
    document["baseline"]["objectives"][1] = -9.0
    flag = only(document, "black box better")
    assert "after 40 frames, random looks had come to an objective of -9," in flag
    assert "gradient to -3 " in flag
    assert list(run_flags(document, [], False)) == []
    del document["curve"]  # of an attack that went on by force
    assert list(run_flags(document, [], True)) == []


def test_methods_are_compared_at_frames_that_both_reach():
    gradient = curve([10, 30, 50], [0.0, -3.0, -4.0])
    blocks = curve([10, 20, 30, 40], [-1.0, -2.0, -3.5, -9.0])
    [flag] = black_box_better(gradient, {"blocks": blocks, "cma_es": gradient})
    assert "after 40 frames, blocks had come to an objective of -9, " in flag
    assert "gradient to -3 " in flag
    shorter = curve([10, 30], [-1.0, -3.5])  # the gradient's last then is -3
    assert len(list(black_box_better(gradient, {"blocks": shorter}))) == 1
    soon = curve([10, 20], [-1.0, -2.0])  # before its first iteration has ended
    assert list(black_box_better(gradient, {"blocks": soon})) == []
    assert list(black_box_better(blocks, {"cma_es": gradient})) == []
    late = curve([60], [-99.0])  # none of it with 50 frames
    assert list(black_box_better(gradient, {"blocks": late})) == []


def test_random_looks_that_suffice(document):
    document["routes"]["right"]["surrogate"]["random"] = case([0.05] * 10, 1)
    flag = only(document, "random enough")
    assert "in surrogate, 1 of 10 drives past random looks" in flag


def test_drives_that_differ_more_than_an_attack_adds(document):
    """Means 0.3 and 0.1; variances 0.5 and 0.02, so that the noise is 0.51."""
    cases = {"attack": case([-0.2, 0.8]), "random": case([0.0, 0.2])}
    document["routes"]["right"]["mitsuba"] = cases
    flag = only(document, "noise larger")
    assert "mean error in mitsuba (m), is 0.2, and" in flag
    assert "from drive to drive 0.51;" in flag
    cases["random"] = case([0.1])  # one says nothing
    assert list(run_flags(document, [], True)) == []


def test_seeds_that_differ_more_than_an_effect():
    """Differences 0.1 and 0.5: mean 0.3, standard deviation sqrt(0.08) = 0.28."""
    own = [Outcome("bend", s, "surrogate", "own", 0, 0, {"e": 0.0}) for s in range(2)]
    attack = [
        replace(drive, case="attack", figures={"e": value})
        for drive, value in zip(own, (0.1, 0.5), strict=True)
    ]
    effect = compare(attack, own, "e")
    assert list(noise_larger(effect, "mean error")) == []
    attack[0] = replace(attack[0], figures={"e": -0.1})  # 0.2, sqrt(0.18) = 0.42
    [flag] = noise_larger(compare(attack, own, "e"), "mean error")
    assert "mean error, is 0.2, and" in flag and "seed to seed 0.424;" in flag
    assert list(noise_larger(compare(attack[:1], own, "e"), "mean error")) == []


def test_an_attack_that_had_more_to_gain(document):
    """After 88 of 110 frames it is at -6, of -10 in the end and 0 before."""
    document["converged"] = False
    assert "gave 40% of all the gain" in only(document, "not converged")
    del document["curve"]  # of an attack that went on by force
    assert "gain" not in only(document, "not converged")


def test_a_texture_at_its_bounds(document):
    document["textures"]["car"] = {"saturated_share": 0.5, "picture_share": 0.1}
    assert "50% of the colour values of car" in only(document, "texture at its bounds")


def test_an_object_hardly_in_view(document):
    document["textures"]["car"] = {"saturated_share": 0.0, "picture_share": 0.00099}
    flag = only(document, "object hardly in view")
    assert "car takes 0.099 % of the pixels" in flag
