"""Comparison of fields with scenes: walls at known distances in known colours."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.pages.read import page_text
from support.worlds.fields import sigmoid_to_linear

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.cli import main
from mi_nerfattack.evaluation.field_and_scene import (
    CompareOptions,
    Comparison,
    RouteComparison,
    _stations,
    compare_with_scene,
    depth_errors,
    quantile,
)
from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    Occupancy,
    save_field,
)
from mi_nerfattack.fit.scores import ViewScore, worst_views
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.report.pages.compare import (
    document,
    judge_routes,
    write_compare_report,
)
from mi_nerfattack.report.pages.verdict import judge, verdict
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

GLOW = 0.35  # linear radiance of the scene's wall, which shines and does not reflect
RAW = 0.3  # raw colour of the field's
WALL_X = 12.0
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
SHINING = f'<emitter type="area"><rgb name="radiance" value="{GLOW}"/></emitter>'
SCENE = f"""<scene version="3.0.0">
  <integrator type="path"/>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="50"/>
      <lookat origin="{WALL_X}, 0, 0" target="0, 0, 0" up="0, 0, 1"/>
    </transform>
    {BLACK}{SHINING}
  </shape>
</scene>"""
ROUTE = {"goal": 0, "points_m": [[0, 0], [8, 0]], "lane_width_m": 3.5, "speed_ms": 5.0}
OPTIONS = CompareOptions(
    camera=from_fov(24, 16, 30.0),
    mount=CameraMount(1.0, 0.0, 0.0),
    spacing_m=4.0,
    spp=4,
    near_m=10.0,
    worst=1,
)


def wall(at: float, density: float = 1e4) -> GridField:
    """A wall that begins at x = `at`, flat in colour, 100 m wide."""
    field = GridField(
        GridLayout(2, 4, 8),
        np.array([at, -50.0, -50.0]),
        np.array([at + 20, 50.0, 50.0]),
        step_m=0.01,
    )
    n = field.n_vertices
    raw = np.full(n, np.log(density) / 2, np.float32)
    field.set_parameter("density", raw)
    field.set_parameter("texture", np.full((n, 3), RAW / 2, np.float32))
    return field


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> tuple[Path, Path]:
    """Write the scene and its one route."""
    folder = tmp_path_factory.mktemp("place")
    scene, routes = folder / "wall.xml", folder / "routes.json"
    files.write_text(scene, SCENE)
    files.write_json(routes, {"ahead": ROUTE})
    return scene, routes


@pytest.fixture(scope="module")
def offset(place) -> Comparison:
    """Compare the scene with a wall 0.2 m behind its own."""
    mi.set_variant("llvm_ad_rgb")
    calls = []
    comparison = compare_with_scene(
        wall(WALL_X + 0.2), *place, OPTIONS, lambda *state: calls.append(state)
    )
    assert calls == [(1, 3), (2, 3), (3, 3)]
    return comparison


def test_known_offset_in_depth_and_colour(offset):
    (route,) = offset.routes
    assert [at.arc_m for at in route.stations] == [0, 4, 8]
    shown = linear_to_srgb_numpy(sigmoid_to_linear(np.array([RAW])))[0]
    glow = linear_to_srgb_numpy(np.array([GLOW]))[0]
    expected = -20 * np.log10(abs(shown - glow))
    for at in route.stations:
        assert at.psnr_db == pytest.approx(expected, abs=0.02)
        assert at.ceiling_db > 80 and at.wrong == 0 and at.hazy == 0
        assert np.isnan(at.holes)  # the scene's wall stands before the field's box
    # at x = 0 the wall is 12 m away, out of reach of what counts as near
    assert np.isnan(route.stations[0].depth_median_m)
    # 0.2 m along the axis, 0.2 / cos along other rays
    edge = np.tan(np.radians(15))
    cosine = 1 / np.sqrt(1 + edge**2 + (edge * 16 / 24) ** 2)  # in the corners
    assert 0.2 - 0.01 < route.depth_median_m < route.depth_p90_m < 0.2 / cosine + 0.01
    nearer = 0.5 * (0.2 / 8 + 0.2 / 4)  # both distances hold half of the near rays
    assert 0.2 / 8 - 1e-3 < route.depth_median_relative < nearer
    for at in route.stations[1:]:
        assert 0.2 - 0.01 < at.depth_median_m < at.depth_p90_m < 0.2 / cosine + 0.01
    assert route.near == pytest.approx(2 / 3)
    (worst,) = worst_views(route.stations)
    assert worst.psnr_db == route.least("psnr_db")
    assert worst.pictures is not None and worst.pictures.depth is not None
    table = json.loads(json.dumps(document(offset), allow_nan=False))
    (entry,) = table["routes"].values()
    assert entry["frames"] == 3 and entry["stations"][0]["depth_median_m"] is None
    assert table["good_enough"] is False


@pytest.mark.parametrize("is_closed", [False, True])
def test_the_end_of_a_closed_route_is_no_second_station(is_closed):
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    route = Route("square", 0, square, closed=is_closed)
    np.testing.assert_allclose(_stations(route, 4.0), [0, 4, 8, 12])


def test_field_that_shows_nothing(place, tmp_path):
    comparison = compare_with_scene(wall(WALL_X, 1e-30), *place, OPTIONS)
    (route,) = comparison.routes
    assert route.mean("wrong") == 1
    assert route.least("psnr_db") < 10
    page = write_compare_report(tmp_path / "out", comparison, "nothing")
    assert "NaN" not in page_text(page)


def test_field_with_rings_of_holes_and_haze(place):
    """A layer of 0.2 m, and steps of 0.25 m."""
    field = wall(WALL_X - 0.1)
    field.step_m = 0.25
    field.occupy(Occupancy((np.arange(100) == 0).reshape(-1, 1, 1)))
    comparison = compare_with_scene(field, *place, OPTIONS)
    (route,) = comparison.routes
    assert 0.1 < route.mean("holes") < 0.3
    table = document(comparison)
    assert table["routes"]["ahead"]["holes"] == route.mean("holes")
    assert not table["good_enough"]
    (route,) = compare_with_scene(wall(WALL_X, 0.03), *place, OPTIONS).routes
    assert route.mean("hazy") == 1  # 1 - exp(-0.6) = 0.45 straight ahead
    assert 0 < route.mean("wrong") <= 1


def test_ceiling_is_the_noise_of_the_reference(tmp_path, place):
    """Against a clean field of the right colour, PSNR is the noise alone."""
    scene = tmp_path / "grainy.xml"
    # 63 % of the samples pass the wall, at random, and see a light of 0.6
    mask = f'<bsdf type="mask"><float name="opacity" value="0.37"/>{BLACK}</bsdf>'
    light = '<emitter type="constant"><rgb name="radiance" value="0.6"/></emitter>'
    text = SCENE.replace(BLACK, mask).replace(SHINING, "")
    files.write_text(scene, text.replace("</scene>", f"{light}</scene>"))
    options = CompareOptions(
        camera=from_fov(64, 48, 30.0), mount=OPTIONS.mount, spacing_m=8.0, spp=256
    )
    field = wall(WALL_X)
    srgb = float(linear_to_srgb_numpy(np.array([0.63 * 0.6]))[0])
    raw = np.log(srgb / (1 - srgb))
    colour = np.full((field.n_vertices, 3), raw / 2, np.float32)
    field.set_parameter("texture", colour)
    (route,) = compare_with_scene(field, scene, place[1], options).routes
    assert route.mean("ceiling_db") == pytest.approx(route.mean("psnr_db"), abs=0.4)
    assert route.mean("ceiling_db") < 70


@pytest.mark.parametrize(
    ("routes", "noise", "views"),
    [  # PSNR, its ceiling, depth error, holes
        # a noise of 24 dB alone: without it the field has 27 dB
        ([(22.2, 24.0, 0.05, 0)], True, False),
        # noisy too, but the field would have 20.6 dB without
        ([(20.0, 29.0, 0.05, 0)], False, True),
        # the noise is that of a route that is good enough
        ([(20.0, 45.0, 0.05, 0), (25.0, 28.0, 0.05, 0)], False, True),
        # depth has no noise, nor have holes
        ([(28.0, 30.0, 0.5, 0)], False, True),
        ([(28.0, 30.0, 0.05, 0.006)], False, True),
        ([(22.2, 24.0, 0.05, 0), (20.0, 45.0, 0.05, 0)], True, True),
    ],
)
def test_advice_is_for_what_is_wrong(routes, noise, views):
    compared = []
    for name, (psnr, ceiling, depth, holes) in zip("ab", routes, strict=False):
        at = ViewScore("at 0.0 m", psnr, 0.9, 0.0, holes, ceiling_db=ceiling)
        depths = [depth] * 4
        compared.append(RouteComparison(name, 10.0, (at,) * 3, *depths, 0.5))
    comparison = Comparison(tuple(compared), OPTIONS, 1.0)
    assert not document(comparison)["good_enough"]
    text = verdict(judge_routes(comparison))
    assert ("more samples per pixel" in text, "more views" in text) == (noise, views)


@pytest.mark.parametrize(
    ("psnr", "is_good"), [(24.04, True), (25.8, True), (23.9, False)]
)
def test_a_fit_and_a_comparison_have_one_limit(psnr, is_good):
    views = (ViewScore("view", psnr, 0.9, ceiling_db=45.0),) * 3
    route = RouteComparison("a", 10.0, views, 0.05, 0.1, 0.01, 0.02, 0.5)
    compared = judge_routes(Comparison((route,), OPTIONS, 1.0))
    for criteria in (judge(views), compared):
        assert all(item.met for item in criteria) == is_good
        assert verdict(criteria).startswith("Good enough") == is_good
    assert "This decides" in verdict(compared) or not is_good


def test_depth_errors_of_known_rays():
    shown = np.array([[1.0, np.inf], [9.0, 30.0]])
    depth = np.array([[1.5, 2.0], [10.0, np.inf]])
    error, relative = depth_errors(shown, depth, 15.0)
    np.testing.assert_array_equal(error, [0.5, np.inf, 1.0])
    np.testing.assert_allclose(relative, [1 / 3, np.inf, 0.1])
    assert quantile(error, 0.5) == 1 and quantile(error, 0.9) == np.inf
    assert np.isnan(quantile([], 0.5))


def test_the_command_compares_a_field_with_its_scene(place, tmp_path, capsys):
    scene, routes = place
    path = tmp_path / "wall.safetensors"
    save_field(path, wall(WALL_X))
    words = ["render", "compare", path, scene, "--routes-file", routes]
    small = ["--size", 24, 16, "--fov-deg", 30, "--spp", 2]

    def compare(*options) -> int:
        return main([str(word) for word in (*words, *small, *options)])

    assert compare("--json") == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert json.loads(line)["routes"]["ahead"]["frames"] == 5
    assert {path.name for path in (tmp_path / "wall.compare").iterdir()} == {
        "ahead_depth.png",
        "ahead_worst.png",
        "along.png",
        "metrics.json",
        "report.html",
    }
    assert mi.variant() == "llvm_ad_rgb"
    words[3] = tmp_path / "no.xml"
    assert compare() == 2 and f"error: {words[3]}: " in capsys.readouterr().err
