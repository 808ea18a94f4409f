"""Searches without derivatives, random looks: what they propose and where they get."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from support.worlds import loops as toy

from mi_nerfattack.attack.base import Freedom
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
from mi_nerfattack.attack.black_box.random_looks import RandomLooks, equal_count, judge
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
    fields = [
        GridField(GridLayout(1, 8, 8), -np.ones(3), np.ones(3)) for _ in range(count)
    ]
    for field in fields:
        field.set_parameter("texture", np.zeros((field.n_vertices, 3), np.float32))
    return fields


class ColourJudge:
    """Judges by the distance to colours, which are others in each eighth of a box."""

    def __init__(self, fields: list[GridField]) -> None:
        self.fields = fields
        edge = fields[0].levels()[-1].resolution
        half = (np.arange(edge) >= edge // 2).astype(np.float32)
        self.target = np.stack(np.meshgrid(half, half, half), -1).reshape(-1, 3)

    def __call__(self, textures, on_step=None) -> Judged:
        del on_step
        far = []
        for field, texture in zip(self.fields, textures, strict=True):
            field.set_parameter("texture", texture)
            colours = vertex_colours(field, field.levels()[-1])
            far.append(np.abs(colours - self.target).mean())
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
    attack = BlackBoxAttack(make(kind, fields), ColourJudge(fields), proposals)
    while not attack.is_over:
        attack.step()
    return attack


@pytest.fixture(scope="module")
def floor() -> float:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return attacked("random").curve()[-1, 1]


def test_random_textures_of_a_search_keep_the_limits():
    fields = grey()
    limits = Constraints(linf=0.05, total_variation=2.0)
    limited = [Colours(field, constraints=limits) for field in fields]
    looks = RandomLooks(fields, Freedom(0.3), "mixed", 1)
    proposal = RandomSearch(looks, limited).ask()
    fields[0].set_parameter("texture", proposal.textures[0])
    colours = vertex_colours(fields[0], fields[0].levels()[-1])
    change = np.abs(colours - limited[0].start)
    assert 0.04 < change.max() < 0.0501 and proposal.penalty > 0
    fields[0].set_parameter("texture", np.zeros_like(proposal.textures[0]))
    free = RandomSearch(looks, [Colours(field) for field in fields]).ask()
    np.testing.assert_array_equal(free.textures[0], looks.textures(0)[0])
    assert free.penalty == 0


@pytest.mark.parametrize("kind", ["blocks", "separable", "learning_rate"])
def test_searches_get_nearer(kind, floor):
    """Evolution nearer than the best random texture, blocks than the first ones."""
    curve = attacked(kind).curve()
    assert curve[-1, 1] < (0.85 * curve[0, 1] if kind == "blocks" else 0.8 * floor)
    assert (np.diff(curve[:, 1]) <= 0).all()
    np.testing.assert_array_equal(curve[:, 0], np.arange(1, PROPOSALS + 1))


def test_a_gaussian_process_finds_the_colours_of_two_boxes():
    fields = grey(2)
    judge = ColourJudge(fields)
    judge.target = np.array([0.9, 0.1, 0.5])
    attack = BlackBoxAttack(make("bayesian", fields), judge, 40)
    while not attack.is_over:
        attack.step()
    drawn, best = attack.curve()[[9, -1], 1]  # the first ten are random
    assert best < 0.5 * drawn


@pytest.mark.parametrize("kind", ["random", "blocks", "separable", "bayesian"])
def test_an_attack_that_is_told_the_same_goes_on_alike(kind):
    uninterrupted = attacked(kind, proposals=16)
    half = attacked(kind, proposals=12)
    fields = grey()
    again = BlackBoxAttack(make(kind, fields), ColourJudge(fields), 16)
    again.load_tensors(half.tensors())
    while not again.is_over:
        again.step()
    assert again.history == uninterrupted.history
    np.testing.assert_array_equal(again.best, uninterrupted.best)


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
    textures = basis.propose(change.ravel()).textures
    for field, texture in zip(fields, textures, strict=True):
        field.set_parameter("texture", texture)
    first, second = (vertex_colours(f, f.levels()[-1]) for f in fields)
    np.testing.assert_allclose(first, 0.5, atol=1e-6)
    cube = second.reshape(8, 8, 8, 3)
    np.testing.assert_allclose(cube[2, 5, :, 0], np.linspace(0.5, 0.6, 8), atol=1e-4)
    np.testing.assert_allclose(cube[..., 2], 0.7, atol=1e-4)


def test_lattices_have_as_many_vertices_as_are_allowed():
    for most, counts in ((1, (1, 1, 1)), (8, (2, 2, 2)), (27, (3, 3, 3))):
        assert lattice(np.ones(3), most) == counts
    car = np.array([4.2, 1.8, 1.5])
    assert [lattice(car, most) for most in (3, 14)] == [(3, 1, 1), (3, 2, 2)]


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
    monkeypatch.setattr(Colours, "penalty", lambda self, value: 5.0)
    attack = BlackBoxAttack(make("separable", fields), ColourJudge(fields), 1)
    assert attack.step().objective > 5


def nowhere(textures, on_step=None):
    return Judged(float("nan"), 0.0, 0.0, 4)


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (lambda c, f: LowFrequency(c * 2, 5), "2 .* 6"),
        (lambda c, f: EvolutionSearch(LowFrequency(c, 3), "all"), "separable"),
        (lambda c, f: EvolutionSearch(LowFrequency(c, 3), population=1), "2"),
        (lambda c, f: BayesianSearch(LowFrequency(c, 81)), "81; .* 64"),
        (lambda c, f: BlockSearch(c, f, 0), "0 proposals"),
        (lambda c, f: BlockSearch(c, f, 9, 0.0), "share 0"),
        (
            lambda c, f: BlackBoxAttack(make("blocks", f), ColourJudge(f), 0),
            "frames: 0",
        ),
        (
            lambda c, f: RandomSearch(RandomLooks(f, Freedom(None, 1), "flat", 0)),
            "may not",
        ),
        (
            lambda c, f: BlackBoxAttack(
                make("blocks", f), ColourJudge(f), 5
            ).load_tensors({"history": np.zeros((2, 3))}),
            "history: shape",
        ),
        (
            lambda c, f: BlackBoxAttack(make("blocks", f), nowhere, 8).step(),
            "objective: nan",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(work, message):
    fields = grey()
    with pytest.raises(InputError, match=message):
        work([Colours(field) for field in fields], fields)


def test_drives_are_judged_as_the_gradient_judges_its_own():
    from mi_nerfattack.attack.gradient import GradientAttack

    loop, field = toy.make_loop()
    initial = loop.initial(np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.05]]))
    rollout = Rollout(loop, StageSum(toy.square_error), 5)
    record = GradientAttack(rollout, toy.ROUTE, initial).measure()
    judged = SurrogateJudge(rollout, toy.ROUTE, initial)([toy.texture_of(field)])
    assert judged.frames == 10
    actual = judged.objective, judged.cross_track_mean_m, judged.cross_track_max_m
    assert actual == pytest.approx(astuple(record)[1:4], rel=1e-5)


def draws(freedom, seed=3):
    _, field = toy.make_loop()
    return RandomLooks([field], freedom, "mixed", seed)


def test_what_the_attack_may_not_change_is_left_alone():
    poses = dict(pose_rate=0.02, axes=("x", "yaw"), limit_m=0.4, limit_rad=0.2)
    texture, pose = draws(Freedom(0.3)), draws(Freedom(None, **poses))
    both = draws(Freedom(0.3, **poses))
    assert texture.offsets(0) is None and pose.textures(0) is None
    np.testing.assert_array_equal(both.textures(1)[0], texture.textures(1)[0])
    np.testing.assert_array_equal(both.offsets(1), pose.offsets(1))


def test_poses_fill_the_limits_and_nothing_else():
    axes = ("x", "yaw")
    looks = draws(Freedom(None, 0.02, axes, limit_m=0.4, limit_rad=0.2))
    offsets = np.concatenate([looks.offsets(number) for number in range(400)])
    assert not offsets[:, [1, 2, 3, 4]].any()
    for column, limit in ((0, 0.4), (5, 0.2)):
        values = offsets[:, column] / limit
        assert 0.97 < values.max() <= 1 and -1 <= values.min() < -0.97
        assert values.std() == pytest.approx(1 / np.sqrt(3), rel=0.1)


def test_numbers_and_seeds_give_other_looks_and_again_the_same():
    freedom = Freedom(0.3, 0.02)
    first, again, other = draws(freedom), draws(freedom), draws(freedom, seed=4)
    for name in ("textures", "offsets"):
        value = np.array(getattr(first, name)(2))
        np.testing.assert_array_equal(value, getattr(again, name)(2))
        assert not np.array_equal(value, getattr(first, name)(3))
        assert not np.array_equal(value, getattr(other, name)(2))


def test_as_many_drives_as_the_attack_costs():
    assert equal_count(16, 1.0) == 32  # a pass back like a drive: two an iteration
    assert equal_count(16, 2.3) == 53
    assert equal_count(1, 0.0) == 1


def test_looks_are_judged_by_the_attacks_objective():
    loop, field = toy.make_loop()
    rollout = Rollout(loop, StageSum(toy.square_error), 4)
    poses = loop.initial(np.array([[0.0, 0.35, 0.02], [0.5, -0.2, 0.0]]))
    field.set_parameter("texture", draws(Freedom(0.3)).textures(0)[0])
    steps = []
    value = judge(rollout, poses, steps.append)
    assert value == pytest.approx(rollout.run(poses).value, rel=1e-6)
    assert steps == [0, 1, 2, 3]
    nowhere = Rollout(loop, StageSum(lambda state: state[0] * np.nan), 2)
    with pytest.raises(InputError, match="objective: nan"):
        judge(nowhere, poses, None)
