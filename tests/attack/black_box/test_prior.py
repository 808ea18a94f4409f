"""The search around a prior: what a good one saves, and what a bad one costs."""

from __future__ import annotations

import numpy as np
import pytest

from mi_nerfattack.attack.black_box import (
    BlackBoxAttack,
    Judged,
    LowFrequency,
    PriorSearch,
    Proposal,
)
from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout

pytestmark = pytest.mark.usefixtures("variant")

DRIVES, SEEDS = 24, range(3)


@pytest.fixture(scope="module")
def basis() -> LowFrequency:
    """24 coefficients of a grey box on one level of 4 vertices an edge."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    field = GridField(GridLayout(1, 4, 4), -np.ones(3), np.ones(3))
    field.set_parameter("texture", np.zeros((field.n_vertices, 3), np.float32))
    return LowFrequency([Colours(field)], 24)


def bowl(basis: LowFrequency, lowest: np.ndarray):
    """Judge by the squared distance of raw colours from those of a lowest point."""
    [wanted] = basis.propose(lowest).textures

    def judge(proposal: Proposal) -> float:
        return 1000 * float(((proposal.textures[0] - wanted) ** 2).mean())

    return judge


def drive(basis: LowFrequency, judge, prior, seed: int) -> np.ndarray:
    """Return the least objective after each drive, as a share of the first one."""

    def judged(textures, on_step=None) -> Judged:
        del on_step
        return Judged(judge(Proposal(textures)), 0.0, 0.0, 10)

    search = PriorSearch(basis, prior, reach=0.25, seed=seed)
    attack = BlackBoxAttack(search, judged, 10 * DRIVES)
    while not attack.is_over:
        attack.step()
    curve = attack.curve()
    np.testing.assert_array_equal(curve[:, 0], 10 * np.arange(1, DRIVES + 1))
    return curve[:, 1] / curve[0, 1]


def drives_until(curves: list[np.ndarray], share: float) -> float:
    return float(np.mean([np.argmax(np.append(c, 0.0) <= share) + 1 for c in curves]))


def test_a_good_prior_saves_drives_and_a_bad_one_costs_few(basis):
    """Drives to halve the objective; priors are shifted and scaled, or opposite."""
    curves: dict[str, list[np.ndarray]] = {}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        lowest = rng.uniform(-0.2, 0.2, 24)
        judge = bowl(basis, lowest)
        near = bowl(basis, lowest + rng.normal(0, 0.03, 24))
        priors = {
            "none": None,
            "near": lambda proposal, near=near: 0.2 * near(proposal) - 7,
            "opposite": bowl(basis, -lowest),
            "unrelated": bowl(basis, rng.uniform(-0.2, 0.2, 24)),
        }
        for name, prior in priors.items():
            curves.setdefault(name, []).append(drive(basis, judge, prior, seed))
    needed = {name: drives_until(found, 0.5) for name, found in curves.items()}
    assert needed["near"] < 0.7 * needed["none"]
    for name in ("opposite", "unrelated"):
        assert needed[name] < 1.25 * needed["none"]


def test_the_scale_of_a_prior_is_learnt(basis):
    judge = bowl(basis, np.full(24, 0.1))
    scales = {}
    for name, prior in {
        "a third": lambda proposal: judge(proposal) / 3 + 40,
        "opposite": lambda proposal: -judge(proposal),
    }.items():
        search = PriorSearch(basis, prior, seed=2)
        for _ in range(12):
            search.tell(judge(search.ask()))
        search.ask()
        scales[name] = search.scale
    assert scales["a third"] == pytest.approx(3, rel=0.2)
    assert scales["opposite"] == 0


def test_it_begins_in_the_middle_and_keeps_within_reach(basis):
    asked, around = [], []

    def prior(proposal: Proposal) -> float:
        around.append(proposal.textures[0])
        return 0.0

    search = PriorSearch(basis, prior, reach=0.1, candidates=5, seed=3)
    for number in range(4):
        asked.append(search.ask().textures[0])
        assert search.ask().textures[0] is asked[-1]  # asked again
        assert len(around) == 1 + 5 * number
        search.tell(float(number))
    np.testing.assert_array_equal(asked[0], 0)
    assert any(np.array_equal(asked[1], one) for one in around[1:])
    colours = 1 / (1 + np.exp(-np.stack(around)))
    assert 0.05 < np.abs(colours - 0.5).max() < 0.1 + 1e-6


def test_a_search_that_is_told_the_same_goes_on_alike(basis):
    judge = bowl(basis, np.full(24, 0.1))
    first, second = (PriorSearch(basis, judge, seed=4) for _ in range(2))
    for _ in range(5):
        told = first.ask().textures[0], second.ask().textures[0]
        np.testing.assert_array_equal(*told)
        first.tell(judge(first.ask()))
        second.tell(judge(second.ask()))
    other = PriorSearch(basis, judge, seed=5)
    other.tell(judge(other.ask()))
    assert not np.array_equal(other.ask().textures[0], first.ask().textures[0])


def test_changes_are_around_other_colours(basis):
    [colouring] = basis.colourings
    middle = [np.full_like(colouring.start, 0.7)]
    moved = LowFrequency(basis.colourings, 3, middle)
    change = np.array([0.1, 0.0, -0.2])
    [texture] = moved.propose(change).textures
    colours = 1 / (1 + np.exp(-texture[colouring.level.vertices]))
    np.testing.assert_allclose(colours, np.tile(0.7 + change, (64, 1)), atol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reach": 0.0}, "a reach above 0"),
        ({"reach": float("nan")}, "a reach above 0"),
        ({"candidates": 0}, "0 candidates"),
    ],
)
def test_what_makes_no_sense_is_refused(basis, options, message):
    with pytest.raises(InputError, match=message):
        PriorSearch(basis, None, **options)
    with pytest.raises(InputError, match="81; at most 64"):
        PriorSearch(LowFrequency(basis.colourings, 81), None)
