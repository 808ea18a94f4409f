"""Cameras above and behind a car: where things appear."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.deploy.views.above import scene_above
from mi_nerfattack.render.camera.intrinsics import from_fov, mount_matrix
from mi_nerfattack.render.camera.outside import Overhead, chase_mount, seen_at

POINTS = np.array([[-10.0, -3.0], [30.0, 5.0], [4.0, 17.0]])


def test_a_map_to_scale_is_what_the_camera_sees():
    """By the equation of a pinhole; what is high moves outwards a little."""
    overhead = Overhead.covering(POINTS, 2.0, 110)
    assert (overhead.width, overhead.height) == (110, 60)
    assert overhead.extent == pytest.approx((-12, 32, -5, 19))
    on_map = overhead.to_px(POINTS)
    np.testing.assert_allclose(on_map, [[5, 55], [105, 35], [40, 5]], atol=1e-9)
    pose, ground = overhead.camera_to_world, np.pad(POINTS, ((0, 0), (0, 1)))
    projected = seen_at(overhead.camera, pose, ground)
    np.testing.assert_allclose(projected, on_map, atol=1e-6)
    raised = seen_at(overhead.camera, pose, ground + [0, 0, 10.0])
    growth = (raised - [55, 30]) / (projected - [55, 30])
    np.testing.assert_allclose(growth, 1 / (1 - 10 / overhead.height_m))


def test_what_is_high_moves_outwards_by_a_28th_of_its_height_at_most():
    overhead = Overhead((-50.0, -50.0), 1.0, 100, 100)
    corner = np.array([[50.0, 50.0, 0.0], [50.0, 50.0, 10.0]])
    projected = seen_at(overhead.camera, overhead.camera_to_world, corner)
    assert np.linalg.norm(projected[1] - projected[0]) == pytest.approx(
        10 / 28, rel=0.01
    )


def test_from_behind_the_car_is_in_the_middle_and_the_road_ahead():
    state = np.array([3.0, -2.0, 0.7])
    camera, mount = from_fov(300, 200, 75.0), chase_mount(1.8)
    pose = mount_matrix(state, mount)[0]
    ahead = np.array([np.cos(0.7), np.sin(0.7), 0.0])
    at = np.append(state[:2], 0.0)
    car, far, behind = seen_at(
        camera, pose, np.stack([at, at + 30 * ahead, at - 20 * ahead])
    )
    assert car[0] == pytest.approx(150) and far[0] == pytest.approx(150)
    assert 100 < car[1] < 200 and 50 < far[1] < 100
    assert np.isnan(behind).all()


@pytest.mark.usefixtures("variant")
def test_a_room_is_seen_below_its_ceiling():
    """A red mat lies 2 m right of the middle, and 1 m above it in the picture."""

    def plate(z, x, y, half, colour, turned_deg):
        place = mi.ScalarTransform4f().translate([x, y, z])
        place = place.rotate([1, 0, 0], turned_deg).scale(half)
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
        return {"type": "rectangle", "to_world": place, "bsdf": bsdf}

    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": {"type": "point", "position": [0, 0, 2.5], "intensity": 20.0},
            "floor": plate(0.0, 0, 0, 5.0, [0.2, 0.2, 0.2], 0),
            "mat": plate(0.01, 2, 1, 0.5, [0.9, 0.0, 0.0], 0),
            "ceiling": plate(3.0, 0, 0, 5.0, [0.0, 0.9, 0.0], 180),
        }
    )
    overhead = Overhead.covering(np.array([[-4.0, -3.0], [4.0, 3.0]]), 0.0, 80)
    image = scene_above(scene, overhead, np.zeros((1, 2)), spp=4).image.astype(int)
    assert image.shape == (60, 80, 3)
    rows, columns = np.nonzero(image[..., 0] > 2 * image[..., 2] + 20)
    assert (rows.min(), rows.max()) == (15, 24)
    assert (columns.min(), columns.max()) == (55, 64)
