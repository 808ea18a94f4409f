"""Bundled data: checksums, reproducible builds, geometry of routes and hydrant."""

from __future__ import annotations

import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

import mi_nerfattack
from mi_nerfattack import plugins, scenes
from mi_nerfattack.errors import InputError
from mi_nerfattack.scenes import bundled, manifest
from mi_nerfattack.scenes.car import build as car
from mi_nerfattack.scenes.hydrant import build as hydrant
from mi_nerfattack.scenes.intersection import build as intersection
from mi_nerfattack.scenes.intersection import layout, paint


def route(name: str) -> np.ndarray:
    data = json.loads(bundled("intersection/routes.json").read_text())
    return np.array(data[name]["points_m"])


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
    assert manifest.problems(tmp_path) == [
        "missing.bin: missing",
        "extra.bin: not listed",
        "changed.bin: SHA-256 differs from the manifest's",
        "longer.bin: 4 bytes; the manifest says 3",
    ]


def test_budget_of_the_wheel_is_kept_and_told() -> None:
    text = bundled("README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `?([\w/. ]+?)`? \| ([\d.]+) \|$", text, re.MULTILINE)
    assert {name: float(mb) for name, mb in rows} == manifest.BUDGET_MB
    assert sum(manifest.BUDGET_MB.values()) == 45
    folders = [Path(m.__file__).parent for m in (mi_nerfattack, plugins, scenes)]
    paths = {path for folder in folders for path in folder.rglob("*")}
    code = [path for path in paths if path.suffix in (".py", ".pyi", ".j2", ".md")]
    assert len(code) > 100
    assert sum(path.stat().st_size for path in code) < 1e6 * manifest.BUDGET_MB["code"]


def test_files_over_their_budget_are_named() -> None:
    sizes = {"car/field.safetensors": 10_000_001, "a": 3_000_000, "b": 500_001}
    assert manifest.over_budget(sizes | {"cube/field.safetensors": 4_000_000}) == [
        "car/field.safetensors: 10000001 bytes; the budget is 10 million",
        "other data: 3500001 bytes; the budget is 3.5 million",
    ]


def test_recording_a_file_elsewhere_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="not a file below"):
        manifest.record([tmp_path / "no"], "make", None, "")


@pytest.mark.parametrize("name", ["nothing.xml", "../pyproject.toml"])
def test_unknown_name_lists_what_exists(name: str) -> None:
    with pytest.raises(InputError, match=r"intersection/scene\.xml"):
        bundled(name)


@pytest.mark.slow
def test_intersection_builds_to_identical_bytes(tmp_path) -> None:
    first = intersection.build(tmp_path / "a", seed=3)
    second = intersection.build(tmp_path / "b", seed=3)
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_seed_changes_the_road() -> None:
    x, y = paint.pixel_grid(-5, 5, -3, 3, 2)
    one, two = paint.road_colour(x, y, 3), paint.road_colour(x, y, 4)
    assert np.abs(one - two).max() > 0.01
    np.testing.assert_array_equal(one, paint.road_colour(x, y, 3))


@pytest.mark.parametrize("build", [hydrant.build, car.build])
def test_objects_build_to_identical_bytes(build, tmp_path) -> None:
    build(tmp_path / "a.glb")
    build(tmp_path / "b.glb")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


@pytest.mark.parametrize("name", ["straight", "right", "left"])
def test_route_is_evenly_spaced_and_smooth(name: str) -> None:
    points = route(name)
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=1)
    # A chord of an arc of radius r >= 6.75 is shorter than 0.5 by at most 0.5^3/24/r^2.
    assert np.all((length > 0.5 - 0.5**3 / 24 / 6.75**2 - 2e-6) & (length < 0.5 + 2e-6))
    assert length.sum() >= 42
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    # Between chords an arc of radius r turns by at most 0.5/r.
    assert np.abs(np.diff(heading)).max() <= 0.5 / 6.75 + 1e-5


