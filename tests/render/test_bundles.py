"""What neighbouring rays are said to cross is empty, and marches give the same."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds.fields import homogeneous, small_ngp

from mi_nerfattack.fields import Occupancy, load_field
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.render.scene_march import FieldMarch
from mi_nerfattack.render.walk import BUNDLE, clear_distance
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

STREET = "intersection/field.safetensors"


def camera(origin, towards, count: int, spread: float = 0.3, shift: float = 0) -> Rays:
    """Make rays side by side in a row, from one place or from a row of places."""
    place = np.linspace(-1, 1, count)
    across = np.cross(towards, [0.0, 0.0, 1.0])
    direction = np.array(towards)[:, None] + spread * across[:, None] * place
    direction[2] += 0.1 * np.sin(7 * place)
    start = np.array(origin)[:, None] + shift * across[:, None] * place
    rays = Rays(
        mi.Point3f(start.tolist()),
        mi.Vector3f((direction / np.linalg.norm(direction, axis=0)).tolist()),
        jitter=mi.Float(np.linspace(0, 0.99, count).tolist()),
    )
    dr.make_opaque(rays)
    return rays


def clear_of(posed: PosedField, rays: Rays) -> np.ndarray:
    last = dr.opaque(mi.UInt32, dr.width(rays.direction) - 1)
    return clear_distance(posed, rays, last).numpy()


def assert_empty(posed: PosedField, rays: Rays, clear: np.ndarray) -> None:
    """Look up the cells on the way, up to the end of what is clear or of the box."""
    o, d = posed.to_local(rays.origin, rays.direction)
    near, far = posed.interval(o, d, rays.t_max)
    end = np.minimum(clear, far.numpy())
    for share in np.linspace(0, 1, 101):
        t = near + mi.Float(share * (end - near.numpy()))
        unit = posed.field.unit(mi.Point3f(o + t * d))
        distance, _ = posed.field.occupancy.query(unit, mi.Bool(True))
        on_the_way = (end > near.numpy()) & (distance.numpy() == 0)
        assert not on_the_way.any()


def sparse(rng, octants: bool) -> AbstractField:
    field = small_ngp()
    cells = rng.random((24, 17, 20)) < 0.01
    bits = rng.integers(1, 256, cells.shape, np.uint8) if octants else None
    field.occupy(Occupancy(cells, bits))
    return field


@pytest.mark.parametrize("octants", [False, True])
@pytest.mark.parametrize("shift", [0.0, 0.1])
@pytest.mark.parametrize(
    ("pose", "origin", "towards"),
    [
        (None, (0.05, 0.1, -0.1), (1.0, 0.3, 0.1)),
        (None, (-4.0, 0.2, 0.1), (1.0, 0.0, 0.0)),  # from outside
        (Pose.upright((3.0, -2.0, 0.5), 0.7, 2.5), (3.1, -2.1, 0.6), (-0.8, 0.5, 0.1)),
    ],
)
def test_the_way_is_empty_and_the_march_the_same(
    rng, octants, shift, pose, origin, towards
):
    posed = PosedField(sparse(rng, octants), pose)
    rays = camera(origin, towards, 5 * BUNDLE + 3, 0.05, shift)
    clear = clear_of(posed, rays)
    assert_empty(posed, rays, clear)
    actual, expected = FieldMarch(posed, 1e-4).march(rays), march(posed, rays, 1e-4)
    for name in ("radiance", "opacity", "moment"):
        pair = [np.array(getattr(item, name)) for item in (actual, expected)]
        np.testing.assert_array_equal(*pair)


@pytest.mark.parametrize("octants", [False, True])
def test_bundles_of_any_place_and_width(rng, octants):
    posed, count = PosedField(sparse(rng, octants)), 12000
    start, towards = rng.uniform(-1.2, 1.2, (2, 3, count, 1))
    wide, far = np.exp(rng.uniform(-5, -1, (2, 1, count, 1)))
    one, other = rng.uniform(-1, 1, (2, 3, count, BUNDLE))
    origin = (start + far * one).reshape(3, -1)
    direction = (towards + wide * other).reshape(3, -1)
    direction /= np.linalg.norm(direction, axis=0)
    rays = Rays(mi.Point3f(origin.tolist()), mi.Vector3f(direction.tolist()))
    clear = clear_of(posed, rays)
    assert np.mean(clear > 0.1) > 0.1
    assert_empty(posed, rays, clear)


def test_most_of_a_street_is_crossed_together():
    """From the camera of a car to what it sees."""
    posed = PosedField(load_field(bundled(STREET)))
    rays = camera((-14.0, -1.75, 1.2), (1.0, 0.0, -0.1), 100 * BUNDLE, 0.8)
    clear = clear_of(posed, rays)
    integrals = march(posed, rays)
    assert clear.shape == (100 * BUNDLE,)
    assert_empty(posed, rays, clear)
    share = clear / integrals.depth.numpy()
    assert np.median(share) > 0.7
    assert share.max() < 1.2  # it ends where something is seen


def test_a_wider_bundle_is_clear_for_less(rng):
    posed = PosedField(sparse(rng, octants=False))
    lengths = []
    for spread in (0.01, 0.3, 40.0):
        rays = camera((0.05, 0.1, -0.1), (1.0, 0.3, 0.1), BUNDLE, spread)
        clear = clear_of(posed, rays)
        assert_empty(posed, rays, clear)
        lengths.append(clear.max())
    assert lengths[0] > lengths[1] > lengths[2]


def test_fields_without_an_empty_cell_and_with_nothing_else():
    rays = camera((-4.0, 0.2, 0.1), (1.0, 0.0, 0.0), BUNDLE)
    assert not clear_of(PosedField(homogeneous()), rays).any()
    field = small_ngp()
    field.occupy(Occupancy(np.zeros((4, 4, 4), bool)))
    assert (clear_of(PosedField(field), rays) > 6).all()
    assert not FieldMarch(PosedField(field), 1e-4).march(rays).opacity.numpy().any()
