"""Objects stand where such things stand, judged by another method than the rule's."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers.roadside import (
    KERB_M,
    bent,
    kerb_scene,
    plate,
    small_grid,
    straight,
    surroundings,
)
from helpers.standing_places import Judge, solid_box

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.deploy.roadside.footprint import Shape, Stands
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.roadside.view import project
from mi_nerfattack.deploy.sites import PlaceSite
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.camera.intrinsics import (
    from_fov,
    generate_rays,
    pose_arrays,
)
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

DRIVE = 0.0, 38.0


def draw(fields, around: Surroundings, seed=0, rule=None, route=None):
    rule = rule or Roadside()
    route = route or around.routes[0]
    return rule.draw(fields, around, route, DRIVE, np.random.default_rng(seed))


def stands(*rows, shape=None) -> Stands:
    """Boxes of x, y, yaw; 4 m long, 2 m wide, 1 m high."""
    shape = shape or Shape.of(solid_box(4.0, 2.0, 1.0))
    x, y, yaw = np.array(rows, float).T
    ones = np.ones(len(rows))
    return Stands(shape, np.stack([x, y], -1), 0 * ones, yaw, ones)


def test_the_footprint_is_the_occupied_box():
    """Cells 2 to 4 of 8 along x, all along y, 0 to 3 of 8 along z."""
    cells = np.zeros((8, 8, 8), bool)
    cells[2:5, :, :4] = True
    field = GridField(
        GridLayout(3, 5, 12), np.array([-4.0, -1, 0]), np.array([4.0, 1, 8])
    )
    field.occupy(Occupancy(cells))
    shape = Shape.of(field)
    np.testing.assert_allclose(shape.lower, [-2, -1, 0])
    np.testing.assert_allclose(shape.upper, [1, 1, 4])
    assert shape.is_long and not Shape.of(small_grid()).is_long
    inside = (shape.points >= shape.lower) & (shape.points <= shape.upper)
    assert inside.all()
    # its pose puts the middle of what is occupied on the place
    placed = Stands(shape, *(np.array([v]) for v in ([5.0, 6.0], 0.1, np.pi / 2, 2.0)))
    pose = placed.pose(0)
    middle = 2 * pose.rotation @ [-0.5, 0, 0] + pose.translation
    np.testing.assert_allclose(middle, [5, 6, 0.1], atol=1e-12)
    np.testing.assert_allclose(placed.body()[0].mean(0)[:2], [5, 6], atol=1)


@pytest.mark.parametrize(
    ("other", "apart"),
    [
        ((0.0, 2.4, 0.0), True),  # 0.4 m between the long sides
        ((0.0, 2.2, 0.0), False),
        ((4.4, 0.0, 0.0), True),
        ((3.2, 0.0, np.pi / 2), False),  # 0.2 m
        ((3.4, 0.0, np.pi / 2), True),
        ((4.2, -0.8, np.pi / 4), True),  # only an axis of the other box tells
    ],
)
def test_boxes_are_apart_by_their_sides(other, apart):
    assert stands(other).apart(stands((0, 0, 0)), 0.3)[0] == apart
    assert stands((0, 0, 0)).apart(stands(other), 0.3)[0] == apart


def test_boxes_hide_what_is_behind_them():
    """The box reaches from -2 to 2 along x and is 1 m high; seen from 10 m before."""
    eye = np.tile([-10.0, 0.0, 0.5], (5, 1))
    points = np.array(
        [[5, 0, 0.5], [5, 0, 3.0], [5, 3, 0.5], [-3, 0, 0.5], [-20, 0, 0.5]], float
    )
    hidden = stands((0, 0, 0)).hides(eye, points)
    assert hidden.tolist() == [True, False, False, False, False]
    turned = stands((0, 0, np.pi / 2)).hides(eye, np.array([[5.0, 2.5, 0.5]] * 5))
    assert turned.all()  # 4 m wide across the view


def test_points_are_where_a_lens_shows_them():
    """Along the ray of each pixel's centre; far outside, where the lens folds, none."""
    camera = replace(from_fov(40, 20, 90.0), k1=-0.1, p1=0.005)
    rays = generate_rays(camera, *pose_arrays(np.eye(4)[None]), 1)[1].numpy().T
    image, inside = project(camera, 7.0 * rays)
    assert inside.all()
    u, v = np.meshgrid(np.arange(40) + 0.5, np.arange(20) + 0.5)
    np.testing.assert_allclose(image, np.stack([u, v], -1).reshape(-1, 2), atol=1e-3)
    outside = np.array([[2.8, 0, 1], [0, 1, 1], [0.1, 0.1, -1]], float)
    assert not project(camera, outside)[1].any()


