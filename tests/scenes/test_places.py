"""The places: routes on their roads, a closed horizon, and builds that repeat."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_nerfattack.deploy import PlaceSite, Roadside
from mi_nerfattack.deploy.car import CAR, SMALL_CAR, Car
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.io import files
from mi_nerfattack.scenes import bundled
from mi_nerfattack.scenes.country import build, ground, layout, paint, plants
from mi_nerfattack.scenes.mesh import MeshBuilder
from mi_nerfattack.scenes.paint import coverage, pixel_grid
from mi_nerfattack.scenes.scenery import Scenery
from mi_nerfattack.vehicle.route.route import Route, load_routes

SEED = 4
#: The surfaces that are roads, by place.
ROADS = {"intersection": ("road_main", "road_side"), "country": ("road",)}
EYE_M = 1.4
"""Of the driver's camera above the road."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Callable[[str], Path]:
    """Return the folder of a place, which is built here if it is not bundled."""
    built: dict[str, Path] = {}

    def of(place: str) -> Path:
        if place != "country":
            return bundled(place)
        if place not in built:
            built[place] = tmp_path_factory.mktemp(place)
            build.build(built[place], SEED)
        return built[place]

    return of


def mesh_of(builder: MeshBuilder) -> trimesh.Trimesh:
    vertices, _, faces = builder.arrays()
    return trimesh.Trimesh(vertices, faces, process=False)


def first_hits(scene, origin: np.ndarray, direction: np.ndarray):
    """Return the first surfaces that rays from origin (n, 3) meet."""
    origin, direction = np.broadcast_arrays(origin, direction)
    ray = mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))
    return scene.ray_intersect(ray)


@pytest.mark.parametrize("place", ROADS)
def test_from_above_the_lanes_are_road_at_height_zero(place, folder, variant) -> None:
    """Nothing hangs over a lane lower than 4 m, and its borders are road as well."""
    scene = mi.load_file(str(folder(place) / "scene.xml"))
    for route in load_routes(folder(place) / "routes.json"):
        arc = np.arange(0.25, route.length, 0.5)
        for share in (-0.49, 0.0, 0.49):
            points = route.pose_at(arc, np.full(len(arc), share * route.lane_width_m))
            above = np.column_stack([points[:, :2], np.full(len(arc), 4.0)])
            hits = first_hits(scene, above, np.array([0.0, 0.0, -1.0]))
            np.testing.assert_allclose(np.array(hits.p.z), 0.0, atol=1e-5)
            is_road = np.zeros(len(arc), bool)
            for shape in scene.shapes():
                if shape.id() in ROADS[place]:
                    is_road |= np.array(hits.shape == mi.ShapePtr(shape))
            assert is_road.all(), (route.name, arc[~is_road])


@pytest.mark.parametrize("place", ROADS)
def test_the_horizon_is_closed(place, folder, variant) -> None:
    """A level ray from the driver's eye meets something within 130 m, all around."""
    scene = mi.load_file(str(folder(place) / "scene.xml"))
    angle = 2 * np.pi * np.arange(90) / 90
    level = np.stack([np.cos(angle), np.sin(angle), np.zeros(90)], axis=1)
    for route in load_routes(folder(place) / "routes.json"):
        for x, y, _ in route.pose_at(np.linspace(0, route.length, 12)):
            hits = first_hits(scene, np.array([x, y, EYE_M]), level)
            assert np.array(hits.t).max() < 130.0, (route.name, x, y)


def curvature(points: np.ndarray) -> np.ndarray:
    """Return the curvature (n - 2,) of the circles through three points, 1/m."""
    a, b = points[1:-1] - points[:-2], points[2:] - points[1:-1]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    sides = [np.linalg.norm(v, axis=1) for v in (a, b, points[2:] - points[:-2])]
    return 2 * cross / np.prod(sides, axis=0)


@pytest.mark.parametrize(
    ("place", "car"),
    [("intersection", CAR), ("room", SMALL_CAR), ("country", CAR)],
)
def test_the_car_can_drive_the_curves(place: str, car: Car) -> None:
    if place == "country":
        entries = layout.routes()
    else:
        entries = files.read_json(bundled(f"{place}/routes.json"))
    for entry in entries.values():
        points = np.array(entry["points_m"])
        bend = np.abs(curvature(points)).max()
        assert math.atan(car.wheelbase * bend) < 0.8 * car.max_steer
        if car.control_unit == "rad/s":
            assert bend * entry["speed_ms"] < 0.8 * car.max_control
        # no step of the curvature is larger than from a straight into the arc
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        assert np.ptp(steps) < steps.mean() ** 3 * bend**2 / 12 + 4e-6


