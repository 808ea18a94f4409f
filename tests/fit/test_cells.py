"""Cells that depth maps let a fit fill: none that a ray could step over is missing."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.far_room import BOX, SolidField, room_views
from helpers.sphere_views import world_rays

from mi_nerfattack.capture.inputs import depth_rays, find_bounds
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields import NGPLayout, Occupancy
from mi_nerfattack.fit import FitOptions, fit_ngp
from mi_nerfattack.fit.cells import cells_near_surfaces, grid_shape
from mi_nerfattack.fit.scores import FieldRenderer
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    from_fov,
    generate_rays,
    look_at,
    pose_arrays,
)
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")


def solid_near(images: PosedImages, depth: np.ndarray) -> SolidField:
    """Fill what a fit may fill: cells of 0.94 m, steps of 1.4 m at 45 m."""
    field = SolidField(0.2, 1 / 32)
    views = depth_rays(images, depth, range(len(images)))
    cells = cells_near_surfaces(views, field, grid_shape(*BOX, 72))
    field.occupy(Occupancy(cells))
    return field


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_no_ray_steps_over_a_far_wall(turn):
    """Wherever the samples of a ray lie, the wall that it shows stops it there."""
    images, depth = room_views(8, turn)
    posed = PosedField(solid_near(images, depth))
    wanted = depth[np.isfinite(depth)]
    for jitter in (0.01, 0.3, 0.5, 0.7, 0.99):
        opacity, shown = [], []
        for pose in images.camera_to_world:
            o, d = generate_rays(images.camera, *pose_arrays(pose), 1)
            rays = Rays(o, d, jitter=mi.Float(jitter))
            dr.make_opaque(rays)
            result = march(posed, rays)
            opacity.append(result.opacity.numpy())
            shown.append(result.depth.numpy())
        hit = np.isfinite(depth).ravel()
        assert np.mean(np.concatenate(opacity)[hit] < 0.5) < 5e-4
        beyond = np.concatenate(shown)[hit] - wanted
        assert np.quantile(beyond / wanted, 0.999) < 1 / 32


def test_other_views_find_no_holes_either():
    """Pixels lie up to 0.9 m apart on a wall, much more on the floor."""
    field = solid_near(*room_views(24))
    views, depth = room_views(6, seed=1, size=(160, 80))
    renderer = FieldRenderer(field)
    for known, pose in zip(depth, views.camera_to_world, strict=True):
        view = renderer.render(views.camera, pose)
        assert renderer.holes(view, views.camera, pose, known) < 0.005


def test_cells_near_a_plane_are_those_it_crosses():
    camera = from_fov(64, 32, 90.0)
    pose = look_at(np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.0, 1.3]))
    images = PosedImages(
        np.zeros((1, 32, 64, 3), np.uint8), pose[None], camera, ("plane",)
    )
    ray = world_rays(camera, pose)
    down = ray[..., 2] < 0
    depth = np.where(down, -1.5 / np.where(down, ray[..., 2], -1), np.inf)
    field = SolidField(0.01, 0.0)
    field.lower, field.upper = np.array([0.0, -5.0, -1.0]), np.array([20.0, 5.0, 3.0])
    shape = grid_shape(field.lower, field.upper, 40)
    assert shape == (40, 20, 20)
    views = depth_rays(images, depth[None].astype(np.float32), [0])
    cells = cells_near_surfaces(views, field, shape)
    assert set(np.nonzero(cells)[2]) <= {4, 5}  # the plane lies between these layers
    # pixels lie d^2 / (h f) apart, 3 m at d = 12 m, and cells are 0.5 m long
    assert cells[4:24, 8:12].any(axis=2).all()


def test_cells_reach_to_neighbours_on_the_same_surface():
    """Four near pixels 0.2 m apart, a far one beside them, and an unknown one."""
    camera = Camera(3, 2, 10.0, 10.0, 1.5, 1.0)
    pose = look_at(np.zeros(3), [1.0, 0.0, 0.0])
    images = PosedImages(np.zeros((1, 2, 3, 3), np.uint8), pose[None], camera, ("a",))
    axial = np.array([[2, 2, 8], [2, 2, np.nan]])
    depth = (axial / world_rays(camera, pose)[..., 0]).astype(np.float32)
    field = SolidField(0.01, 0.0)
    field.lower = np.array([1.5, -1.02, -0.52])
    field.upper = field.lower + 0.05 * np.array([140, 40, 20])
    cells = cells_near_surfaces(
        depth_rays(images, depth[None], [0]), field, (140, 40, 20)
    )
    near, far = (cells[part].any(axis=0) for part in (slice(70), slice(70, None)))
    expected = np.zeros((40, 20), bool)
    expected[20:25, 8:13] = True  # y from 0 to 0.2 m, z from -0.1 to 0.1 m
    np.testing.assert_array_equal(near, expected)
    assert np.argwhere(far).tolist() == [[4, 18]]  # y -0.8 m, z 0.4 m


@pytest.mark.slow
def test_fit_of_a_far_room_has_no_holes():
    images, depth = room_views(40, size=(128, 64))
    bounds = find_bounds(images, depth)
    options = FitOptions(steps=200, occupancy_resolution=256)
    result = fit_ngp(images, *bounds, NGPLayout.small(), options, depth)
    assert max(score.holes for score in result.per_view) < 0.005