def test_an_object_without_matter_is_refused():
    field = small_grid()
    field.occupy(Occupancy(np.zeros((4, 4, 4), bool)))
    with pytest.raises(InputError, match="no cell of its field is occupied"):
        draw([field], kerbed())


def kerbed() -> Surroundings:
    """The lane along y = 0, the kerb at y = 3, grass at z = 0 on the right."""
    return surroundings(straight(), scene=kerb_scene())


def test_things_stand_beyond_the_kerb_and_cars_along_it():
    around = kerbed()
    car, post = solid_box(4.2, 1.8, 1.5), small_grid()
    yaws = []
    for seed in range(6):
        first, second = draw([car, post], around, seed)
        yaw = np.arctan2(first.rotation[1, 0], first.rotation[0, 0])
        along = abs((yaw + np.pi / 2) % np.pi - np.pi / 2)
        assert np.degrees(along) <= 4
        for pose, half in ((first, 0.9), (second, 0.2)):
            assert pose.translation[1] - half >= 3 + 0.3 - 1e-3
            assert pose.translation[2] == pytest.approx(KERB_M, abs=1e-4)
            assert pose.scale == 1
        yaws.append(np.arctan2(second.rotation[1, 0], second.rotation[0, 0]))
    assert np.std(yaws) > 1  # posts stand at any angle


def test_draws_follow_the_seed_alone():
    around, fields = kerbed(), [small_grid(), solid_box(1, 1, 1)]
    one, other, more = (draw(fields, around, seed) for seed in (3, 3, 4))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.translation, b.translation)
    assert not np.array_equal(one[0].translation, more[0].translation)


def test_scales_belong_to_kinds_and_repeat():
    rule = Roadside(((1.0, 1.0), (2.0, 3.0)))
    arguments = (straight(), DRIVE, np.random.default_rng(0))
    fields = [small_grid() for _ in range(3)]
    around = surroundings(straight())
    scales = [p.scale for p in rule.draw(fields, around, *arguments, [1, 2, 3])]
    assert scales[1] == 1 and 2 <= scales[0] <= 3 and 2 <= scales[2] <= 3


def test_lanes_of_all_routes_stay_free():
    """A route to the left of the driven one leaves the right side alone."""
    beside = Route("beside", 0, np.array([[0.0, 4.0], [40.0, 4.0]]), 5.0)
    around = surroundings(straight(), beside)
    for seed in range(6):
        (pose,) = draw([small_grid()], around, seed)
        assert not -1.75 < pose.translation[1] < 6.5


@pytest.mark.parametrize(
    ("route", "rule"),
    [(straight(), Roadside()), (bent(), Roadside(((0.7, 3.0),)))],
    ids=["straight, natural", "left, sizes"],
)
def test_another_method_finds_nothing_wrong(route, rule):
    """Six objects beside a wall, on a bend and a straight."""
    around = surroundings(route, scene=kerb_scene())
    judge = Judge(around, route, route.length - 2)
    fields = [solid_box(4.2, 1.8, 1.5), solid_box(1, 1, 1)]
    fields += [small_grid() for _ in range(4)]
    stretch, rng = (0.0, route.length - 2), np.random.default_rng(5)
    poses = rule.draw(fields, around, route, stretch, rng)
    assert judge.findings(fields, poses) == []
    assert judge.seconds(fields, poses, 10).min() >= 0.95


