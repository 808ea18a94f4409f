"""Bricks look like the field that they were baked from."""

from __future__ import annotations

import json
import re

import drjit as dr
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.fields import homogeneous, small_ngp

from mi_nerfattack import cli
from mi_nerfattack.capture.scene import drive_poses
from mi_nerfattack.fields import NGPField, Occupancy, load_field, save_field
from mi_nerfattack.fit.bake import bake as module
from mi_nerfattack.fit.bake.bake import BakeOptions, bake, plan_bricks
from mi_nerfattack.fit.bake.scores import score_bake
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

ROUTE = Route("line", 0, np.array([[-1.6, 0.1], [0.2, 0.1]]))
CAMERA, MOUNT = from_fov(40, 24, 80.0), CameraMount(0.4, 0.0, 10.0)
POSE = Pose.upright((7.0, -3.0, 0.0), 2.0, 2.0)
POINTS = POSE.apply(np.insert(ROUTE.points, 2, 0, 1))[:, :2]
ROWS = np.hstack([2 * POSE.rotation, POSE.translation[:, None]]).tolist()
SCENARIO = f"""
name = "line"
objects = [{{ id = "cube", field = "absent", position_m = [0, 0, 0] }}]
policy = {{ file = "absent.pt2" }}
camera = {{ width = 32, height = 20, height_m = 0.8, forward_m = 0.0, pitch_deg = 10 }}
[scene]
field = "field.safetensors"
bricks = "b.safetensors"
to_world = {[*ROWS, [0, 0, 0, 1]]}
deployment = "absent"
routes = "routes.json"
route = "line"
"""


@pytest.fixture
def field(rng) -> NGPField:
    """A smooth field in half of its cells, with colours that depend on the view."""
    field = small_ngp(cone=1 / 64)
    table = field.parameters()["table"].numpy() * 0.5
    field.set_parameter("table", type(field.parameters()["table"])(table))
    field.density_scale = 2.0
    cells = rng.random((6, 5, 4)) < 0.5
    field.occupy(Occupancy(cells))
    return field


def test_parts_are_finer_near_the_route(field):
    plan = plan_bricks(PosedField(field), [ROUTE], BakeOptions(cone=0.3))
    centre = -1 + 2 * (np.argwhere(plan.occupancy.cells) + 0.5) / (6, 5, 4)
    x = np.clip(centre[:, 0], -1.6, 0.2)
    distance = np.hypot(centre[:, 0] - x, centre[:, 1] - 0.1)
    edges = 0.5 / plan.subdivisions  # of the longest edge of a cell
    assert (edges <= np.maximum(0.3 * distance * 1.5, 0.5 / 8)).all()
    finer = plan.subdivisions < 8
    assert finer.any() and not finer.all()
    assert (2 * edges[finer] > 0.3 * distance[finer] * 0.7).all()
    assert plan.peak_mb > plan.file_mb > 0


def test_refinement_brings_bricks_to_the_field(field):
    least = []
    for passes in (0, 2):
        options = BakeOptions(cone=0.05, passes=passes, views=20)
        baked = bake(PosedField(field), [ROUTE], CAMERA, MOUNT, options)
        assert (baked.step_m, baked.cone) == (field.step_m, field.cone)
        pair = PosedField(field), PosedField(baked)
        views = score_bake(*pair, [ROUTE], CAMERA, MOUNT, spacing_m=0.5, keep=2)
        assert sum(view.pictures is not None for view in views) == 2
        worst = min(views, key=lambda view: view.psnr_db)
        assert worst.pictures is not None and worst.pictures.expected.std() > 0.02
        least.append(worst.psnr_db)
    assert least[1] > max(least[0] + 1, 28)


