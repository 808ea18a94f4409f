"""Maps of another light on fields, against closed forms of boxes and plates."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds import fields as small
from support.worlds.attacks import solid

from mi_nerfattack.capture.mesh.flat import FlatObject
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import AbstractField, GridField
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.lighting.lights import (
    Light,
    Lighting,
    Sunlight,
    black_body,
    sun_direction,
)
from mi_nerfattack.render.lighting.shading import LightMaps, light_maps
from mi_nerfattack.render.march import march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain, March, Rays

pytestmark = pytest.mark.usefixtures("variant")

SUN = Sunlight(35.0, 120.0, 0.7, 4000.0)
SIDES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
STILL = np.eye(3)


def wall() -> GridField:
    """Return the opaque box [-1, 1]^3."""
    field = small.homogeneous(1e4)
    field.refine(0.1)
    return field


def irradiance(normal: np.ndarray, sun: Sunlight) -> np.ndarray:
    """Return what an unoccluded side gets over pi, (3,), by form factors."""
    towards = sun_direction(sun.elevation_deg, sun.azimuth_deg)
    direct = sun.share / (1 - sun.share) * (1 + towards[2]) / 2
    ground = 0.2 * (1 + direct * towards[2])

    def diffuse(z: float) -> float:
        return (1 + z) / 2 + ground * (1 - z) / 2

    cosine = max(0.0, float(normal @ towards))
    side_irradiance = direct * cosine * black_body(sun.colour_k) + diffuse(normal[2])
    return side_irradiance / (direct + diffuse(towards[2]))


def received(light: Light, normal: np.ndarray) -> np.ndarray:
    """Return the sum of a light's directions, (3,)."""
    return np.maximum(light.towards @ normal, 0) @ light.strength


def factors(maps: LightMaps, points: np.ndarray, row: int) -> np.ndarray:
    """Return factors at points (n, 3) in the field's frame, (n, 3)."""
    field = maps.field
    unit = (points - field.lower) / (field.upper - field.lower)
    place = mi.Point3f(*(mi.Float(x.tolist()) for x in unit.T))
    return maps.factor(place, mi.UInt32(row), mi.Bool(True)).numpy().T


def middles(field: AbstractField) -> np.ndarray:
    """Return the middles of a field's sides, (5, 3)."""
    return (field.lower + field.upper) / 2 + SIDES * (field.upper - field.lower) / 2


def test_lights_add_up_to_what_they_promise():
    captured, key = Lighting(), np.array([0.5, -0.6, 1.0]) / np.sqrt(1.61)
    assert received(captured.light(), key) == pytest.approx(np.ones(3), rel=0.01)
    away = received(captured.light(), -key)
    assert away == pytest.approx(np.full(3, captured.ambient), rel=0.01)
    light = SUN.light(STILL)
    for normal in SIDES:
        expected = irradiance(normal, SUN)
        assert received(light, normal) == pytest.approx(expected, rel=0.02)
    towards = sun_direction(SUN.elevation_deg, SUN.azimuth_deg)
    luminance = received(light, towards) @ [0.212671, 0.71516, 0.072169]
    assert luminance == pytest.approx(1, rel=0.01)
    assert black_body(6500) == pytest.approx(np.ones(3))
    red, _, blue = black_body(4000)
    assert red > 1.2 and blue < 0.7


def test_the_light_of_the_capture_changes_nothing(rng):
    maps = LightMaps(small.blob(rng, peak=5.0), SUN.light(STILL))
    (row,) = maps.rows([SUN], STILL)
    points = rng.uniform(-1, 1, (64, 3))
    assert row > 0
    for k in (row, 0):
        assert factors(maps, points, k) == pytest.approx(np.ones((64, 3)), abs=1e-6)


def test_the_sides_of_a_box_get_their_share_of_sun_and_sky():
    field = wall()
    reflectances, renders = LightMaps(field, None), LightMaps(field, Lighting().light())
    turned = Pose.upright((0, 0, 0), 0.6).rotation
    for rotation in (STILL, turned):
        (row,) = reflectances.rows([SUN], rotation)
        expected = np.array([irradiance(rotation @ side, SUN) for side in SIDES])
        light = factors(reflectances, middles(field), row)
        assert expected.max() > 2.5 * expected.min()
        assert light == pytest.approx(expected, rel=0.04)
        (row,) = renders.rows([SUN], rotation)
        before = np.array([received(Lighting().light(), side) for side in SIDES])
        light = factors(renders, middles(field), row)
        assert light == pytest.approx(expected / before, rel=0.04)


