"""The verdict of a run, from figures that are known."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mi_nerfattack.evaluation.verdict import verdict


def case(mean: float, departed: int = 0, largest: float = 0.2) -> dict[str, object]:
    """Return the figures of drives from four starts that differ by a fifth."""
    errors = mean * np.array([0.8, 1.0, 1.0, 1.2])
    rows = [{"run": k, "cross_track_mean_m": e} for k, e in enumerate(errors)]
    return {
        "per_run": rows,
        "cross_track_mean_m": mean,
        "cross_track_max_m": largest,
        "drives_departed": departed,
        "n": 4,
    }


@pytest.fixture
def document():
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


def test_each_sentence_says_what_the_figures_say(document):
    policy, attack, transfer, search, texture = verdict(document, "surrogate")
    assert "is sound" in policy
    assert "0.20 m of the lane centre, where 0.85 m" in policy
    assert "beats random looks in the surrogate" in attack
    assert "0.300 m, 6.0 times that of random looks (95 % interval over 4" in attack
    assert "4 starts: 6.0 to 6.0)" in attack  # both sides by the same factor
    assert "3.0 times that of the best of them; 3 of 4 drives leave" in attack
    assert "does not transfer to mitsuba" in transfer
    assert "1.2 times" in transfer
    assert search == "The search has converged."
    assert "No texture is saturated: at most 30%" in texture


def test_the_interval_is_that_of_equal_starts(document):
    """The attack is strong from one start alone, so that its ratio is uncertain."""
    rows = document["routes"]["right"]["surrogate"]["attack"]["per_run"]
    for row, error in zip(rows, (0.04, 0.05, 0.05, 1.06), strict=True):
        row["cross_track_mean_m"] = error
    _, attack, *_ = verdict(document, "surrogate")
    low, high = map(float, re.findall(r"starts: ([\d.]+) to ([\d.]+)\)", attack)[0])
    assert low < 1.1 and high > 10


def test_what_speaks_against_an_attack_is_said(document):
    cases = document["routes"]["right"]["surrogate"]
    cases["own"], cases["attack"] = case(0.5, 4, 6.0), case(0.08)
    document |= {"converged": False, "textures": {"ball": {"saturated_share": 0.8}}}
    document["routes"]["right"]["mitsuba"]["attack"] = case(0.2)
    policy, attack, transfer = verdict(document, "surrogate")
    assert "not sound here: it leaves its lane by itself in surrogate (unatt" in policy
    assert "does not beat random looks" in attack
    assert "It transfers to mitsuba" in transfer
