"""Bundled data: checksums, budgets, and builds that give what is bundled."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.faults.refusals import refusals

import mi_nerfattack
from mi_nerfattack import plugins, scenes
from mi_nerfattack.deploy.car import SMALL_CAR
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenes import bundled, manifest
from mi_nerfattack.scenes.car import build as car
from mi_nerfattack.scenes.hydrant import build as hydrant
from mi_nerfattack.scenes.intersection import build as intersection
from mi_nerfattack.scenes.intersection import layout
from mi_nerfattack.scenes.room import build
from mi_nerfattack.scenes.room import layout as loop
from mi_nerfattack.training.record import read_record
from mi_nerfattack.vehicle.route.route import Route


def test_manifest_matches() -> None:
    assert manifest.problems() == []


def test_manifest_reports_each_kind_of_difference(tmp_path) -> None:
    for name in ("same", "changed", "longer", "missing"):
        (tmp_path / f"{name}.bin").write_bytes(b"abc")
    manifest.record(sorted(tmp_path.iterdir()), "make", 1, "", root=tmp_path)
    (tmp_path / "changed.bin").write_bytes(b"abd")
    (tmp_path / "longer.bin").write_bytes(b"abcd")
    (tmp_path / "missing.bin").unlink()
    (tmp_path / "extra.bin").write_bytes(b"")
    names = [problem.partition(": ")[0] for problem in manifest.problems(tmp_path)]
    assert names == ["missing.bin", "extra.bin", "changed.bin", "longer.bin"]


test_refused = refusals(
    (lambda at: manifest.record([at / "no"], "make", None, ""), "not a file below"),
    (lambda: bundled("nothing.xml"), r"intersection/scene\.xml"),
    (lambda: bundled("../pyproject.toml"), r"intersection/scene\.xml"),
)


def test_budget_of_the_wheel_is_kept_and_told() -> None:
    text = bundled("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `?([\w/. ]+?)`? \| ([\d.]+) \|$", text, re.MULTILINE)
    assert {name: float(mb) for name, mb in rows} == manifest.BUDGET_MB
    folders = [Path(m.__file__).parent for m in (mi_nerfattack, plugins, scenes)]
    paths = {path for folder in folders for path in folder.rglob("*")}
    code = [path for path in paths if path.suffix in (".py", ".pyi", ".j2", ".md")]
    assert len(code) > 100
    assert sum(path.stat().st_size for path in code) < 1e6 * manifest.BUDGET_MB["code"]
    sizes = {"car/field.safetensors": 10_000_001, "a": 3_000_000, "b": 300_001}
    over = manifest.over_budget(sizes | {"cube/field.safetensors": 4_000_000})
    names = [line.partition(":")[0] for line in over]
    assert names == ["car/field.safetensors", "other data"]


@pytest.mark.parametrize(
    ("name", "script", "extent"),
    [("hydrant", hydrant, (0.38, 0.42, 0.75)), ("car", car, (4.2, 1.8, 1.45))],
)
def test_objects_are_metric_closed_and_as_their_scripts(
    name, script, extent, tmp_path
) -> None:
    world = script.world_mesh()
    np.testing.assert_allclose(world.extents, extent, atol=0.01)
    assert world.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    for part, _ in script.coloured_meshes():
        assert part.is_watertight and part.volume > 0
    script.build(tmp_path / "a.glb")
    paths = bundled(f"{name}/{name}.glb"), tmp_path / "a.glb"
    stored, built = (trimesh.load(path, force="mesh") for path in paths)
    np.testing.assert_allclose(stored.vertices, built.vertices, atol=1e-6)
    np.testing.assert_array_equal(stored.faces, built.faces)
    colours = [mesh.visual.vertex_colors for mesh in (stored, built)]
    np.testing.assert_array_equal(*colours)
    x, y, z = np.asarray(stored.vertices).T  # glTF's y up to z up
    np.testing.assert_allclose(np.c_[x, -z, y], world.vertices, atol=1e-6)


def test_routes_lie_on_the_lane_centres() -> None:
    stored = files.read_json(bundled("intersection/routes.json"))
    check_routes(layout.routes(), stored)
    for name, entry in layout.routes().items():
        points = np.array(entry["points_m"])
        x, y = points.T
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        # a chord of an arc of radius r is shorter by at most 0.5^3 / 24 / r^2
        np.testing.assert_allclose(length, 0.5, atol=0.5**3 / 24 / 6.75**2 + 2e-6)
        if name == "straight":
            np.testing.assert_allclose(y, -1.75, atol=1e-6)
            continue
        # a turn, mirrored at the diagonal if it is to the left: two lines and an arc
        x, y = (y, x) if name == "left" else (x, y)
        side, radius = (1.75, 9.0) if name == "left" else (-1.75, 6.75)
        a, b = (np.maximum(values - side + radius, 0) for values in (x, y))
        np.testing.assert_allclose(np.hypot(a, b), radius, atol=2e-6)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (0.0, 0.0, 3.5),
        (-20.0, -1.75, 1.75),
        (1.75, -30.0, 1.75),
        (-8.5, -3.5, 0.0),
        (8.5 - 5 / 2**0.5, -8.5 + 5 / 2**0.5, 0.0),
        (-30.0, 5.0, -1.5),
        (6.0, -20.0, -2.5),
    ],
)
def test_distance_to_the_kerb(x: float, y: float, expected: float) -> None:
    depth = layout.road_depth(np.array([x]), np.array([y]))
    np.testing.assert_allclose(depth, expected, atol=1e-12)


FILES = manifest.load()
#: Policies by name: where they were trained, and objects of other folders.
POLICIES = {
    "policy/pilotnet": ("intersection", {"car", "cube", "hydrant"}),
    "room/policy": ("room", {"cube"}),
}


@pytest.mark.parametrize("name", POLICIES)
def test_policy_record_and_card_tell_one_story(name: str) -> None:
    record = read_record(bundled(f"{name}.json"))
    assert record is not None
    card = files.read_json(bundled(f"{name}.card.json"))
    policy, (place, objects) = f"{name}.safetensors", POLICIES[name]
    assert card["policy_section"]["file_sha256"] == FILES[policy]["sha256"]
    assert card["training"]["command"] == record.command
    trained = record.command, record.seed
    measured = card["command"], card["settings"]["seed"]
    suffixes = {".safetensors": trained, ".json": trained}
    suffixes |= {".card.json": measured, ".png": measured}
    for suffix, expected in suffixes.items():
        entry = FILES[f"{name}{suffix}"]
        assert (entry["command"], entry["seed"]) == expected
    sums = {file.removeprefix(f"{place}/"): FILES[file]["sha256"] for file in FILES}
    for file, digest in record.checksums.items():
        assert sums[file.removeprefix(f"{place}/")] == digest, file
    folders = {file.partition("/")[0] for file in record.checksums}
    assert folders & {"car", "cube", "hydrant"} == objects
    card_folders = {file.partition("/")[0] for file in card["place"]}
    assert card_folders >= objects - {"hydrant"}


STRAIGHT = 2 * (loop.TRACK_HALF - loop.CORNER_RADIUS)
LENGTH = 4 * STRAIGHT + 2 * math.pi * loop.CORNER_RADIUS
#: By which 70 chords of an arc of radius r are shorter: s^3 / 24 / r^2 each.
CHORDS = 70 * 0.1**3 / 24 / loop.CORNER_RADIUS**2


def check_routes(one: dict, two: dict) -> None:
    """Check that routes are equal, but for the rounding of their points."""
    for table in (one, two):
        points = [np.array(route.pop("points_m")) for route in table.values()]
        table["points"] = np.concatenate(points)
    np.testing.assert_allclose(one.pop("points"), two.pop("points"), atol=2e-6)
    assert one == two


@pytest.mark.parametrize(
    ("place", "make", "seed"),
    [
        ("room", build.build, 5),
        pytest.param("intersection", intersection.build, 3, marks=pytest.mark.slow),
    ],
)
def test_builds_to_what_is_bundled(tmp_path, place, make, seed) -> None:
    """Not to the bytes: zlib's depend on its version, a sine's on the processor."""
    for path in make(tmp_path, seed=seed):
        stored = bundled(f"{place}/{path.relative_to(tmp_path).as_posix()}")
        if path.suffix == ".png":
            one, two = (files.read_image(item).astype(int) for item in (path, stored))
            assert np.abs(one - two).max() <= 1
        elif path.suffix == ".ply":
            one, two = (
                trimesh.load_mesh(item, process=False) for item in (path, stored)
            )
            np.testing.assert_allclose(one.vertices, two.vertices, atol=1e-6)
            np.testing.assert_array_equal(one.faces, two.faces)
        elif path.suffix == ".json":
            check_routes(*(files.read_json(item) for item in (path, stored)))
        else:
            assert path.read_bytes() == stored.read_bytes()


def test_the_loop_is_closed_even_and_fit_for_the_car() -> None:
    np.testing.assert_allclose(loop.track_distance(*loop.track().T), 0, atol=1e-12)
    route = Route.from_file(bundled("room/routes.json"), "square")
    assert route.closed and route.length == pytest.approx(LENGTH, abs=CHORDS)
    steps = np.linalg.norm(np.roll(route.points, -1, axis=0) - route.points, axis=1)
    # a chord of an arc is shorter by at most s^3 / 24 / r^2
    assert np.ptp(steps) < 0.11**3 / 24 / loop.CORNER_RADIUS**2
    steer = math.atan(SMALL_CAR.wheelbase / loop.CORNER_RADIUS)
    assert steer < 0.9 * SMALL_CAR.max_steer


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (0, -1.6, 0),
        (0, 2, 0.4),
        (-1.5, 0.2, -0.1),
        (0, 0, -1.6),
        (1.6, 1.6, math.hypot(1.1, 1.1) - 1.1),  # the corner's centre is (0.5, 0.5)
    ],
)
def test_distance_to_the_loop(x, y, expected) -> None:
    distance = loop.track_distance(np.array(float(x)), np.array(float(y)))
    assert distance == pytest.approx(expected)


def test_the_policy_sees_the_picture_that_it_was_trained_with() -> None:
    """The rows that are kept, at 200x66, within half a pixel of 66 rows."""
    scenario, place = load_scenario(bundled("room.toml"))[0], bundled_place("room")
    assert scenario.vehicle.car().control_unit == scenario.policy.unit() == "rad"
    camera, mount = scenario.camera.build()
    assert (camera.width, camera.height) == (336, 188) and mount == place.mount
    top, bottom, left, right = scenario.policy.preprocess.crop_px
    size = camera.width - left - right, camera.height - top - bottom
    cropped = Camera(*size, camera.fx, camera.fy, camera.cx - left, camera.cy - top)
    resize = scenario.policy.preprocess.resize_px
    resized, expected = cropped.resized(*resize), place.camera
    assert (resized.width, resized.height) == (expected.width, expected.height)
    assert (resized.cx, resized.cy) == pytest.approx((expected.cx, expected.cy))
    assert resized.fx == pytest.approx(expected.fx)
    # rows are squeezed by so little that the outermost moves by less than half a pixel
    assert abs(resized.fy / expected.fy - 1) * expected.height / 2 < 0.5