def test_an_object_shades_itself():
    """A plate below another one gets the sun only at its edge."""

    def inside(at):
        return 0.1 - np.minimum(abs(at[:, 2] - 0.6), abs(at[:, 2] + 0.6))

    field = solid(inside, [-1.0] * 3, [1.0] * 3)
    maps = LightMaps(field, None)
    above, aside = maps.rows([Sunlight(90, 0, 0.9), Sunlight(60, 90, 0.9)], STILL)
    below = np.array([[0.0, 0, -0.5], [0.9, 0, -0.5]])
    assert factors(maps, below, above).max() < 0.12
    assert factors(maps, np.array([[0.0, 0, 0.7]]), above).min() > 0.8
    middle, edge = factors(maps, below, aside)[:, 0]
    assert middle < 0.12 and edge > 0.6


def test_flat_objects_show_reflectances_on_their_front():
    for kind, normal in (("billboard", SIDES[3]), ("patch", SIDES[4])):
        field = FlatObject(kind, 2.0, 1.0, pixels_per_m=16).field()
        maps = light_maps(field)
        (row,) = maps.rows([SUN], STILL)
        at = (field.lower + field.upper) / 2
        expected = irradiance(normal, SUN)
        assert factors(maps, at[None], row)[0] == pytest.approx(expected, rel=0.04)


def test_headers_tell_the_light_of_the_capture():
    field = wall()
    expected = irradiance(SIDES[4], SUN)
    before = {0.75: received(Lighting(0.75).light(), SIDES[4]), 1.0: np.ones(3)}
    headers = [
        ({}, np.ones(3)),
        ({"fit.source": "photographs"}, np.ones(3)),
        ({"fit.source": "hydrant.glb"}, before[0.75]),
        ({"fit.source": "hydrant.glb", "fit.ambient": "1.0"}, before[1.0]),
    ]
    for info, divisor in headers:
        field.info = info
        maps = light_maps(field)
        (row,) = maps.rows([SUN], STILL)
        light = factors(maps, middles(field)[4:], row)[0]
        assert light == pytest.approx(expected / divisor, rel=0.04)


def test_rays_have_derivatives_through_a_map(rng):
    """By their origins: the object's colour and its light change along with them."""
    field = small.blob(rng, peak=6.0, step_m=0.02)
    small.empty_border(field)
    posed = PosedField(field, Pose.upright((0.2, 0, 0), 0.4, 1.3))
    posed.light_maps = maps = LightMaps(field, None)
    (row,) = maps.rows([SUN], posed.placed.rotation)
    origin = np.stack([np.full(64, 4.0), *rng.uniform(-0.6, 0.6, (2, 64))])
    along, weight = rng.normal(size=(3, 64)), rng.normal(size=(3, 64))
    gain = Gain(mi.Color3f(0.5, 1.0, 2.0), mi.UInt32(row))

    def rays(step: float) -> Rays:
        moved = mi.Point3f(*(mi.Float(x.tolist()) for x in origin + step * along))
        return Rays(moved, mi.Vector3f(-1, 0, 0), gains=[gain])

    def integrals(step: float) -> March:
        return march(*rays(step).light([posed]), rays(step))

    (lit,) = rays(0.0).light([posed])
    cotangent = March(mi.Color3f(*(mi.Float(x.tolist()) for x in weight)))
    fixed = dr.ADMode.Backward, lit, rays(0.0), integrals(0.0), cotangent
    by_origin = march_derivative(*fixed, with_rays=True)[1].origin.numpy()
    h = 1e-3
    change = integrals(h).radiance.numpy() - integrals(-h).radiance.numpy()
    difference = (change / (2 * h) * weight).sum()
    assert (by_origin * along).sum() == pytest.approx(difference, rel=0.03)
    # the map's own slope is a good part of it
    lit.light_maps = None
    plain = march_derivative(*fixed, with_rays=True)[1].origin.numpy()
    assert (plain * along).sum() != pytest.approx(difference, rel=0.1)


def test_fog_has_no_surface_to_light(rng):
    maps = LightMaps(small.blob(rng, peak=-4.0), None)
    with pytest.raises(InputError, match="sun: the grid_field is nowhere opaque"):
        maps.rows([SUN], STILL)
