"""What is found before an attack is paid for, and what is no finding."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest
from helpers.attack_jobs import checkpoint_of, contents, job, stop_at
from helpers.camera_scenes import block
from helpers.small_fields import homogeneous

from mi_nerfattack import cli
from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment import job as module
from mi_nerfattack.experiment.checks import standing
from mi_nerfattack.experiment.checks.before_attack import place_findings, view_findings
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import build_world
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

LINE = Route("line", 0, np.array([[-20.0, 0.0], [20.0, 0.0]]))
STILL = Freedom(0.3)
POSITION = "position_m = [7.0, 4.2, 1.6]"


def solid(*at, name="box", scale=0.5):
    """Return a box, its edges twice the scale, as points."""
    pose = Pose.upright(at, 0.0, scale)
    return standing.Solid.of(name, PosedField(homogeneous(2.0), pose))


def told(findings, pattern):
    """Check that there is one finding as described, or none."""
    found = list(findings)
    if pattern is None:
        assert not found
    else:
        assert len(found) == 1 and re.search(pattern, found[0]), found


def test_points_fill_what_is_dense():
    """A box 2 m long is solid from a density of 0.5 per metre on."""
    points = solid(3.0, 1.0, 0.5).points
    assert len(points) == 32**3
    np.testing.assert_allclose(points.min(0), [2.5, 0.5, 0.0], atol=0.02)
    np.testing.assert_allclose(points.max(0), [3.5, 1.5, 1.0], atol=0.02)
    for density, count in ((0.49, 0), (0.51, 32**3)):
        posed = PosedField(homogeneous(density))
        assert len(standing.Solid.of("fog", posed).points) == count


@pytest.mark.parametrize(
    ("at", "pattern"),
    [
        ((3.0, 1.5, 0.5), None),
        ((3.0, 1.3, 0.5), "box stands on the lane: 2.* along route 'line', .* 0.82 m"),
        ((3.0, -0.2, 0.5), r"it is 0.00 m from .* needs 0\.90 m to each side"),
        ((3.0, 0.0, -0.41), None),  # the car drives over it
        ((3.0, 0.0, 2.6), None),  # or under
        ((20.6, 0.0, 0.5), None),  # beyond the end
    ],
)
def test_object_on_the_lane(at, pattern):
    told(standing.lane_findings([solid(*at)], LINE, 1.8, STILL), pattern)


@pytest.mark.parametrize(
    ("aside", "freedom", "nearest"),
    [
        (1.8, Freedom(None, 0.02, ("y",), 0.5), "0.82 m"),
        (1.8, Freedom(None, 0.02, ("y",), 0.3), None),
        (1.8, Freedom(None, 0.02, ("x",), 0.5), None),
        (1.5, Freedom(None, 0.02, ("yaw",), 1.0, np.pi / 4), "0.81 m"),
        (1.5, Freedom(None, 0.02, ("x", "yaw"), 1.0, 0.1), None),
        (1.45, STILL, None),
    ],
)
def test_object_that_may_move_onto_the_lane(aside, freedom, nearest):
    """Turned by 45 degrees, the box reaches 0.207 m farther."""
    pattern = nearest and f"box may move onto the lane: .*limit_m .* {nearest}"
    item = solid(3.0, aside, 0.5)
    told(standing.lane_findings([item], LINE, 1.8, freedom), pattern)


def test_objects_in_one_another():
    items = [solid(x, 0.0, 0.0, name=name) for name, x in (("a", 0), ("b", 0.9))]
    told(standing.meeting_findings(items), "a and b stand in one another: 1. %")
    told(standing.meeting_findings([items[0], solid(1.02, 0.0, 0.0)]), None)


@pytest.fixture(scope="module")
def street():
    """Ground, a building 10 m high, a sign-board and a bridge."""
    mi.set_variant("llvm_ad_rgb")
    place = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "ground": {"type": "rectangle", "to_world": place.scale(60)},
            "house": block([0, 10, 5], [10, 4, 5]),
            "bridge": block([0, -10, 4], [10, 1, 0.2]),
            "board": {
                "type": "rectangle",
                "to_world": place.translate([15, 4, 1]).rotate([1, 0, 0], 90),
            },
        }
    )


@pytest.mark.parametrize(
    ("at", "pattern"),
    [
        ((0, 4, 0.5), None),
        ((0, 5.45, 0.5), None),  # it leans against the house
        ((0, 5.8, 0.5), r"box reaches 0\.28 m into a wall of s\.xml, at .*; move it"),
        ((0, 10, 0.5), "into a wall"),  # all of it
        ((-14, 10, 0.5), None),  # seen from behind the house alone
        ((0, -10, 0.5), None),  # beneath the bridge
        ((0, -4, 0.45), None),
        ((0, -4, 0.2), r"reaches 0\.28 m into the ground of s\.xml, .*; raise it"),
        ((0, -4, -3), r"reaches 3\.48 m into the ground"),
        ((0, -4, 1.5), r"in the air of s\.xml: .* 1\.02 m above what is beneath"),
        ((0, 5.4, 3), None),  # it hangs at the wall
        ((0, 70, 0.5), "above nothing"),
        ((15, 3, 0.5), None),
        ((15, -4, 0.5), None),
    ],
)
def test_object_in_a_scene(street, at, pattern):
    told(standing.scene_findings([solid(*at)], LINE, street, "s.xml"), pattern)


def test_a_room_that_is_a_cube_is_open(street):
    """All lines begin within it, whatever way its sides face."""
    del street
    room = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([30, 6, 4])}
    scene = mi.load_dict({"type": "scene", "room": room})
    told(standing.scene_findings([solid(0, 4, -3.5)], LINE, scene, "room"), None)
    told(standing.scene_findings([solid(0, 6, -3.5)], LINE, scene, "room"), "a wall")


SEVERAL = """\
position_m = [-26.0, 4.2, 4.6]
[[objects]]
id = "stone"
field = "object.safetensors"
position_m = [7.0, 0.0, 1.6]"""


@pytest.mark.usefixtures("no_results")
def test_all_is_told_at_once_and_nothing_is_left(folder, tmp_path):
    output, stages = tmp_path / "made" / "run", set()
    watched = job(folder, output, (POSITION, SEVERAL), lambda *x: stages.add(x[0]))
    with pytest.raises(InputError) as refused:
        watched.run()
    first, *lines, last = str(refused.value).split("\n")
    assert first == "an attack would prove nothing:" and "--anyway" in last
    starts = "ball is not in view", "stone stands on the lane", "ball is in the air"
    for line, start in zip(lines, starts, strict=True):
        assert line.startswith(f"  {start}")
    assert stages == {"surrogate: own", "deployment: own"}
    assert not contents(tmp_path) and not (tmp_path / "made").exists()


@pytest.mark.usefixtures("no_results")
def test_what_drives_tell(folder, tmp_path):
    """A lane as wide as the car, and a route that ends after 2.7 of 4 m."""
    routes = files.read_json(folder / "routes.json")
    routes["short"] = {**routes["line"], "points_m": [[-20.0, 0.0], [-17.3, 0.0]]}
    files.write_json(folder / "routes.json", routes)
    narrow = (
        'route = "line"',
        'route = "short"\n[vehicle]\nwidth_m = 3.4999\nspeed_ms = 20',
    )
    with pytest.raises(InputError) as refused:
        job(folder, tmp_path / "run", narrow).run()
    left, also, short, _ = str(refused.value).split("\n")[1:]
    for line, place in ((left, "surrogate"), (also, "deployment")):
        assert f"leaves its lane before anything is attacked: in {place}, run 0" in line
        assert "beyond 0.00 m after 0." in line
    assert "drive of 2 steps ends 1.3 m beyond route 'short' of 2.7 m" in short
    assert "passed after 0.2 s; lower drive.horizon to 1" in short


@pytest.mark.usefixtures("no_results")
def test_other_starts_are_checked_before_the_attack(folder, tmp_path):
    """The first begins 0.52 m aside, the second 1.23 m; the lane has room for 0.85."""
    far = ("[drive]", "[drive]\nlateral_sd_m = 1.5")
    seen = []
    with pytest.raises(InputError, match="in surrogate, run 1, .*at .* m"):
        job(folder, tmp_path, far, lambda *line: seen.append(line[0])).run()
    assert set(seen) == {"surrogate: own", "deployment: own"}
    assert not contents(tmp_path)


@pytest.mark.usefixtures("no_results")
def test_anyway_goes_on_and_the_run_remembers(folder, tmp_path, monkeypatch):
    output, notices = tmp_path / "run", []
    behind = (POSITION, POSITION.replace("7.0", "-26.0"))
    stop = stop_at("surrogate: optimisation", 4 * 4 + 1)
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, behind, stop, notices).run(anyway=True)
    assert len(checkpoint_of(output)["history"]) == 4
    (warning,) = notices
    assert warning.startswith("warning: ball is not in view")
    drives = {path: path.stat().st_mtime_ns for path in output.glob("drives/*_own_*")}
    assert len(drives) == 3
    with monkeypatch.context() as patch:
        patch.setattr(module, "first_findings", None)  # they are not called
        document = job(folder, output, behind).run()
    assert document["flags"] == [warning.removeprefix("warning: ")]
    assert all(path.stat().st_mtime_ns == time for path, time in drives.items())
    # by force it is another scenario, which is checked
    aloft = (POSITION, POSITION.replace("1.6", "4.6"))
    before = contents(output)
    with pytest.raises(InputError, match="ball is in the air"):
        job(folder, output, aloft).run(force=True)
    kept = {"checkpoint.safetensors", "metrics.json"}
    for path, raw in contents(output).items():
        assert path.name not in kept or raw == before[path]


def test_a_sound_scenario_has_no_flags(whole):
    assert whole[1]["flags"] == []


def test_command_refuses_and_goes_on_anyway(
    scenario_folder, tmp_path, capsys, monkeypatch
):
    text = (scenario_folder / "scenario.toml").read_text()
    path, output = scenario_folder / "aloft.toml", tmp_path / "run"
    path.write_text(text.replace(POSITION, POSITION.replace("1.6", "4.6")))
    assert cli.main(["attack", str(path), "-o", str(output)]) == 2
    message = capsys.readouterr().err
    assert "ball is in the air of deployment.xml" in message and "--anyway" in message
    assert not output.exists()
    seen = []

    def run(self, force, anyway):
        seen.append((force, anyway))
        raise InputError("seen")

    monkeypatch.setattr(module.Job, "run_claimed", run)
    for extra in ([], ["--anyway"], ["--force"]):
        cli.main(["attack", str(path), "-o", str(output), *extra])
    assert seen == [(False, False), (False, True), (True, False)]


@pytest.mark.slow
def test_the_bundled_demo_and_mistakes_in_it():
    """Its hydrant, and one behind the car, in a building, on the lane."""
    scenario, _ = load_scenario(bundled("demo.toml"))
    world = build_world(scenario, scenario.policy.build())
    states = world.route.pose_at(0.5 * np.arange(61))
    time_s, nothing = 0.1 * np.arange(1, 61), np.zeros(60)
    arrays = states, nothing, nothing, time_s
    nominal = Drive("surrogate", "right", "own", 0, 0, *arrays)
    hydrant = world.surrogate.objects[0]
    for at, words in (
        (hydrant.pose.translation, []),
        ((-26.0, -5.0, 0.12), ["not in view"]),
        ((15.0, -20.0, 0.12), ["not in view", "into a wall of scene.xml"]),
        ((-1.75, -20.0, 0.0), ["on the lane: 36"]),
    ):
        shift = np.subtract(at, hydrant.pose.translation)
        hydrant.move(np.pad(shift, (0, 3)))
        found = [*view_findings(world, nominal), *place_findings(world)]
        assert len(found) == len(words)
        assert all(word in line for word, line in zip(words, found, strict=True))