def test_routes_lie_on_the_lane_centres() -> None:
    x, y = route("straight").T
    np.testing.assert_allclose(y, -1.75, atol=1e-6)
    assert (x[0], x[-1]) == (-25, 35)

    x, y = route("right").T
    assert (x[0], y[0]) == (-22, -1.75)
    assert abs(y[-1] + 30) < 0.5
    east, south = x <= -8.5, y <= -8.5
    np.testing.assert_allclose(y[east], -1.75, atol=1e-6)
    np.testing.assert_allclose(x[south], -1.75, atol=1e-6)
    arc = ~east & ~south
    radius = np.hypot(x[arc] + 8.5, y[arc] + 8.5)
    np.testing.assert_allclose(radius, 6.75, atol=2e-6)

    x, y = route("left").T
    assert (x[0], y[0]) == (1.75, -24)
    assert abs(x[-1] + 30) < 0.5
    north, west = y <= -7.25, x <= -7.25
    np.testing.assert_allclose(x[north], 1.75, atol=1e-6)
    np.testing.assert_allclose(y[west], 1.75, atol=1e-6)
    arc = ~north & ~west
    np.testing.assert_allclose(np.hypot(x[arc] + 7.25, y[arc] + 7.25), 9.0, atol=2e-6)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (0.0, 0.0, 3.5),
        (-20.0, -1.75, 1.75),
        (20.0, 3.0, 0.5),
        (1.75, -30.0, 1.75),
        (-8.5, -3.5, 0.0),
        (3.5, -8.5, 0.0),
        (8.5 - 5 / 2**0.5, -8.5 + 5 / 2**0.5, 0.0),
        (-30.0, 5.0, -1.5),
        (6.0, -20.0, -2.5),
    ],
)
def test_distance_to_the_kerb(x: float, y: float, expected: float) -> None:
    depth = layout.road_depth(np.array([x]), np.array([y]))
    np.testing.assert_allclose(depth, expected, atol=1e-12)


@pytest.mark.parametrize("name", ["straight", "right", "left"])
def test_a_car_on_the_route_stays_off_the_kerbs(name: str) -> None:
    x, y = route(name).T
    assert layout.road_depth(x, y).min() >= 1.75 - 1e-5


def test_scene_loads_and_is_exposed(variant: str) -> None:
    scene = mi.load_file(str(bundled("intersection/scene.xml")), width=48, height=32)
    image = np.array(mi.render(scene, spp=16, seed=0))[..., :3]
    assert image.shape == (32, 48, 3)
    assert np.all(np.isfinite(image))
    assert 0.05 < image.mean() < 0.5
    assert np.mean(image.max(axis=-1) > 1) < 0.02
    assert np.mean(image.max(axis=-1) < 0.01) < 0.02


def test_markings_are_where_the_lanes_are(variant: str) -> None:
    """Look straight down: paint is brighter than the asphalt beside it."""
    scene = mi.load_file(str(bundled("intersection/scene.xml")))

    def colour(x: float, y: float) -> float:
        ray = mi.Ray3f(mi.Point3f(x, y, 3.0), mi.Vector3f(0, 0, -1))
        si = scene.ray_intersect(ray)
        np.testing.assert_allclose(np.array(si.p.z), 0.0, atol=1e-5)
        return float(np.mean(np.array(si.bsdf(ray).eval_diffuse_reflectance(si))))

    for line, asphalt in (
        ((-30.0, 3.15), (-30.0, 2.6)),  # north edge line
        ((11.5, 0.0), (14.5, 0.0)),  # centre dash and gap
        ((0.0, -17.0), (0.0, -20.0)),  # the same on the side road
        ((1.5, -14.1), (-1.5, -14.1)),  # stop line of the northbound lane
        ((0.5, -11.5), (0.0, -11.5)),  # crosswalk
    ):
        assert colour(*line) > 2.5 * colour(*asphalt)


@pytest.mark.parametrize(
    ("name", "script", "extent"),
    [("hydrant", hydrant, (0.38, 0.42, 0.75)), ("car", car, (4.2, 1.8, 1.45))],
)
def test_objects_are_metric_closed_and_as_their_scripts(name, script, extent) -> None:
    world = script.world_mesh()
    np.testing.assert_allclose(world.extents, extent, atol=0.01)
    assert world.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    for part, _ in script.parts():
        assert part.is_watertight and part.volume > 0
    file = bundled(f"{name}/{name}.glb")
    loaded = trimesh.load(file, force="mesh")
    x, y, z = np.asarray(loaded.vertices).T
    back = np.stack([x, -z, y], axis=1)  # glTF's y up to z up
    np.testing.assert_allclose(back, world.vertices, atol=1e-6)
    assert file.stat().st_size < 300_000


def test_hydrant_is_upright() -> None:
    """The flange at the foot is wider than the nut at the top."""
    place = np.asarray(hydrant.world_mesh().vertices)
    foot, top = place[place[:, 2] < 0.03], place[place[:, 2] > 0.74]
    assert np.hypot(*foot.T[:2]).max() > 3 * np.hypot(*top.T[:2]).max()


def test_car_stands_on_four_wheels_and_looks_along_x() -> None:
    world = car.world_mesh()
    place, colour = np.asarray(world.vertices), world.visual.vertex_colors
    feet = np.sign(place[place[:, 2] < 0.02][:, :2])
    assert len(np.unique(feet, axis=0)) == 4
    red = (colour[:, 0] > 100) & (colour[:, 1] < 10)
    white = colour[:, :3].min(axis=1) > 190
    assert place[red, 0].max() < -1.9
    assert place[white & (np.abs(place[:, 1]) > 0.4), 0].min() > 1.9
