"""What is found before an attack is paid for, what it costs, and what is no finding."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import shutil

import mitsuba as mi
import numpy as np
import pytest
from support.worlds.attacks import contents, job, stop_at
from support.worlds.cameras import block
from support.worlds.fields import homogeneous

from mi_nerfattack import cli
from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment import job as module
from mi_nerfattack.experiment.checks import standing
from mi_nerfattack.experiment.checks.before_attack import (
    likeness_findings,
)
from mi_nerfattack.experiment.checks.check import duration
from mi_nerfattack.experiment.checks.cost import planned_periods
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.pathtrace.ground import (
    arc_lengths,
    ground_findings,
    wall_findings,
)
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.scenario import DriveSection, load_scenario
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant", "no_results")

LINE = Route("line", 0, np.array([[-20.0, 0.0], [20.0, 0.0]]))
STILL = Freedom(0.3)
POSITION = "position_m = [7.0, 4.2, 1.6]"


def solid(*at, name="box", scale=0.5):
    """Return a box, its edges twice the scale, as points."""
    pose = Pose.upright(at, 0.0, scale)
    return standing.Solid.of(name, PosedField(homogeneous(2.0), pose))


def expect(findings, *patterns):
    """Check that there are findings as described, and no others."""
    lines, expected = list(findings), [pattern for pattern in patterns if pattern]
    assert len(lines) == len(expected), lines
    for pattern, line in zip(expected, lines, strict=True):
        assert re.search(pattern, line), line


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
    expect(standing.lane_findings([solid(*at)], LINE, 1.8, STILL), pattern)


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
    expect(standing.lane_findings([item], LINE, 1.8, freedom), pattern)


def test_objects_in_one_another():
    items = [solid(x, 0.0, 0.0, name=name) for name, x in (("a", 0), ("b", 0.9))]
    expect(standing.meeting_findings(items), "a and b stand in one another: 1. %")
    expect(standing.meeting_findings([items[0], solid(1.02, 0.0, 0.0)]), None)


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
    expect(standing.scene_findings([solid(*at)], LINE, street, "s.xml"), pattern)


def test_a_room_that_is_a_cube_is_open(street):
    """All lines begin within it, whatever way its sides face."""
    del street
    room = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([30, 6, 4])}
    scene = mi.load_dict({"type": "scene", "room": room})
    expect(standing.scene_findings([solid(0, 4, -3.5)], LINE, scene, "room"), None)
    expect(standing.scene_findings([solid(0, 6, -3.5)], LINE, scene, "room"), "a wall")


@pytest.mark.parametrize(
    ("points", "patterns"),
    [
        ([[-20.0, 0.0], [-0.1, 0.0]], []),
        ([[-10.0, 0.0], [10.0, 0.0]], ["lies 0.50 m above z = 0 .* 10.0 to 20.0 m"]),
        ([[0.5, 6.0], [19.5, 6.0]], ["above z = 0", "a surface of s.xml after 13"]),
        ([[-10.0, 0.0], [-10.0, 20.0]], ["no ground .* from 9.5 to 20.0 m along it"]),
        ([[-90.0, 0.0], [-60.0, 0.0]], [r"\(100 % of .* lie within x -20 to 20"]),
    ],
)
def test_route_and_ground(points, patterns):
    """Ground 40 m long, half of it 0.5 m higher, with a house at x = 15."""
    blocks = {
        "low": block([-10, 0, -1], [10, 9, 1]),
        "high": block([10, 0, -1], [10, 9, 1.5]),
        "house": block([15, 6, 2], [1, 1, 2]),
    }
    scene = mi.load_dict({"type": "scene", **blocks})
    route = Route("line", 0, np.array(points))
    arc = arc_lengths(*DriveSection(horizon=40).stretch(route, 0.1))
    finders = ground_findings, wall_findings
    lines = [find(route, arc, scene, "s.xml") for find in finders]
    expect(itertools.chain(*lines), *patterns)


def test_two_worlds_of_other_scale():
    """A wall 20 m ahead, and the same scene 1.3 times as large."""
    camera = from_fov(40, 20, 90.0)
    pose = mount_matrix(np.zeros(3), CameraMount(1.4, 0.0, 0.0))[0]
    frames = []
    for scale in (1.0, 1.1, 1.3):
        v = (np.arange(20) + 0.5 - camera.cy) / camera.fy
        with np.errstate(divide="ignore"):
            floor = np.where(v > 0, 1.4 / v, np.inf)  # stays where it is
        along = np.minimum(floor, 20 * scale)[:, None] * np.ones((20, 40))
        u = (np.arange(40) + 0.5 - camera.cx) / camera.fx
        depth = along * np.sqrt(1 + u**2 + v[:, None] ** 2)
        frames.append(CameraFrame(np.zeros((20, 40, 3), np.uint8), depth, pose))
    one, near, far = frames
    assert not list(likeness_findings(camera, near, one, "mitsuba"))
    (line,) = likeness_findings(camera, far, one, "mitsuba")
    assert "surrogate and mitsuba do not show one place" in line
    assert "30 % or more" in line


SEVERAL = """\
position_m = [-26.0, 4.2, 4.6]
[[objects]]
id = "stone"
field = "object.safetensors"
position_m = [7.0, 0.0, 1.6]"""


def test_all_is_told_at_once_and_nothing_is_left(folder, tmp_path):
    output, stages = tmp_path / "made" / "run", set()
    watched = job(folder, output, (POSITION, SEVERAL), lambda *x: stages.add(x[0]))
    with pytest.raises(InputError) as refused:
        watched.run()
    _, *lines, last = str(refused.value).split("\n")
    assert "--anyway" in last
    starts = "stone stands on the lane", "ball is in the air", "ball is not in view"
    for line, start in zip(lines, starts, strict=True):
        assert line.startswith(f"  {start}")
    assert stages == {"surrogate: own", "mitsuba: own"}
    assert not contents(tmp_path) and not (tmp_path / "made").exists()


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
    for line, place in ((left, "surrogate"), (also, "mitsuba")):
        assert f"in {place}, run 0" in line and "beyond 0.00 m after 0." in line
    for part in ("2 steps", "1.3 m", "'short' of 2.7 m", "0.2 s", "drive.horizon to 1"):
        assert part in short
    # of other starts: the first is 0.52 m aside, the second 1.23 m; there is room for
    # 0.85, and nothing is attacked
    far, stages = ("[drive]", "[drive]\nlateral_sd_m = 1.5"), []
    with pytest.raises(InputError, match="in surrogate, run 1, "):
        job(folder, tmp_path / "run", far, lambda *line: stages.append(line[0])).run()
    assert set(stages) == {"surrogate: own", "mitsuba: own"}
    assert not contents(tmp_path)


def test_anyway_goes_on_and_the_run_remembers(folder, tmp_path, monkeypatch):
    output, notices = tmp_path / "run", []
    aloft = (POSITION, POSITION.replace("1.6", "2.6"))
    stop = stop_at("surrogate: optimisation", 4 * 4 + 1)
    with pytest.raises(KeyboardInterrupt):
        job(folder, output, aloft, stop, notices).run(anyway=True)
    (warning,) = notices
    with monkeypatch.context() as patch:
        patch.setattr(module.before_attack, "first_findings", None)  # not called
        document = job(folder, output, aloft).run()
    assert document["flags"] == [warning.removeprefix("warning: ")]
    # by force it is another scenario, which is checked
    higher = (POSITION, POSITION.replace("1.6", "4.6"))
    before = contents(output)
    with pytest.raises(InputError, match="ball is in the air"):
        job(folder, output, higher).run(force=True)
    unchanged = {"checkpoint.safetensors", "metrics.json"}
    for path, raw in contents(output).items():
        assert path.name not in unchanged or raw == before[path]


def test_a_sound_scenario_has_no_flags(uninterrupted):
    assert uninterrupted[1]["flags"] == []


def test_the_command_passes_its_options(scenario_folder, tmp_path, monkeypatch):
    path, calls = str(scenario_folder / "scenario.toml"), []

    def run(self, force, anyway):
        calls.append((force, anyway))
        raise InputError("seen")

    monkeypatch.setattr(module.Job, "run_claimed", run)
    for extra in ([], ["--anyway"], ["--force"]):
        assert cli.main(["attack", path, "-o", str(tmp_path / "run"), *extra]) == 2
    assert calls == [(False, False), (False, True), (True, False)]


def check(folder, capsys, *change, options=()):
    path, picture = folder / "changed.toml", folder / "seen.png"
    path.write_text((folder / "scenario.toml").read_text().replace(*change))
    code = cli.main(["check", str(path), "-o", str(picture), *options])
    return code, capsys.readouterr(), picture


def test_a_sound_scenario(scenario_folder, capsys):
    """It is told what an attack costs, and how to begin one."""
    looks = "[baseline]\ntextures = 2\n[deployment]"
    code, captured, picture = check(scenario_folder, capsys, "[deployment]", looks)
    assert code == 0, captured.out
    assert files.read_image(picture).shape[1] == 1600
    first, cost, *_ = captured.out.splitlines()
    assert "80.0 m, 4 control periods of 0.1 s; objects: ball" in first
    # 4 periods of: 3 iterations and the attribution's 3, two frames each; 2 looks and
    # the best judged; 4 cases of 2 drives and the looks in both worlds
    assert "at most 3 iterations, 2 random textures, 140 frames; about " in cost
    # 3 iterations there and back, 4 cases of 2 drives and the looks in both worlds
    scenario, _ = load_scenario(scenario_folder / "changed.toml")
    assert planned_periods(scenario) == 4 * (2 * 3 + 2 * (4 * 2 + 2))


def test_the_next_command_can_be_given_as_it_is_told(scenario_folder, capsys):
    path = shutil.copy(
        scenario_folder / "scenario.toml", scenario_folder / "my scene.toml"
    )
    options = ["--no-drives", "-o", str(scenario_folder / "seen.png")]
    assert cli.main(["check", str(path), *options, "--set", "seed=9"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    words = ["mi-nerfattack", "attack", str(path), "-o", "runs/my scene"]
    command = shlex.split(last.removeprefix("next: "))
    assert command == [*words, "--set", "seed=9"]


def test_a_wrong_scenario(scenario_folder, capsys):
    """It hangs in the air; the picture is there all the same."""
    aloft = "objects.0.position_m=[7.0, 4.2, 4.6]"
    options = ["--no-drives", "--json", "--set", aloft]
    code, captured, picture = check(scenario_folder, capsys, "", "", options=options)
    document = json.loads(captured.out)
    assert code == 1 and picture.is_file() and document["cost"] is None
    (line,) = document["refused"]
    assert line.startswith("ball is in the air of deployment.xml")
    assert document["objects"] == {"ball": [7.0, 4.2, 4.6]}


def test_a_policy_whose_images_are_others(scenario_folder, capsys):
    """The error of a drive is a reason to refuse; the picture is there."""
    wide = "[camera]\nwidth = 40\nheight = 20\n[drive]"
    code, captured, picture = check(scenario_folder, capsys, "[drive]", wide)
    assert code == 1 and picture.is_file()
    assert "refused: " in captured.out and "40" in captured.out


@pytest.mark.parametrize(
    ("name", "change", "options", "where"),
    [
        ("a.toml", ('"object', '"~nosuchuser/object'), [], "~nosuchuser"),
        ("a.toml", ("[drive]", "[drive]\nlength = 3"), [], "drive.length"),
        ("a.toml", (), ["--set", "drive.length=3"], "--set drive.length=3"),
        ("a.toml", (), ["--take", "a"], "a.toml"),  # options of grids
        ("a.toml", (), ["--workers", "2"], "a.toml"),
        ("grid.toml", (), ["--set", "seed=1"], "--set"),
    ],
)
def test_what_cannot_be_checked(scenario_folder, capsys, name, change, options, where):
    text = (scenario_folder / "scenario.toml").read_text()
    text = text.replace(*change) if change else text
    text = 'scenario = "scenario.toml"\n' if name == "grid.toml" else text
    (scenario_folder / name).write_text(text)
    assert cli.main(["check", str(scenario_folder / name), *options]) == 2
    assert where in capsys.readouterr().err.partition(": ")[2].partition("; ")[0]


def test_durations():
    shown = {0.2: "1 s", 89: "89 s", 266: "4 min", 9000: "2.5 h"}
    assert {seconds: duration(seconds) for seconds in shown} == shown


ROUNDED = """\
import torch


class Rounded(torch.nn.Module):
    def forward(self, image):
        return 0.01 * torch.round(image * 255).mean((1, 2, 3)) / 255
"""


def test_a_policy_without_a_slope_is_told_and_ends_its_attack(
    scenario_folder, tmp_path, capsys
):
    (scenario_folder / "rounded.py").write_text(ROUNDED)
    change = 'file = "policy.safetensors"', 'file = "rounded.py:Rounded"'
    words = ["--set", "policy.trust_code=true"]
    code, captured, _ = check(
        scenario_folder, capsys, *change, options=["--no-drives", *words]
    )
    assert code == 0 and "control by the first image is exactly 0;" in captured.out
    path, run = str(scenario_folder / "changed.toml"), tmp_path / "run"
    for iteration in (1, 2):  # the second time it goes on from the first iteration
        assert cli.main(["attack", path, "-o", str(run), "--anyway", *words]) == 2
        error = capsys.readouterr().err
        assert f"attack iteration {iteration}: the gradient is exactly 0" in error
