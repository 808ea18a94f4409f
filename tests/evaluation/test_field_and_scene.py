"""Comparison of fields with scenes: walls at known distances in known colours."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.page_text import page_text
from helpers.small_fields import sigmoid_to_linear
from helpers.sphere_views import sphere_views

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.cli import main
from mi_nerfattack.commands.shared.compare_report import (
    CompareArguments,
    print_comparison,
)
from mi_nerfattack.commands.shared.fit_report import finish
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.field_and_scene import (
    CompareOptions,
    Comparison,
    RouteComparison,
    Station,
    compare_with_scene,
    depth_errors,
    quantile,
)
from mi_nerfattack.fields import (
    GridField,
    GridLayout,
    Occupancy,
    load_field,
    save_field,
)
from mi_nerfattack.fit.options import FitResult
from mi_nerfattack.fit.scores import evaluate
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.report.pages.compare import document, verdict, write_compare_report

pytestmark = pytest.mark.usefixtures("variant")

GLOW = 0.35  # linear radiance of the scene's wall, which shines and does not reflect
RAW = 0.3  # raw colour of the field's
WALL_X = 12.0
SCENE = f"""<scene version="3.0.0">
  <integrator type="path"/>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="50"/>
      <lookat origin="{WALL_X}, 0, 0" target="0, 0, 0" up="0, 0, 1"/>
    </transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="{GLOW}"/></emitter>
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
    wanted = linear_to_srgb_numpy(np.array([GLOW]))[0]
    expected = -20 * np.log10(abs(shown - wanted))
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
    assert route.near == pytest.approx(2 / 3)


def test_field_that_shows_nothing(place, tmp_path):
    comparison = compare_with_scene(wall(WALL_X, 1e-30), *place, OPTIONS)
    (route,) = comparison.routes
    assert route.mean("wrong") == 1
    assert route.least("psnr_db") < 10
    text = verdict(comparison)
    assert "Not close enough on ahead" in text
    page = write_compare_report(tmp_path / "out", comparison, "nothing")
    assert "NaN" not in page_text(page)


def test_field_with_rings_of_holes(place):
    """A layer of 0.2 m, and steps of 0.25 m."""
    field = wall(WALL_X - 0.1)
    field.step_m = 0.25
    field.occupy(Occupancy((np.arange(100) == 0).reshape(-1, 1, 1)))
    comparison = compare_with_scene(field, *place, OPTIONS)
    (route,) = comparison.routes
    assert 0.1 < route.mean("holes") < 0.3
    assert "Not close enough on ahead" in verdict(comparison)
    assert document(comparison)["routes"]["ahead"]["holes"] == route.mean("holes")


def test_half_transparent_field_is_hazy(place):
    (route,) = compare_with_scene(wall(WALL_X, 0.03), *place, OPTIONS).routes
    assert route.mean("hazy") == 1  # 1 - exp(-0.6) = 0.45 straight ahead
    assert 0 < route.mean("wrong") <= 1


def test_worst_frame_is_kept(offset):
    (route,) = offset.routes
    (frame,) = route.worst
    assert frame.station.psnr_db == route.least("psnr_db")
    assert frame.image.shape == (16, 24, 3) and frame.depth.shape == (16, 24)


def test_ceiling_is_the_noise_of_the_reference(tmp_path, place):
    """Against a clean field of the right colour, PSNR is the noise alone."""
    scene = tmp_path / "grainy.xml"
    # 63 % of the samples pass the wall, at random, and see a light of 0.6
    text = SCENE.replace(
        '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>',
        '<bsdf type="mask"><float name="opacity" value="0.37"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf>',
    ).replace('<emitter type="area"><rgb name="radiance" value="0.35"/></emitter>', "")
    text = text.replace(
        "</scene>",
        '<emitter type="constant"><rgb name="radiance" value="0.6"/></emitter></scene>',
    )
    files.write_text(scene, text)
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


def route_of(
    name: str, psnr: float, ceiling: float, depth: float, holes: float = 0.0
) -> RouteComparison:
    at = Station(0.0, psnr, ceiling, 0.9, depth, depth, 0.0, 0.0, holes)
    return RouteComparison(name, 10.0, (at,), depth, depth, depth, depth, 0.5, ())


@pytest.mark.parametrize(
    ("routes", "noise", "views"),
    [
        # a noise of 26 dB alone: without it the field has 29 dB
        ([("a", 24.2, 26.0, 0.05)], True, False),
        # noisy too, but the field would have 20.6 dB without
        ([("a", 20.0, 29.0, 0.05)], False, True),
        # the noise is that of a route that is good enough
        ([("a", 20.0, 45.0, 0.05), ("b", 27.0, 30.0, 0.05)], False, True),
        # depth has no noise
        ([("a", 28.0, 30.0, 0.5)], False, True),
        # nor have holes
        ([("a", 28.0, 30.0, 0.05, 0.006)], False, True),
        ([("a", 24.2, 26.0, 0.05), ("b", 20.0, 45.0, 0.05)], True, True),
    ],
)
def test_advice_is_for_what_is_wrong(routes, noise, views):
    compared = tuple(route_of(*route) for route in routes)
    text = verdict(Comparison(compared, OPTIONS, 1.0))
    assert "Not close enough on a" in text
    assert ("more samples per pixel" in text) == noise
    assert ("Capture more views" in text) == views


