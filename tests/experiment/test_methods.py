"""Attacks by other methods than the gradient, as jobs."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from support.worlds.attacks import assert_same_drives, interrupt, job

from mi_nerfattack import cli
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.baseline import Baseline
from mi_nerfattack.experiment.run_folder import Effort
from mi_nerfattack.scenario.world import build_attack, build_world, judged_frames

pytestmark = pytest.mark.usefixtures("variant")

ITERATIONS = "method.max_iterations = 6"
SEARCHES = {
    "random": "",
    "blocks": ", first_block = 0.2",
    "cma_es": ', variant = "learning_rate", population = 4, coefficients = 24',
    "bayesian": ", coefficients = 3",
}


def keys(method: str, frames: int = 12) -> str:
    return f'method = {{ kind = "{method}", frames = {frames}{SEARCHES[method]} }}'


@pytest.mark.parametrize("method", ["random", "blocks", "cma_es", "bayesian"])
def test_searches_spend_their_frames_and_keep_the_best(
    folder, tmp_path, no_results, method
):
    """A drive has two periods: six of them are 12 frames, one more is begun."""
    work = job(folder, tmp_path / "run", (ITERATIONS, keys(method, 11)))
    world = build_world(work.scenario, work.policy)
    original = world.appearance()
    attack = build_attack(world)
    before = attack.rollout.measure(attack.initial).value
    assert attack.iteration == 0 and not attack.is_over
    while not attack.is_over:
        attack.step()
    attack.finish()
    assert attack.iteration == 6
    assert attack.curve(0.0)[0, 0] == judged_frames(work.scenario)
    objectives = [record.objective for record in attack.history]
    assert attack.best_objective == min(objectives) != before
    looks = Baseline.of(world, original, attack, Effort())
    assert looks.backward_multiple == 0  # six random looks cost as much
    texture = world.appearance().textures[0]
    assert not np.array_equal(texture, original.textures[0])
    after = attack.rollout.measure(attack.initial).value
    assert after == pytest.approx(min(objectives), rel=1e-5)
    work.run()
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_an_interrupted_search_goes_on(folder, tmp_path, no_results):
    change = (ITERATIONS, keys("cma_es"))
    uninterrupted = job(folder, tmp_path / "whole", change).run()
    output = tmp_path / "output"
    stage = "surrogate: optimisation", 9
    interrupt(folder, output, *stage, change=change)
    resumed = job(folder, output, change).run()
    assert_same_drives(resumed["drives"], uninterrupted["drives"])
    assert resumed["curve"] == uninterrupted["curve"]
    assert resumed["curve"]["frames"] == [2, 4, 6, 8, 10, 12]
    # by force it goes on in no other scenario
    other = keys("cma_es", 14)
    with pytest.raises(InputError, match="start a new run folder"):
        job(folder, output, (ITERATIONS, other)).run(force=True)


@pytest.mark.parametrize(
    "method", ['"open_loop", max_iterations = 3', '"single_frame", frame = 1']
)
def test_attacks_on_an_unattacked_path(folder, tmp_path, no_results, method):
    change = (ITERATIONS, f"method = {{ kind = {method} }}")
    work = job(folder, tmp_path / "run", change)
    world = build_world(work.scenario, work.policy)
    attack = build_attack(world)
    count = 3 if "open" in method else 48
    assert work.scenario.attack.method.iterations(2) == count
    attack.step()
    attack.step()
    assert attack.curve(1.0)[0, 0] == judged_frames(work.scenario)
    assert attack.history[1].objective < attack.history[0].objective
    # judged as an iteration drives: as many textures as drives there and back
    baseline = Baseline.of(
        world, world.appearance(), attack, Effort(forward_s=2, backward_s=2)
    )
    assert baseline.equal == 2 * 2


def test_searches_change_textures_alone(folder, tmp_path):
    text = keys("random") + '\nfreedom.kind = "both"'
    work = job(folder, tmp_path / "run", (ITERATIONS, text))
    with pytest.raises(InputError, match="searches change textures alone"):
        build_attack(build_world(work.scenario, work.policy))


def test_a_policy_without_derivatives_is_attacked(scenario_folder, tmp_path, capsys):
    """From check to the page; nothing is attributed, for that takes a gradient."""
    (scenario_folder / "mine.py").write_text(
        "def drive(image, goal, step):\n"
        "    return 3 * (image[..., :99].mean((1, 2, 3)) - image.mean((1, 2, 3)))\n"
    )
    text = (scenario_folder / "scenario.toml").read_text()
    policy = 'kind = "callable"\nfile = "mine.py:drive"\ntrust_code = true'
    text = re.sub(r"(?ms)^\[policy\]\n.*?(?=^\[)", f"[policy]\n{policy}\n\n", text)
    path, output = scenario_folder / "other.toml", tmp_path / "run"
    path.write_text(text)
    attack = ["attack", str(path), "-o", str(output)]
    assert cli.main(attack) == 2
    assert "derivatives" in capsys.readouterr().err
    path.write_text(text.replace("method.max_iterations = 3", keys("blocks", 16)))
    check = ["check", str(path), "--json", "-o", str(tmp_path / "seen.png")]
    assert cli.main(check) in (0, 1)
    cost = json.loads(capsys.readouterr().out.splitlines()[-1])["cost"]
    assert cost["iterations"] == 4 and cost["period_s"]["backward"] == 0
    assert cli.main([*attack, "--anyway"]) == 0
    assert len(json.loads((output / "attack.json").read_text())) == 4
    assert (output / "report.html").is_file() and (output / "strip.png").is_file()
    assert not list(output.glob("attribution*.png"))
