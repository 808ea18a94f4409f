"""Closed-loop validation, and the way from frames to a policy."""

from __future__ import annotations

import mi_nerfattack  # noqa: F401  before drjit

# isort: split
import numpy as np
import pytest
from roadside import (
    Constant,
    StateSensor,
    bent,
    flat_ground,
    small,
    small_grid,
    straight,
)

from mi_nerfattack import cli, files
from mi_nerfattack.commands.bars import StageBars
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.policy.adapter import TorchPolicy
from mi_nerfattack.policy.collect import World
from mi_nerfattack.policy.evaluate import (
    EvaluateSettings,
    card_table,
    drive_routes,
    policy_card,
)
from mi_nerfattack.policy.imitate import ImitationSettings, imitate
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.policy.train import TrainSettings
from mi_nerfattack.policy.worlds import WorldFiles, load_deployment, load_surrogate
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def grid(variant) -> GridField:
    return small_grid()


def test_errors_of_a_straight_drive_are_the_initial_ones():
    """With control 0 the error is e0 + v t sin(psi0)."""
    settings = EvaluateSettings(runs=5, horizon=20)
    world = World("surrogate", StateSensor(), (), flat_ground)
    drives = drive_routes(Constant(0.0), [world], [straight()], settings)
    assert [drive.run for drive in drives] == list(range(5))
    for drive in drives:
        _, lateral, heading = drive.states[0]
        expected = lateral + 5.0 * drive.time_s * np.sin(heading)
        np.testing.assert_allclose(drive.cross_track_m, expected, atol=1e-6)
    laterals = [drive.states[0, 1] for drive in drives]
    assert 0.02 < np.std(laterals) < 0.3
    card = policy_card(drives, [straight()])
    figures = card["routes"]["straight"]["surrogate"]["unperturbed"]
    assert figures["n"] == 5
    errors = [np.abs(drive.cross_track_m) for drive in drives]
    assert figures["cross_track_mean_m"] == pytest.approx(np.mean(errors))
    assert card_table(card).row_count == 1


def test_validation_ends_before_the_route_does():
    settings = EvaluateSettings(margin_m=2.0)
    assert settings.steps(straight()) == 76  # (40 - 2) m at 0.5 m a step
    assert EvaluateSettings(horizon=9).steps(straight()) == 9


def test_random_objects_are_the_same_in_both_worlds(grid):
    seen, textures = [], []
    for name in ("surrogate", "deployment"):
        sensor = StateSensor()
        world = World(name, sensor, (grid,), flat_ground)
        settings = EvaluateSettings(runs=2, objects=2)
        drives = drive_routes(Constant(0.0), [world], [straight()], settings)
        cases = [(drive.case, drive.run) for drive in drives]
        assert cases[:2] == [("unperturbed", 0), ("unperturbed", 1)]
        assert cases[2:] == [("random", run) for run in range(4)]
        assert not any(sensor.seen[:76])
        assert all(sensor.seen[76:])
        seen.append([objects[0].pose.translation for objects in sensor.seen[76::76]])
        textures.append(grid.texture.numpy())
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0][0], seen[0][1])
    np.testing.assert_array_equal(textures[0], 0)  # its own are back


def test_imitation_runs_from_frames_to_card_and_resumes(grid, tmp_path):
    world = World("surrogate", StateSensor(), (grid,), flat_ground)
    settings = ImitationSettings(
        frames={"surrogate": 64},
        dagger_frames=32,
        dagger_rounds=1,
        dagger_epochs=1,
        collecting=small(groups_a_shard=8),
        training=TrainSettings(epochs=1, batch=32),
        validation=EvaluateSettings(runs=2, objects=0, horizon=3),
    )
    routes = [straight(), bent()]
    stages: list[str] = []

    def note(stage, done, total, state):
        assert 0 < done <= total
        if stage not in stages:
            stages.append(stage)

    first = imitate([(world, "x")], routes, settings, tmp_path, note)
    assert stages == [
        "frames, surrogate",
        "training 0",
        "round 1, surrogate",
        "training 1",
        "closed loop",
    ]
    assert [len(rows) for rows in first.history] == [1, 1]
    assert set(first.card["routes"]) == {"straight", "left"}
    files.write_json(tmp_path / "card.json", first.card)
    stages.clear()
    again = imitate([(world, "x")], routes, settings, tmp_path, note)
    assert "training 0" not in stages
    for one, other in zip(
        first.module.parameters(), again.module.parameters(), strict=True
    ):
        np.testing.assert_array_equal(one.numpy(force=True), other.numpy(force=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["surrogate", "deployment"])
def test_bundled_policy_keeps_its_lane(variant, name):
    """30 steps of each route: an error below what the attack may start from."""
    paths = WorldFiles(
        bundled("intersection/scene.xml"),
        bundled("intersection/field.safetensors"),
        (bundled("hydrant/field.safetensors"),),
        bundled("intersection/routes.json"),
    )
    world, _ = (
        load_surrogate(paths) if name == "surrogate" else load_deployment(paths, 4, 0)
    )
    module = PilotNet.load(bundled("policy/pilotnet.safetensors"))
    settings = EvaluateSettings(
        runs=1, objects=1, horizon=30, seed=3, ahead_m=(6.0, 1.0)
    )
    routes = paths.load_routes()
    drives = drive_routes(TorchPolicy(module), [world], routes, settings)
    assert len(drives) == 6
    for drive in drives:
        assert drive.distance_m.mean() < (0.15 if name == "surrogate" else 0.2)
        assert drive.distance_m.max() < 0.85


def test_train_names_a_missing_scene(tmp_path, capsys):
    routes = {"goal": 0, "lane_width_m": 3.5, "speed_ms": 5.0}
    routes["points_m"] = [[0, 0], [40, 0]]
    files.write_json(tmp_path / "routes.json", {"straight": routes})
    missing = str(tmp_path / "nowhere.xml")
    arguments = ["train", "-o", str(tmp_path / "policy.safetensors")]
    arguments += ["--data", str(tmp_path / "data"), "--scene", missing]
    arguments += ["--field", missing, "--object", missing]
    arguments += ["--routes", str(tmp_path / "routes.json")]
    assert cli.main(arguments) == 2
    assert f"{missing}: does not exist" in capsys.readouterr().err
    assert not (tmp_path / "policy.safetensors").exists()


def test_worlds_without_goals_in_order_are_refused(tmp_path):
    world = World("surrogate", StateSensor(), (), flat_ground)
    with pytest.raises(InputError, match=r"goals \[1\]"):
        imitate([(world, "")], [bent()], ImitationSettings({"surrogate": 8}), tmp_path)


def test_bars_print_plain_lines_where_there_is_no_terminal(capsys):
    with StageBars() as bars:
        for done in range(1, 5):
            bars.show("frames", done, 4, f"{done}/4")
    lines = capsys.readouterr().err.splitlines()
    assert "frames: 4/4" in lines[-1]
    assert len(lines) <= 2  # not one for each call