def test_the_other_method_finds_what_is_wrong():
    """Poses that the rule would never draw: on the lane, in each other, unseen."""
    around, grid = kerbed(), small_grid()
    judge, (pose,) = Judge(around, straight(), 38.0), draw([grid], around)
    lane = replace(pose, translation=np.array([10.0, 1.0, 0.0]))
    far = replace(pose, translation=np.array([10.0, 30.0, KERB_M]))
    air = replace(pose, translation=pose.translation + [0, 0, 1])
    assert "on the lane" in judge.findings([grid], [lane])[0]
    assert "in one another" in judge.findings([grid, grid], [pose, pose])[0]
    assert "in the air" in judge.findings([grid], [air])[0]
    assert judge.seconds([grid], [pose], 10) >= 1 > judge.seconds([grid], [far], 10)


def test_what_stands_behind_a_wall_is_not_seen():
    """A wall 4 m long before the only free ground hides all there is."""
    wall = mi.ScalarTransform4f().translate([25, 3.2, 5]).scale([30, 0.05, 5])
    scene = mi.load_dict(
        {
            "type": "scene",
            "road": plate(0.0, 25.0, 26.8),
            "wall": {"type": "cube", "to_world": wall},
        },
        parallel=False,
    )
    around = surroundings(straight(), scene=scene)
    rule = Roadside(gap_m=(2.0, 2.5))
    with pytest.raises(InputError, match="'straight': places for 0 of 1.* 0.0 to 38.0"):
        draw([small_grid()], around, rule=rule)


def test_nothing_stands_without_ground_and_some_find_room(rng):
    """On 4.25 m beside the lane there is room for some boxes 2 m wide, not for 16."""
    scene = mi.load_dict({"type": "scene", "road": plate(0.0, 0.0, 6.0)})
    around = surroundings(straight(), scene=scene)
    with pytest.raises(InputError, match="ask for fewer or other sizes"):
        draw([solid_box(9.0, 9.0, 3.0)], around)
    boxes = 16 * [solid_box(2.0, 2.0, 1.0)]
    found = Roadside().find(boxes, around, straight(), (0.0, 6.0), rng)
    assert 0 < sum(pose is not None for pose in found) < 16


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scales": ()}, "Roadside.scales: none"),
        ({"scales": ((2.0, 1.0),)}, "2.0 to 1.0; the smaller comes first"),
        ({"view_px": 0}, "view_px: 0; must be a whole number"),
        ({"clearance_m": -1.0}, "clearance_m: -1.0; must be a finite number"),
    ],
)
def test_a_rule_out_of_range_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        Roadside(**change)


def test_ground_is_the_highest_low_surface():
    points = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 0.0], [200.0, 0.0]])
    height = kerbed().height(points)
    np.testing.assert_allclose(height, [0, KERB_M, np.nan, np.nan], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
def test_sixty_draws_beside_each_bundled_route(index):
    """Mixed numbers and kinds; none on a lane, in a wall, in another or unseen."""
    place = bundled_place()
    around = PlaceSite("mitsuba", place).load_surroundings()
    route = around.routes[index]
    judge = Judge(around, route, route.length - 2)
    kinds = [solid_box(4.2, 1.8, 1.5), solid_box(1, 1, 1), load_grid(place.objects[0])]
    rule, least = Roadside(((1.0, 1.0), (0.5, 1.5), (1.0, 3.3))), []
    for seed in range(60):
        rng, count = np.random.default_rng([19, index, seed]), 1 + seed % 6
        numbers = sorted(rng.integers(3, size=count).tolist())
        fields = [kinds[number] for number in numbers]
        stretch = (0.0, route.length - 2)
        poses = rule.draw(fields, around, route, stretch, rng, numbers)
        assert judge.findings(fields, poses) == [], seed
        least.append(judge.seconds(fields, poses, 10).min())
    print(f"{route.name}: {min(least):.1f} s at least in view")
    assert min(least) >= 0.95
