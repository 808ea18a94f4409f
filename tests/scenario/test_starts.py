"""Where drives start: those of an evaluation, and those of the optimisation."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.attack_jobs import write_scenario

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_attack, build_world

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def build(tmp_path):
    """Build the tiny scenario, with other keys of its drives."""

    def inner(keys):
        folder = write_scenario(tmp_path, {"horizon = 2\nruns = 2\n": keys})
        path = folder / "scenario.toml"
        path.write_text(path.read_text().replace("[attack]", "[attack]\nposes = 3"))
        scenario, _ = load_scenario(path)
        return build_world(scenario, scenario.policy.build())

    return inner


def test_evaluation_starts_where_no_optimisation_does(build):
    world = build("runs = 40\nstart_m = 71.0\n")
    attack = build_attack(world)
    mine = np.array(attack.initial).T[:, :3]
    nominal = [51.0, 0.0, 0.0]  # of a line from x = -20 to 60
    np.testing.assert_allclose(mine[0], nominal, atol=1e-5)
    apart = np.abs(world.initial[:, None] - mine[None]).max(axis=-1)
    assert apart.min() > 1e-6
    np.testing.assert_allclose(world.initial.mean(axis=0), nominal, atol=0.08)
    assert world.horizon == attack.rollout.horizon == 18  # 9 m to the end of the line


def test_start_beyond_the_route_is_refused(build):
    with pytest.raises(InputError, match=r"start_m: 80 m; route 'line' is 80.0 m long"):
        build("start_m = 80\n")