def test_country_routes_have_the_radii_and_lengths_of_the_plan() -> None:
    """Of a lane beside a centre line of known curvature.

    A lane `o` to the left of a line of length L that turns by an angle a has the length
    L - o a, and where the line has the radius r, the lane has r - o.
    """
    half = layout.LANE_WIDTH / 2
    turn = (20 + 8) / 30 - (14 + 6) / 16  # of arcs and of ramps, which count by half
    length = layout.ROUTE_TO - layout.ROUTE_FROM
    out, back = (
        np.array(layout.routes()[name]["points_m"]) for name in ("out", "back")
    )
    for points, offset, sign in ((out, -half, 1), (back, half, -1)):
        bend = sign * curvature(points)
        # rounding to a millionth of a metre moves the curvature by 4e-6 / 0.5^2
        assert bend.max() == pytest.approx(1 / (30 - offset), abs=2e-5)
        assert bend.min() == pytest.approx(-1 / (16 + offset), abs=2e-5)
        assert len(points) == int((length - offset * turn) / 0.5) + 1
        assert 0.5 * (len(points) - 1) > 60
    # the straight between the curves is the x axis, and the lanes are on either side
    for points, offset in ((out, -half), (back, half)):
        near = points[np.abs(points[:, 0]) < 4]
        np.testing.assert_allclose(near[:, 1], offset, atol=2e-6)


@pytest.mark.parametrize(
    ("s", "offset", "expected"),
    [
        (81.0, 0.0, 0.0),
        (60.0, 2.5, 2.5),
        (60.1, -7.25, 7.25),
        (99.3, 12.0, 12.0),
        (100.0, -6.0, 6.0),
    ],
)
def test_distance_to_the_centre_line(s: float, offset: float, expected: float) -> None:
    x, y = layout.at(np.array([s]), offset)[0]
    distance = layout.road_distance(np.array([x, y]))
    assert distance == pytest.approx(expected, abs=5e-4)


def test_distance_beyond_the_ends_is_the_distance_to_the_end() -> None:
    for s, angle in ((0.0, np.pi), (layout.LENGTH, 0.0)):
        angle = angle + layout.heading_at(s) + 0.4
        end = layout.at(np.array([s]))[0]
        x, y = end + 7.0 * np.array([np.cos(angle), np.sin(angle)])
        distance = layout.road_distance(np.array([x, y]))
        assert distance == pytest.approx(7.0, abs=1e-9)


def test_country_ground_faces_up_and_is_flat_beside_the_road() -> None:
    top = mesh_of(ground.road())
    up = top.face_normals[:, 2] > 0.999
    assert np.abs(top.face_normals[~up, 2]).max() < 1e-9  # the sides are upright
    np.testing.assert_array_equal(np.unique(top.triangles[up][:, :, 2]), [0.0])
    middle = top.triangles_center[~up]
    outward = [
        layout.road_distance((middle + sign * 0.1 * top.face_normals[~up])[:, :2])
        for sign in (-1, 1)
    ]
    assert (~up).any() and (outward[1] > outward[0]).all()

    hills = mesh_of(ground.hills(SEED))
    assert hills.face_normals[:, 2].min() > 0.5  # slopes below 60 degrees
    distance = layout.road_distance(hills.vertices[:, :2])
    flat = hills.vertices[distance < ground.FLAT, 2]
    np.testing.assert_allclose(flat, ground.VERGE_HEIGHT, atol=1e-12)
    # a triangle of the road's surface has no corner that the slope has raised
    assert ground.FLAT - 2.5 * 2**0.5 > ground.HALF_ROAD
    assert hills.vertices[:, 2].max() > 5.0


