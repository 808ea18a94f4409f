"""Random looks: what they change, within what limits, at what cost."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import toy_loop as toy

from mi_nerfattack.attack.black_box.random_looks import RandomLooks, equal_count, judge
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.errors import InputError
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum

pytestmark = pytest.mark.usefixtures("variant")


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
    found = np.concatenate([looks.offsets(number) for number in range(400)])
    assert not found[:, [1, 2, 3, 4]].any()
    for column, limit in ((0, 0.4), (5, 0.2)):
        values = found[:, column] / limit
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
