"""Objects stand where such things stand, judged by another method than the rule's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.places import (
    KERB_M,
    bent,
    kerb_scene,
    plate,
    small_grid,
    straight,
    surroundings,
)

from mi_nerfattack.attack.base import Freedom
from mi_nerfattack.capture.mesh.flat import FlatObject
from mi_nerfattack.deploy.roadside.footprint import Shape, Stands
from mi_nerfattack.deploy.roadside.rule import Roadside
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.experiment.checks.standing import (
    Solid,
    lane_findings,
    meeting_findings,
    scene_findings,
)
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route


def solid_box(length: float, width: float, height: float) -> GridField:
    half = np.array([length, width]) / 2
    lower, upper = np.array([*-half, 0.0]), np.array([*half, height])
    return GridField(GridLayout(3, 5, 12), lower, upper, density_scale=60.0)


@dataclass(eq=False)
class Judge:
    """Looks at the objects of a drive along a route from 0 to `end`, metres."""

    around: Surroundings
    route: Route
    end: float

    def findings(self, fields: Sequence[GridField], poses: Sequence[Pose]) -> list[str]:
        pairs = enumerate(zip(fields, poses, strict=True))
        solids = [Solid.of(f"{i}", PosedField(*pair)) for i, pair in pairs]
        issues = list(meeting_findings(solids))
        for route in self.around.routes:  # as if a car were as wide as the lane
            issues += lane_findings(solids, route, route.lane_width_m, Freedom())
        scene = self.around.scene
        return issues + list(scene_findings(solids, self.route, scene, "scene"))

    def seconds(self, fields: Sequence[GridField], poses: Sequence[Pose], px: int):
        """Return how long each object shows at least so many pixels, seconds."""
        pairs = enumerate(zip(fields, poses, strict=True))
        boxes = {f"o{i}": box_of(*pair) for i, pair in pairs}
        scene = mi.load_dict({"type": "scene", **boxes}, parallel=False)
        arc = np.arange(0, self.end + 1e-6, self.route.speed_ms * self.around.period)
        cameras = mount_matrix(self.route.pose_at(arc), self.around.mount)
        rays = generate_rays(self.around.camera, *pose_arrays(cameras), len(arc))
        ray = mi.Ray3f(*rays)
        behind = self.around.scene.ray_intersect_preliminary(ray, coherent=True).t
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        shown = [
            (hit.shape == mi.ShapePtr(shape)) & (hit.t < behind)
            for shape in sorted(scene.shapes(), key=lambda shape: shape.id())
        ]
        counts = [item.numpy().reshape(len(arc), -1).sum(1) for item in shown]
        return self.around.period * (np.array(counts) >= px).sum(1)


def box_of(field: GridField, pose: Pose) -> dict:
    matrix = np.eye(4)
    matrix[:3, :3] = pose.scale * pose.rotation * (field.upper - field.lower) / 2
    middle = pose.scale * pose.rotation @ (field.upper + field.lower) / 2
    matrix[:3, 3] = pose.translation + middle
    return {"type": "cube", "to_world": mi.ScalarTransform4f(matrix)}


pytestmark = pytest.mark.usefixtures("variant")

DRIVE = 0.0, 38.0


def draw(fields, around: Surroundings, seed=0, rule=None, route=None):
    rule = rule or Roadside()
    route = route or around.routes[0]
    return rule.draw(fields, around, route, DRIVE, np.random.default_rng(seed))


def test_the_footprint_is_the_occupied_box():
    """Cells 2 to 4 of 8 along x, all along y, 0 to 3 of 8 along z."""
    cells = np.zeros((8, 8, 8), bool)
    cells[2:5, :, :4] = True
    lower, upper = np.array([-4.0, -1, 0]), np.array([4.0, 1, 8])
    field = GridField(GridLayout(3, 5, 12), lower, upper)
    field.occupy(Occupancy(cells))
    shape = Shape.of(field)
    np.testing.assert_allclose([shape.lower, shape.upper], [[-2, -1, 0], [1, 1, 4]])
    assert shape.is_long and not Shape.of(small_grid()).is_long
    # its pose puts the middle of what is occupied on the place
    placed = Stands(shape, *(np.array([v]) for v in ([5.0, 6.0], 0.1, np.pi / 2, 2.0)))
    pose = placed.pose(0)
    middle = 2 * pose.rotation @ [-0.5, 0, 0] + pose.translation
    np.testing.assert_allclose(middle, [5, 6, 0.1], atol=1e-12)


def stands(x: float, y: float, yaw: float) -> Stands:
    """A box 4 m long, 2 m wide, 1 m high."""
    shape = Shape.of(solid_box(4.0, 2.0, 1.0))
    return Stands(shape, np.array([[x, y]]), np.zeros(1), np.array([yaw]), np.ones(1))


@pytest.mark.parametrize(
    ("other", "apart"),
    [
        ((0.0, 2.4, 0.0), True),  # 0.4 m between the long sides
        ((0.0, 2.2, 0.0), False),
        ((3.2, 0.0, np.pi / 2), False),  # 0.2 m
        ((3.4, 0.0, np.pi / 2), True),
        ((4.2, -0.8, np.pi / 4), True),  # only an axis of the other box tells
    ],
)
def test_boxes_are_apart_by_their_sides(other, apart):
    assert stands(*other).apart(stands(0, 0, 0), 0.3)[0] == apart
    assert stands(0, 0, 0).apart(stands(*other), 0.3)[0] == apart


def test_a_turned_box_hides_what_is_behind_it():
    """Along y = 1.2 it reaches from x = -0.21 to 1.63."""
    eyes = np.tile([-10.0, 1.2, 0.5], (3, 1))
    points = np.array([[-0.8, 1.2, 0.5], [0.5, 1.2, 0.5], [5.0, 1.2, 3.5]])
    hidden = stands(0, 0, np.pi / 4).hides(eyes, points)
    assert hidden.tolist() == [False, True, False]


def kerbed() -> Surroundings:
    """The lane along y = 0, the kerb at y = 3, grass at z = 0 on the right."""
    return surroundings(straight(), scene=kerb_scene())


def test_things_stand_beyond_the_kerb_and_cars_along_it():
    around = kerbed()
    points = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 0.0], [200.0, 0.0]])
    height = around.height(points)  # the highest of what is low
    np.testing.assert_allclose(height, [0, KERB_M, np.nan, np.nan], atol=1e-5)
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
    again = draw([car, post], around, 5)  # the seed alone decides
    np.testing.assert_array_equal(again[1].translation, second.translation)


ALONG_X, ALONG_Y = np.eye(2)
BOARD, CAR, BUS = (3.0, 0.2, 2.0), (4.2, 1.8, 1.5), (12.0, 2.5, 3.0)


@pytest.mark.parametrize("route", [straight(), bent()], ids=["straight", "bent"])
@pytest.mark.parametrize(
    ("size", "facing", "front"),
    [
        (BOARD, "shape", -ALONG_Y),
        ((0.2, 3.0, 2.0), "shape", -ALONG_X),
        (BOARD, "along", None),
        (CAR, "shape", None),
        (CAR, "traffic", -ALONG_Y),
        ((4.0, 0.5, 0.4), "shape", None),  # flat on the ground
        ((1.0, 1.0, 1.0), "traffic", -ALONG_Y),
    ],
)
def test_which_way_an_object_faces(route, size, facing, front):
    """`front` is the normal that faces the traffic; else the box stands along x."""
    around, rule = surroundings(route, scene=kerb_scene()), Roadside(facing=facing)
    for seed in range(4):
        (pose,) = draw([solid_box(*size)], around, seed, rule, route)
        arc = route.project_numpy(pose.translation * [1, 1, 0]).arc_length
        lane = route.heading_at(arc)[0]
        way = np.array([np.cos(lane), np.sin(lane)])
        normal = pose.rotation[:2, :2] @ (ALONG_X if front is None else front)
        met = abs(normal @ way) if front is None else -normal @ way
        assert np.degrees(np.arccos(min(met, 1.0))) <= 4.01


def test_a_bus_is_no_board():
    board, patch = (FlatObject(x, 3.0, 2.0).field() for x in ("billboard", "patch"))
    assert Shape.of(board).is_board and not Shape.of(patch).is_board
    assert Shape.of(solid_box(*BOARD)).is_board
    assert not any(Shape.of(solid_box(*size)).is_board for size in (CAR, BUS))


@pytest.mark.parametrize("route", [straight(), bent()], ids=["straight", "left"])
def test_a_patch_lies_on_the_lane_along_it(route):
    around = surroundings(route)
    judge, patch = Judge(around, route, 38.0), FlatObject("patch", 1.8, 4.0).field()
    corners = np.array([[x, y, 0.0] for x in (-0.9, 0.9) for y in (-2.0, 2.0)])
    lateral, arcs = [], []
    for seed in range(4):
        (pose,) = draw([patch], around, seed, route=route)
        projected = route.project_numpy(pose.apply(corners))
        assert np.abs(projected.cross_track).max() <= route.lane_width_m / 2 + 0.02
        arc = route.project_numpy(pose.translation * [1, 1, 0]).arc_length
        turn = pose.yaw + np.pi / 2 - route.heading_at(arc)[0]
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) <= np.radians(4.01)
        lateral.append(route.project_numpy(pose.translation * [1, 1, 0]).cross_track[0])
        arcs.append(arc[0])
        assert judge.findings([patch], [pose]) == []
        assert judge.seconds([patch], [pose], 10).min() >= 0.95
    assert np.ptp(lateral) > 0.2
    # the drive goes on for 2 s after it
    assert DRIVE[0] <= min(arcs) and max(arcs) <= DRIVE[1] - 2 * route.speed_ms


@pytest.mark.parametrize(
    ("route", "rule"),
    [(straight(), Roadside()), (bent(), Roadside(((0.7, 3.0),)))],
    ids=["straight, natural", "left, sizes"],
)
def test_another_method_finds_nothing_wrong(route, rule):
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


def test_scales_belong_to_kinds_and_lanes_of_all_routes_stay_free():
    """A route to the left of the driven one leaves the right side alone."""
    beside = Route("beside", 0, np.array([[0.0, 4.0], [40.0, 4.0]]), 5.0)
    around, rule = surroundings(straight(), beside), Roadside(((1.0, 1.0), (2.0, 3.0)))
    fields = [small_grid() for _ in range(3)]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        poses = rule.draw(fields, around, straight(), DRIVE, rng, [1, 2, 3])
        assert poses[1].scale == 1 and 2 <= poses[0].scale <= 3
        assert not any(-1.75 < pose.translation[1] < 6.5 for pose in poses)


def test_many_find_some_room(rng):
    """On 4.25 m beside the lane there is room for some boxes 2 m wide, not for 16."""
    around, boxes = surroundings(straight(), scene=narrow()), [solid_box(2, 2, 1)] * 16
    poses = Roadside().find(boxes, around, straight(), (0.0, 6.0), rng)
    assert 0 < sum(pose is not None for pose in poses) < 16


def empty() -> GridField:
    field = small_grid()
    field.occupy(Occupancy(np.zeros((4, 4, 4), bool)))
    return field


def walled() -> mi.Scene:
    to_world = mi.ScalarTransform4f().translate([25, 3.2, 5]).scale([30, 0.05, 5])
    wall = {"type": "cube", "to_world": to_world}
    scene = {"type": "scene", "road": plate(0.0, 25.0, 26.8), "wall": wall}
    return mi.load_dict(scene, parallel=False)


def stood(make, scene=kerb_scene, **rule):
    def call():
        draw([make()], surroundings(straight(), scene=scene()), rule=Roadside(**rule))

    return call


def narrow() -> mi.Scene:
    return mi.load_dict({"type": "scene", "road": plate(0.0, 0.0, 6.0)})


test_no_room_and_rules_out_of_range_are_refused = refusals(
    (stood(empty), "no cell is occupied"),
    (stood(lambda: solid_box(9.0, 9.0, 3.0), narrow), "fewer or other sizes"),
    (stood(small_grid, walled, gap_m=(2.0, 2.5)), "'straight': .* 0 of 1.* 0.0 to 38"),
    (lambda: Roadside(scales=()), "Roadside.scales: none"),
    (lambda: Roadside(scales=((2.0, 1.0),)), "Roadside: 2.0 to 1.0"),
    (lambda: Roadside(view_px=0), "view_px: 0"),
    (lambda: Roadside(facing="up"), "facing: 'up'; must be 'shape', 'along' or"),
)