def pixel_of(uv: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the pixels that coordinates (n, 2) lie in."""
    column, row = np.clip(
        (uv * shape[::-1]).astype(int), 0, np.array(shape[::-1]) - 1
    ).T
    return row, column


def test_country_images_lie_on_their_meshes_as_they_were_painted() -> None:
    """A vertex shows the pixel that was painted for its place, to one pixel."""
    e = ground.EXTENT
    scale = paint.GROUND_PIXELS / (2 * e)
    x, y = pixel_grid(-e, e, -e, e, scale)
    vertices, uv, _ = ground.hills(SEED).arrays()
    pixels = pixel_of(uv, x.shape)
    np.testing.assert_allclose(x[pixels], vertices[:, 0], atol=0.51 / scale)
    np.testing.assert_allclose(y[pixels], vertices[:, 1], atol=0.51 / scale)

    half, scale = ground.HALF_ROAD, paint.ROAD_SCALE
    s, offset = pixel_grid(0, layout.LENGTH, -half, half, scale)
    vertices, uv, _ = ground.road().arrays()
    pixels = pixel_of(uv, s.shape)
    painted = layout.at(s[pixels], offset[pixels])
    away = np.linalg.norm(painted - vertices[:, :2], axis=1)
    assert away.max() < 1.1 / scale


def test_country_road_is_marked_at_the_borders_of_its_lanes() -> None:
    image = paint.road_image(SEED).mean(axis=2)
    half = ground.HALF_ROAD
    offset = pixel_grid(0, layout.LENGTH, -half, half, paint.ROAD_SCALE)[1][:, 0]
    tone = image.mean(axis=1)
    edge = np.abs(np.abs(offset) - layout.LANE_WIDTH + 0.12) < 0.03
    lane = np.abs(np.abs(offset) - layout.LANE_WIDTH / 2) < 0.5
    middle = np.abs(offset) < 0.03
    assert tone[edge].min() > tone[lane].max() + 0.2
    # dashes of 3 m in 7.5 m
    share = (image[middle].mean(axis=0) > 0.62).mean()
    assert share == pytest.approx(3 / 7.5, abs=0.02)


def test_country_leaves_are_closed_and_none_is_over_the_road() -> None:
    leaves = mesh_of(plants.plant(SEED, Scenery(SEED, 2)))
    components = leaves.split(only_watertight=False)
    assert len(components) > 300
    for component in components:
        assert component.is_watertight and component.volume > 0
        assert component.bounds[1, 2] - component.bounds[0, 2] < 12.0
    place = leaves.vertices[:, :2]
    ends = layout.at(np.array([0.0, layout.LENGTH]))
    to_end = np.linalg.norm(place[:, None] - ends, axis=2).min(axis=1)
    beside = place[to_end > 12.0]  # groves close the road where it ends
    assert layout.road_distance(beside).min() > ground.HALF_ROAD + 2.5


def test_objects_find_places_beside_the_country_road(folder, variant) -> None:
    at = folder("country")
    files_of = {"scene": at / "scene.xml", "routes": at / "routes.json", "field": None}
    site = PlaceSite("mitsuba", replace(bundled_place(), **files_of))
    around, objects = site.load_surroundings(), site.load_objects(1)
    for k, route in enumerate(around.routes):
        rng = np.random.default_rng(k)
        (pose,) = Roadside(scales=((3.3, 3.3),)).draw(
            objects, around, route, (0.0, route.length), rng
        )
        assert pose.translation[2] == pytest.approx(ground.VERGE_HEIGHT, abs=1e-3)
        x, y, _ = pose.translation
        assert layout.road_distance(np.array([x, y])) > layout.LANE_WIDTH


def test_country_road_says_where_its_files_go(monkeypatch, capsys) -> None:
    """It is not bundled, therefore the folder must be given."""
    monkeypatch.setattr("sys.argv", ["build"])
    from mi_nerfattack.scenes.place import main

    with pytest.raises(SystemExit):
        main(build.__doc__, build.build, seed=SEED)
    assert "--out" in capsys.readouterr().err
    assert not list(bundled("country").glob("*.ply"))


def test_coverage_of_a_pixel_is_the_share_on_the_inner_side() -> None:
    """Of a straight border along the pixels' sides, 0.04 m wide."""
    distance = np.array([-1.0, -0.02, -0.01, 0.0, 0.01, 0.02, 1.0])
    share = coverage(distance, 25.0)
    np.testing.assert_allclose(share, [0, 0, 0.25, 0.5, 0.75, 1, 1], atol=1e-12)


@pytest.mark.slow
def test_the_country_road_is_built_alike_from_a_seed(folder, tmp_path) -> None:
    first = folder("country")
    written = build.build(tmp_path / "again", SEED)
    assert sum(path.stat().st_size for path in written) < 4e6
    for path in written:
        one = first / path.relative_to(tmp_path / "again")
        assert one.read_bytes() == path.read_bytes(), path.name
    other = ground.hills(SEED + 1).arrays()[0]
    assert np.abs(other - ground.hills(SEED).arrays()[0]).max() > 0.1
    assert isinstance(Route.from_file(first / "routes.json", "out"), Route)