def test_no_two_draws_share_a_seed(field, monkeypatch):
    poses, jitter, rays_of = [], [], module._rays

    def scatter(routes, views, seed, mount):
        poses.append(drive_poses(routes, views, seed, mount).tobytes())
        return drive_poses(routes, views, 0, mount)

    def keep(*arguments, **keywords):
        result = rays_of(*arguments, **keywords)
        jitter.append(result.jitter.numpy().tobytes())
        return result

    monkeypatch.setattr(module, "drive_poses", scatter)
    monkeypatch.setattr(module, "_rays", keep)
    monkeypatch.setattr(module, "_RAYS_AT_ONCE", 1)  # an image at a time
    for seed in (0, 1):
        options = BakeOptions(cone=0.5, passes=3, views=3, seed=seed)
        bake(PosedField(field), [ROUTE], CAMERA, MOUNT, options)
    assert len(jitter) == len(set(jitter)) == 18
    assert len(poses) == len(set(poses)) == 6


def test_a_pose_moves_the_bricks_with_the_field(field):
    wide, high = Route("wide", 0, POINTS, 7.0), CameraMount(0.8, 0.0, 10.0)
    options, posed = BakeOptions(cone=0.3, views=4), PosedField(field, POSE)
    original = bake(PosedField(field), [ROUTE], CAMERA, MOUNT, options)
    moved = bake(posed, [wide], CAMERA, high, options)
    np.testing.assert_array_equal(moved.subdivisions, original.subdivisions)
    words = [baked.vertices.numpy() for baked in (original, moved)]
    assert np.mean(words[0] == words[1]) > 0.9
    views = score_bake(posed, PosedField(moved, POSE), [wide], CAMERA, high, 1.0)
    assert min(view.psnr_db for view in views) > 25


def test_sky_behind_is_that_of_the_field(field):
    baked = bake(PosedField(field), [ROUTE], CAMERA, MOUNT, BakeOptions(passes=0))
    towards = dr.normalize(type(field.unit(0))([0.3, -1], [0.2, 0.5], [1.0, 0.1]))
    pair = [np.array(item.background(towards)) for item in (baked, field)]
    np.testing.assert_allclose(*pair, atol=1e-6)


@pytest.fixture
def words(field, tmp_path, monkeypatch) -> list[str]:
    """The command, in a folder with what it needs."""
    monkeypatch.chdir(tmp_path)
    save_field("field.safetensors", field)
    route = {"goal": 0, "lane_width_m": 7.0, "speed_ms": 5.0}
    table = {"line": route | {"points_m": POINTS.tolist()}}
    (tmp_path / "routes.json").write_text(json.dumps(table))
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    return "bake scenario.toml --views 4 --cone 0.1".split()


def test_the_command_writes_field_and_report(words, tmp_path, capsys):
    assert cli.main([*words, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["psnr_db"] >= facts["psnr_least_db"] > 10
    baked = load_field("b.safetensors")
    assert baked.kind == "brick_field" and facts["bricks"] == len(baked.subdivisions)
    written = json.loads((tmp_path / "b.report" / "metrics.json").read_text())
    assert written["psnr_db"] == facts["psnr_db"]
    names = {path.name for path in (tmp_path / "b.report").iterdir()}
    assert names == {"report.html", "metrics.json", "worst.png", "depth.png"}


@pytest.mark.parametrize(
    ("line", "instead", "message"),
    [
        ('bricks = "b.safetensors"', "", "--output: .* scene.bricks"),
        ('bricks = "b', 'bricks = "field', "--output: .* field itself"),
        ("width = 32", "width = 6", "6 x 20"),
    ],
)
def test_what_a_scenario_must_say(words, tmp_path, capsys, line, instead, message):
    (tmp_path / "scenario.toml").write_text(SCENARIO.replace(line, instead))
    assert cli.main(words) == 2
    assert re.search(message, capsys.readouterr().err)


def empty() -> NGPField:
    field = small_ngp()
    field.occupy(Occupancy(np.zeros((2, 2, 2), bool)))
    return field


test_refused = refusals(
    (lambda: plan_bricks(PosedField(homogeneous()), [ROUTE]), "grid_field; .*ngp_fie"),
    (lambda: plan_bricks(PosedField(empty()), [ROUTE]), "bake: the field is empty"),
    (lambda: BakeOptions(cone=0), "cone: 0"),
)
