"""Cells that depth maps let a fit fill: none that a ray could step over is missing."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds.fields import ONES, small_ngp, vertices
from support.worlds.views import ROOM, SolidField, room_views, world_rays

from mi_nerfattack.capture.inputs import depth_rays, find_bounds
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.fields import GridField, GridLayout, NGPLayout, Occupancy
from mi_nerfattack.fit import FitOptions, fit_ngp
from mi_nerfattack.fit.cells import cells_near_surfaces, grid_shape
from mi_nerfattack.fit.pruning import dense_octants, seen_matter
from mi_nerfattack.fit.scores import FieldRenderer
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

pytestmark = pytest.mark.usefixtures("variant")


def solid_near(images: PosedImages, depth: np.ndarray) -> SolidField:
    """Fill what a fit may fill: cells of 0.94 m, steps of 1.4 m at 45 m."""
    field = SolidField(0.2, 1 / 32)
    views = depth_rays(images, depth, range(len(images)))
    cells = cells_near_surfaces(views, field, grid_shape(*ROOM, 72))
    field.occupy(Occupancy(cells))
    return field


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_no_ray_steps_over_a_far_wall(turn):
    """Wherever the samples of a ray lie, the wall that it shows stops it there."""
    images, depth = room_views(8, turn)
    posed = PosedField(solid_near(images, depth))
    hit = np.isfinite(depth)
    for jitter in (0.01, 0.3, 0.5, 0.7, 0.99):
        opacity, shown = [], []
        for pose in images.camera_to_world:
            o, d = generate_rays(images.camera, *pose_arrays(pose), 1)
            rays = Rays(o, d, jitter=mi.Float(jitter))
            dr.make_opaque(rays)
            result = march(posed, rays)
            opacity.append(result.opacity.numpy().reshape(depth.shape[1:]))
            shown.append(result.depth.numpy().reshape(depth.shape[1:]))
        assert np.mean(np.stack(opacity)[hit] < 0.5) < 5e-4
        beyond = np.stack(shown)[hit] / depth[hit] - 1
        assert np.quantile(beyond, 0.999) < 1 / 32


def test_other_views_find_no_holes_either():
    """Pixels lie up to 0.9 m apart on a wall, much more on the floor."""
    field = solid_near(*room_views(24))
    views, depth = room_views(6, seed=1, size=(160, 80))
    renderer = FieldRenderer(field)
    for known, pose in zip(depth, views.camera_to_world, strict=True):
        view = renderer.render(views.camera, pose)
        assert renderer.holes(view, views.camera, pose, known) < 0.005


def cells_of(camera, pose, depth, lower, upper, shape) -> np.ndarray:
    """Return the cells of a box that one view fills."""
    blank = np.zeros((1, camera.height, camera.width, 3), np.uint8)
    images = PosedImages(blank, pose[None], camera, ("a",))
    field = SolidField(0.01, 0.0)
    field.lower, field.upper = lower, upper
    views = depth_rays(images, depth[None].astype(np.float32), [0])
    return cells_near_surfaces(views, field, shape)


def test_cells_near_a_plane_are_those_it_crosses():
    camera = from_fov(64, 32, 90.0)
    pose = look_at(np.array([0.0, 0.0, 1.5]), np.array([1.0, 0.0, 1.3]))
    down = world_rays(camera, pose)[..., 2]
    depth = np.where(down < 0, -1.5 / np.minimum(down, -1e-9), np.inf)
    lower, upper = np.array([0.0, -5.0, -1.0]), np.array([20.0, 5.0, 3.0])
    shape = grid_shape(lower, upper, 40)
    assert shape == (40, 20, 20)
    cells = cells_of(camera, pose, depth, lower, upper, shape)
    assert set(np.nonzero(cells)[2]) <= {4, 5}  # the plane lies between these layers
    # pixels lie d^2 / (h f) apart, 3 m at d = 12 m, and cells are 0.5 m long
    assert cells[4:24, 8:12].any(axis=2).all()


def test_cells_reach_to_neighbours_on_the_same_surface():
    """Four near pixels 0.2 m apart, a far one beside them, and an unknown one."""
    camera = Camera(3, 2, 10.0, 10.0, 1.5, 1.0)
    pose = look_at(np.zeros(3), [1.0, 0.0, 0.0])
    axial = np.array([[2, 2, 8], [2, 2, np.nan]])
    depth, shape = axial / world_rays(camera, pose)[..., 0], (140, 40, 20)
    lower = np.array([1.5, -1.02, -0.52])
    upper = lower + 0.05 * np.array(shape)
    cells = cells_of(camera, pose, depth, lower, upper, shape)
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


def test_dense_octants_against_their_densities_one_by_one(rng):
    field = small_ngp()
    cells = rng.random((4, 3, 2)) < 0.6
    field.occupy(Occupancy(cells))
    fine = np.stack(np.indices((24, 18, 12)), -1).reshape(-1, 3)  # six a cell and axis
    unit = (fine + 0.5) / (24, 18, 12)
    points = field.lower + unit * (field.upper - field.lower)
    density = field.density(mi.Point3f(points.T.copy()), mi.Bool(True)).numpy()
    middle = float(np.median(density[density > 0]))
    blocks = density.reshape(4, 2, 3, 3, 2, 3, 2, 2, 3).max((2, 5, 8))
    bits = (blocks >= middle).transpose(0, 2, 4, 1, 3, 5).reshape(4, 3, 2, 8)
    expected = np.packbits(bits, axis=-1, bitorder="little")[..., 0]
    octants = dense_octants(field, 1 - np.exp(-middle * field.step_m))
    differs = np.unpackbits(octants ^ expected).sum()
    assert differs <= 1  # the median is one of the densities, but for rounding
    assert 0 < np.unpackbits(octants[cells]).mean() < 1 and not octants[~cells].any()


def test_no_cell_no_octant():
    field = small_ngp()
    field.occupy(Occupancy(np.zeros((2, 2, 2), bool)))
    assert not dense_octants(field).any()


def test_cells_show_in_front_of_the_first_surface_alone():
    """Walls that end at x = 0.2 and -0.4, and haze before the first, seen from +x."""
    field = GridField(GridLayout(1, 21, 21), -ONES, ONES, step_m=0.02)
    x = vertices(field)[:, 0]
    wall = np.any([np.abs(x - 0.15) < 0.09, np.abs(x + 0.45) < 0.09], axis=0)
    haze = np.abs(x - 0.65) < 0.09
    raw = np.select([wall, haze], [np.log(200.0), np.log(0.5)], -30.0)
    field.set_parameter("density", raw.astype(np.float32))
    full = np.ones((20, 20, 20), bool)
    full[12, :, :10] = False  # from 0.2 to 0.3, where density falls
    field.occupy(Occupancy(full))
    pose = look_at(np.array([2.5, 0, 0]), np.zeros(3))[None]
    pixels, lens = np.zeros((1, 64, 64, 4), np.uint8), from_fov(64, 64, 30)
    images = PosedImages(pixels, pose, lens, ("a",))
    shown = seen_matter(field, images, [0], min_weight=0.05)
    assert not shown[~full].any() and shown[12, 6:14, 10:14].all()
    assert not shown[13:].any() and not shown[:11].any()
    with_haze = seen_matter(field, images, [0], min_weight=1e-3)
    assert with_haze[16, 6:14, 6:14].any() and not with_haze[:10, 6:14, 11:14].any()