def test_depth_errors_of_known_rays():
    shown = np.array([[1.0, np.inf], [9.0, 30.0]])
    depth = np.array([[1.5, 2.0], [10.0, np.inf]])
    error, relative = depth_errors(shown, depth, 15.0)
    np.testing.assert_array_equal(error, [0.5, np.inf, 1.0])
    np.testing.assert_allclose(relative, [1 / 3, np.inf, 0.1])
    assert quantile(error, 0.5) == 1 and quantile(error, 0.9) == np.inf
    assert np.isnan(quantile([], 0.5))


def test_document_is_strict_json(offset):
    table = document(offset)
    text = json.dumps(table, allow_nan=False)
    route = json.loads(text)["routes"]["ahead"]
    assert route["frames"] == 3 and len(route["stations"]) == 3
    assert route["stations"][0]["depth_median_m"] is None
    assert table["close_enough"] is False


def test_report_and_table(place, tmp_path, capsys):
    scene, routes = place
    arguments = CompareArguments(scene, routes, (24, 16), 30.0, compare_spp=2)
    arguments.check()
    output = tmp_path / "wall.safetensors"
    comparison = arguments.run(wall(WALL_X), output)
    assert comparison is not None
    assert [path.name for path in sorted((tmp_path / "wall.compare").iterdir())] == [
        "ahead_depth.png",
        "ahead_worst.png",
        "along.png",
        "metrics.json",
        "report.html",
    ]
    print_comparison(comparison, output)
    printed = capsys.readouterr().out
    assert "ahead" in printed and "wall.compare" in printed
    assert mi.variant() == "llvm_ad_rgb"


def test_arguments_are_checked_first(place, tmp_path):
    scene, routes = place
    with pytest.raises(InputError, match="needs both"):
        CompareArguments(compare=scene).check()
    with pytest.raises(InputError, match="no.xml"):
        CompareArguments(tmp_path / "no.xml", routes).check()
    files.write_json(tmp_path / "routes.json", {})
    with pytest.raises(InputError, match="routes.json"):
        CompareArguments(scene, tmp_path / "routes.json").check()
    CompareArguments().check()
    assert CompareArguments().run(wall(1.0), tmp_path / "a") is None


def test_fit_ends_with_its_comparison(place, tmp_path, capsys):
    """One line of JSON: the scores of the fit, and the comparison beside them."""
    images, _ = sphere_views(2, alpha=False)
    field = wall(WALL_X + 0.2)
    scores = tuple(evaluate(field, images, [0]))
    psnr, ssim = scores[0].psnr_db, scores[0].ssim
    result = FitResult(field, psnr, ssim, scores, (), 1.0, 25)
    against = CompareArguments(*place, (24, 16), 30.0, compare_spp=2)
    output = tmp_path / "wall.safetensors"
    kept = tmp_path / "wall.checkpoint.safetensors"
    kept.write_bytes(b"")
    about = {"source": "x"}
    found = finish(result, images, output, about, kept, against=against)
    assert found.tell(as_json=True) == 0
    assert not kept.exists()
    table = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert table["psnr_heldout_db"] == psnr and table["steps"] == 25
    assert table["compare"]["routes"]["ahead"]["frames"] == 5
    saved = load_field(output)
    assert isinstance(saved, GridField) and saved.info["fit.source"] == "x"
    assert finish(result, images, output, {}, kept).tell(as_json=False) == 0
    assert "good enough as an object to attack" in capsys.readouterr().out
    assert (tmp_path / "wall.report" / "report.html").is_file()


def test_command_compares_a_field_file(place, tmp_path, capsys):
    scene, routes = place
    path = tmp_path / "wall.safetensors"
    save_field(path, wall(WALL_X + 0.2))
    assert main(["fit", str(path)]) == 2
    assert "is a field already" in capsys.readouterr().err
    arguments = ["--compare", str(scene), "--routes", str(routes), "--json"]
    small = ["--compare-size", "24", "16", "--compare-spp", "2"]
    assert main(["fit", str(path), *arguments, *small]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert json.loads(line)["compare"]["routes"]["ahead"]["frames"] == 5
    assert (tmp_path / "wall.compare" / "report.html").is_file()
    path.write_bytes(b"\x80\4\x95" + bytes(100))
    assert main(["fit", str(path), *arguments, *small]) == 2
    assert "wall.safetensors: is a pickle" in capsys.readouterr().err
    assert main(["fit", str(tmp_path)]) == 2
    assert "--output" in capsys.readouterr().err
