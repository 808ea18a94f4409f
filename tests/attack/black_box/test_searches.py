"""Searches without derivatives: what they propose, and that they get somewhere."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.attack.black_box import (
    BayesianSearch,
    BlackBoxAttack,
    BlockSearch,
    EvolutionSearch,
    Judged,
    LowFrequency,
    RandomSearch,
    SurrogateJudge,
)
from mi_nerfattack.attack.black_box.low_frequency import lattice
from mi_nerfattack.attack.black_box.random_looks import RandomLooks
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.texture.colours import Colours, vertex_colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, Occupancy
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum

pytestmark = pytest.mark.usefixtures("variant")

PROPOSALS = 200


def grey(count: int = 1) -> list[GridField]:
    """Return boxes of one colour on one level of 8 vertices an edge."""
    fields = []
    for _ in range(count):
        field = GridField(GridLayout(1, 8, 8), -np.ones(3), np.ones(3))
        field.set_parameter("texture", np.zeros((field.n_vertices, 3), np.float32))
        fields.append(field)
    return fields


class Wanted:
    """Judges by the distance to colours, which are others in each eighth of a box."""

    def __init__(self, fields: list[GridField]) -> None:
        self.fields = fields
        edge = fields[0].levels()[-1].resolution
        half = (np.arange(edge) >= edge // 2).astype(np.float32)
        self.wanted = np.stack(np.meshgrid(half, half, half), -1).reshape(-1, 3)

    def __call__(self, textures, on_step=None) -> Judged:
        del on_step
        far = []
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)
            found = vertex_colours(field, field.levels()[-1])
            far.append(np.abs(found - self.wanted).mean())
        return Judged(float(np.mean(far)), 0.0, 0.0, 1)


def make(kind: str, fields: list[GridField], seed: int = 1):
    colourings = [Colours(field) for field in fields]
    if kind == "random":
        return RandomSearch(RandomLooks(fields, Freedom(0.3), "mixed", seed))
    if kind == "blocks":
        return BlockSearch(colourings, fields, PROPOSALS, seed=seed)
    if kind == "bayesian":
        return BayesianSearch(LowFrequency(colourings, 6), seed=seed)
    return EvolutionSearch(LowFrequency(colourings, 32), kind, seed=seed)


def attacked(kind: str, count: int = 1, proposals: int = PROPOSALS) -> BlackBoxAttack:
    fields = grey(count)
    attack = BlackBoxAttack(make(kind, fields), Wanted(fields), proposals)
    while not attack.is_over:
        attack.step()
    return attack


@pytest.fixture(scope="module")
def floor() -> float:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return attacked("random").curve()[-1, 1]


@pytest.mark.parametrize("kind", ["blocks", "separable", "learning_rate"])
def test_searches_get_nearer(kind, floor):
    """Evolution nearer than the best random texture, blocks than the first ones."""
    curve = attacked(kind).curve()
    assert curve[-1, 1] < (0.85 * curve[0, 1] if kind == "blocks" else 0.8 * floor)
    assert (np.diff(curve[:, 1]) <= 0).all()
    np.testing.assert_array_equal(curve[:, 0], np.arange(1, PROPOSALS + 1))


def test_a_gaussian_process_finds_the_colours_of_two_boxes():
    fields = grey(2)
    judge = Wanted(fields)
    judge.wanted = np.array([0.9, 0.1, 0.5])
    attack = BlackBoxAttack(make("bayesian", fields), judge, 40)
    while not attack.is_over:
        attack.step()
    drawn, found = attack.curve()[[9, -1], 1]  # the first ten are random
    assert found < 0.5 * drawn


@pytest.mark.parametrize("kind", ["random", "blocks", "separable", "bayesian"])
def test_an_attack_that_is_told_the_same_goes_on_alike(kind):
    whole = attacked(kind, proposals=16)
    half = attacked(kind, proposals=12)
    fields = grey()
    again = BlackBoxAttack(make(kind, fields), Wanted(fields), 16)
    again.load_tensors(half.tensors())
    while not again.is_over:
        again.step()
    assert again.history == whole.history
    np.testing.assert_array_equal(again.best, whole.best)


def test_seeds_give_other_proposals():
    for kind in ("random", "blocks", "separable"):
        first, second = (make(kind, grey(), seed).ask().textures for seed in (1, 2))
        assert not np.array_equal(first, second)


def test_low_frequencies_are_interpolated_and_projected():
    fields = grey(2)
    colourings = [Colours(f, constraints=Constraints(linf=0.2)) for f in fields]
    basis = LowFrequency(colourings, 2 * 3 * 8)
    assert basis.count == 48
    zero = basis.propose(np.zeros(48))
    np.testing.assert_array_equal(zero.textures[0], fields[0].texture.numpy())
    change = np.zeros((2, 2, 2, 2, 3))
    change[1, 1, :, :, 0] = 0.1  # more red to the right in the second
    change[1, :, :, :, 2] = 1.0  # as blue as is allowed
    for field, texture in zip(
        fields, basis.propose(change.ravel()).textures, strict=True
    ):
        field.set_parameter("texture", texture)
    first, second = (vertex_colours(f, f.levels()[-1]) for f in fields)
    np.testing.assert_allclose(first, 0.5, atol=1e-6)
    cube = second.reshape(8, 8, 8, 3)
    np.testing.assert_allclose(cube[2, 5, :, 0], np.linspace(0.5, 0.6, 8), atol=1e-4)
    np.testing.assert_allclose(cube[..., 2], 0.7, atol=1e-4)


@pytest.mark.parametrize(
    ("extent", "most", "counts"),
    [
        ([1, 1, 1], 1, (1, 1, 1)),
        ([1, 1, 1], 8, (2, 2, 2)),
        ([1, 1, 1], 27, (3, 3, 3)),
        ([4.2, 1.8, 1.5], 3, (3, 1, 1)),
        ([4.2, 1.8, 1.5], 14, (3, 2, 2)),
        ([1, 1, 9], 5, (1, 1, 5)),
    ],
)
def test_lattices_have_as_many_vertices_as_are_allowed(extent, most, counts):
    assert lattice(np.array(extent, float), most) == counts


def test_lattices_lie_along_an_object():
    """Two vertices of a long object are its ends, each coefficient a channel there."""
    field = grey()[0]
    colouring = Colours(field)
    colouring.extent = np.array([1.0, 5.0, 1.0])
    basis = LowFrequency([colouring], 8)
    assert basis.count == 6
    texture = basis.propose(np.array([0, 0, 0, 0, 0.2, 0])).textures[0]
    field.set_parameter("texture", texture)
    cube = vertex_colours(field, field.levels()[-1]).reshape(8, 8, 8, 3)
    np.testing.assert_allclose(cube[3, :, 2, 1], np.linspace(0.5, 0.7, 8), atol=1e-4)
    np.testing.assert_allclose(cube[..., [0, 2]], 0.5, atol=1e-6)


def test_blocks_lie_where_the_object_is_and_shrink():
    [field] = grey()
    cells = np.zeros((8, 8, 8), bool)
    cells[6:, :2, :] = True  # large x, small y
    field.occupancy = Occupancy(cells)
    search = BlockSearch([Colours(field)], [field], 1000, share=0.02)
    sides, touched = [], np.zeros((8, 8, 8), bool)
    before = search.ask().textures[0]
    search.tell(0.0)  # nothing is better
    for _ in range(300):
        changed = (search.ask().textures[0] != before).any(1)[:512]
        search.tell(1.0)
        cube = changed.reshape(8, 8, 8)
        touched |= cube
        sides.append(round(float(np.cbrt(cube.sum()))))
    assert max(sides) == 2 and set(sides[-100:]) <= {0, 1}
    z, y, x = np.nonzero(touched)
    assert x.min() >= 4 and y.max() <= 3 and set(z) == set(range(8))


def test_penalties_count(monkeypatch):
    fields = grey()
    search = make("separable", fields)
    monkeypatch.setattr(Colours, "penalty", lambda self, value: 5.0)
    judge = Wanted(fields)
    judged = BlackBoxAttack(search, judge, 1).step()
    assert judged.objective > 5


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (lambda c, f: LowFrequency(c * 2, 5), "2 objects need at least 6"),
        (lambda c, f: EvolutionSearch(LowFrequency(c, 3), "all"), "one of separable"),
        (lambda c, f: EvolutionSearch(LowFrequency(c, 3), population=1), "at least 2"),
        (lambda c, f: BayesianSearch(LowFrequency(c, 81)), "81; at most 64"),
        (lambda c, f: BlockSearch(c, f, 0), "0 proposals"),
        (lambda c, f: BlockSearch(c, f, 9, 0.0), "share 0"),
        (lambda c, f: BlackBoxAttack(make("blocks", f), Wanted(f), 0), "frames: 0"),
        (
            lambda c, f: RandomSearch(RandomLooks(f, Freedom(None, 0.1), "flat", 0)),
            "may not change",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(work, message):
    fields = grey()
    with pytest.raises(InputError, match=message):
        work([Colours(field) for field in fields], fields)


def test_a_history_of_another_kind_is_refused():
    attack = BlackBoxAttack(make("blocks", grey()), Wanted(grey()), 5)
    with pytest.raises(InputError, match="history: shape"):
        attack.load_tensors({"history": np.zeros((2, 3))})


def test_an_objective_that_is_no_number_ends_the_attack():
    fields = grey()

    def judge(textures, on_step=None):
        return Judged(float("nan"), 0.0, 0.0, 4)

    with pytest.raises(InputError, match="objective: nan after 0 frames"):
        BlackBoxAttack(make("blocks", fields), judge, 8).step()


def test_drives_are_judged_as_the_gradient_judges_its_own():
    from mi_nerfattack.attack.gradient import GradientAttack

    loop, field = toy.make_loop()
    initial = loop.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    rollout = Rollout(loop, StageSum(toy.square_error), 5)
    record = GradientAttack(rollout, toy.ROUTE, initial).measure()
    judged = SurrogateJudge(rollout, toy.ROUTE, initial)([toy.texture_of(field)])
    assert judged.frames == 10
    found = judged.objective, judged.cross_track_mean_m, judged.cross_track_max_m
    assert found == pytest.approx(astuple(record)[1:4], rel=1e-5)
