"""Relit fields and their shadows against closed forms, and derivatives under them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import (
    MONO,
    RGB,
    SPECTRAL,
    Derivatives,
    images,
    key_of,
)
from support.worlds import fields as small
from support.worlds.fields import T

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.lighting.relight import Relighting, ratio
from mi_nerfattack.render.lighting.surface import expected_surface, geometry
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

RAW = 0.3
RHO = small.sigmoid_to_linear(np.array(RAW))
SUN = {"type": "rgb", "value": [2.0, 1.0, 0.5]}
SUN_RGB = np.array(SUN["value"])


def relit(folder: Path, field: GridField) -> dict[str, Any]:
    """Save a field and describe it, relit."""
    path = str(folder / "field.safetensors")
    save_field(path, field)
    return {"type": "grid_field", "filename": path, "relit": True}


@pytest.fixture
def box(tmp_path: Path, variant: str) -> dict[str, Any]:
    """An opaque box [-1, 1]^3 of one colour, as a wall of density 1e4."""
    return relit(tmp_path, small.homogeneous(1e4, RAW))


def scene(
    seeing: dict[str, Any], eye=(3.0, 0.0, 0.0), fov=10, **world: Any
) -> mi.Scene:
    """Load a scene of 8 x 8 pixels that looks at the origin."""
    return small.load(seeing, world, eye=eye, fov=fov, width=8, height=8)


def sun(x: float, y: float, z: float) -> dict[str, Any]:
    """Describe a sun of irradiance `SUN` whose light travels along a direction."""
    return {"type": "directional", "direction": [x, y, z], "irradiance": SUN}


def sky(radiance: float) -> dict[str, Any]:
    """Describe a white sky all around."""
    return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}


def colour(loaded: mi.Scene, spp: int = 4) -> np.ndarray:
    """Render and average over all pixels, colour channels only."""
    image = np.array(mi.render(loaded, spp=spp))
    return image[..., : 1 if mi.is_monochromatic else 3].mean((0, 1))


@pytest.mark.parametrize("angle_deg", [0, 60, 85, 180])
def test_sun_on_a_box_is_lamberts_law(box, angle_deg: float) -> None:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    radiance = colour(scene({"object": box}, light=sun(-c, 0.0, -s)))
    np.testing.assert_allclose(radiance, RHO * max(c, 0) / np.pi * SUN_RGB, rtol=1e-2)


@pytest.mark.parametrize("each_variant", RGB + SPECTRAL + MONO, indirect=True)
def test_every_variant(each_variant: str, tmp_path: Path) -> None:
    box = relit(tmp_path, small.homogeneous(1e4, RAW))
    loaded = scene({"object": box, "relit_samples": 64}, light=sky(2.0))
    np.testing.assert_allclose(colour(loaded, 64), 2 * RHO, rtol=3e-2)
    if not mi.is_spectral:
        expected = RHO / np.pi * SUN_RGB
        if mi.is_monochromatic:
            expected = expected @ [0.212671, 0.71516, 0.072169]
        radiance = colour(scene({"object": box}, light=sun(-1, 0, 0)))
        np.testing.assert_allclose(radiance, expected, rtol=1e-2)


def test_walls_and_other_objects_block_the_sun(box) -> None:
    wall = {"type": "rectangle", "to_world": T().translate([0, 0, 5]).scale(9)}
    assert not colour(scene({"object": box}, light=sun(-1, 0, -1), wall=wall)).any()
    roof = {**box, "to_world": T().translate([3, 0, 3])}  # on the way of the light
    shaded = scene({"object": box, "roof": roof}, light=sun(-1, 0, -1))
    assert colour(shaded).max() < 1e-6


def test_light_passes_what_lets_it_through(box) -> None:
    """Object and shadow are those of a scene without the shells around them."""
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(9)}
    lamps = {"light": sun(-1, 0, -1), "floor": floor}
    inner = {"type": "sphere", "radius": 4.0, "bsdf": {"type": "null"}}
    frames = []
    for shells in ({}, {"inner": inner, "outer": {**inner, "radius": 30.0}}):
        behind = {"type": "volpath", "max_depth": 2}
        loaded = scene(
            {"object": box, "behind": behind}, (-2, 4, 9), 35, **lamps, **shells
        )
        frames.append(np.array(mi.render(loaded, spp=64))[..., :3])
    bare, inside = frames
    assert bare.min() < 0.01 < 0.1 < np.median(bare)  # a shadow on the bright floor
    np.testing.assert_allclose(inside, bare, rtol=0.03, atol=0.003)


def test_a_point_light_falls_off_with_its_distance(box) -> None:
    intensity = {"type": "rgb", "value": 8.0}
    lamp = {"type": "point", "position": [9.0, 0.0, 0.0], "intensity": intensity}
    loaded = scene({"object": box}, (60.0, 0.0, 0.0), 0.05, lamp=lamp)
    # The lamp stands 8 m from the face x = 1, and so does 1 per mill of clearance.
    np.testing.assert_allclose(colour(loaded), RHO * 8 / 64 / np.pi, rtol=1e-2)


def test_without_light_or_samples(box) -> None:
    loaded = scene({"object": box})
    with pytest.raises(InputError, match="no emitter.*add one .* or remove relit"):
        loaded.integrator().render(loaded, spp=1)
    with pytest.raises(RuntimeError, match="relit_samples: 0"):
        scene({"object": box, "relit_samples": 0}, light=sky(1.0))


# Shadows


def ground_gain(x: np.ndarray, y: np.ndarray, samples: int, **emitters: Any):
    """Return the gain of a ground z < 0 at (n,) places under a box at 1 <= z <= 3."""
    loaded = mi.load_dict({"type": "scene", **emitters}, parallel=False)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(x))
    o = np.stack([x, y, np.full(len(x), 0.3)]).astype(np.float32)
    rays = Rays(mi.Point3f(o), mi.Vector3f(mi.Float(np.zeros(len(x))), 0, -1))
    ground, above = (
        PosedField(small.homogeneous(1e4, RAW), Pose.upright((0, 0, z), 0.0, scale))
        for z, scale in ((-8, 8.0), (2, 1.0))
    )
    rule = Relighting((False, True), samples)
    return rule.gains(loaded, sampler, [ground, above], rays)[0].numpy().T


@pytest.mark.usefixtures("variant")
def test_a_shadow_falls_where_geometry_says() -> None:
    # Light along (-1, 0, -1): the box [-1, 1]^2 x [1, 3] shades -4 < x < 0, |y| < 1.
    x, y = np.meshgrid(np.linspace(-5, 2, 29) + 0.11, np.linspace(-2, 2, 17) + 0.07)
    # The last of the rays misses the ground, |x| < 8, and keeps its colour.
    x, y = np.append(x, 20), np.append(y, 0)
    gain = ground_gain(x, y, 1, sun=sun(-1, 0, -1))
    shaded = (x > -4) & (x < 0) & (np.abs(y) < 1)
    # Shadow rays start 2 steps of 0.08 m above the ground, so sideways 0.16 m.
    edge = (np.abs(x) < 0.2) | (np.abs(x + 4) < 0.2) | (np.abs(np.abs(y) - 1) < 0.05)
    for channel in gain.T:
        np.testing.assert_allclose(channel[~edge], 1.0 - shaded[~edge], atol=1e-5)


@pytest.mark.usefixtures("variant")
def test_a_shadow_neither_brightens_nor_darkens_what_is_unlit() -> None:
    lit, unshadowed = mi.Color3f(0.5, 3, 0), mi.Color3f(2, 2, 0)
    np.testing.assert_allclose(np.ravel(ratio(lit, unshadowed)), [0.25, 1, 1])


def corner_factor(a: float) -> float:
    """Return the form factor of a square of edge a over its corner, at height 1.

    Source: Howell, Catalog of Radiation Heat Transfer Configuration Factors, B-4.
    """
    r = np.sqrt(1 + a**2)
    return 2 * a / r * np.arctan(a / r) / (2 * np.pi)


@pytest.mark.usefixtures("variant")
def test_sun_and_sky_in_a_shadow() -> None:
    # Under the middle of the box only its lower face is seen; the sun stands above.
    zeros = np.zeros(256)
    gain = ground_gain(zeros, zeros, 64, sun=sun(0, 0, -1), sky=sky(0.3)).mean(0)
    height = 1 - 0.16  # of the box above where shadow rays start
    light = np.pi * 0.3
    expected = light * (1 - 4 * corner_factor(1 / height)) / (light + SUN_RGB)
    np.testing.assert_allclose(gain, expected, rtol=2e-2)


def test_surfaces_behind_are_shaded_too(box) -> None:
    # A white ground seen from the side under a hovering box, sun above, dim sky.
    ground = {"type": "rectangle", "to_world": T().scale(50)}
    ground["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    hovering = {**box, "to_world": T().translate([0, 0, 2])}
    seeing = {"object": hovering, "behind": {"type": "direct"}, "relit_samples": 64}
    world = {"ground": ground, "sun": sun(0, 0, -1), "sky": sky(0.3)}
    radiance = colour(scene(seeing, (0, -6, 0.5), 0.05, **world), 256)
    expected = 0.5 * 0.3 * (1 - 4 * corner_factor(1.0))
    np.testing.assert_allclose(radiance, expected, rtol=2e-2)


def test_lights_and_sky_behind_are_not_shaded(box) -> None:
    hovering = {**box, "to_world": T().translate([0, 0, 4])}
    seeing = {"object": hovering, "behind": {"type": "direct"}}
    lamp = {"type": "rectangle", "to_world": T().scale(3)}
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
    loaded = scene(seeing, (0, -6, 3.0), lamp=lamp, sun=sun(0, 0, -1))
    np.testing.assert_allclose(colour(loaded), 2, rtol=1e-5)


@pytest.mark.parametrize("bsdf", ["null", "thindielectric", "mask"])
def test_the_sky_behind_what_is_invisible_is_not_shaded(box, bsdf: str) -> None:
    hovering = {**box, "to_world": T().translate([0, 0, 4])}
    seeing = {"object": hovering, "behind": {"type": "path"}}
    pane: dict[str, Any] = {"type": "rectangle", "to_world": T().scale(3)}
    pane["bsdf"] = {"type": bsdf}
    if bsdf == "mask":
        pane["bsdf"] |= {"opacity": 0.0, "nested": {"type": "diffuse"}}
    if bsdf == "thindielectric":
        pane["bsdf"]["int_ior"] = 1.0  # without a reflection
    loaded = scene(seeing, (0, -6, 3.0), pane=pane, sky=sky(2.0), sun=sun(0, 0, -1))
    np.testing.assert_allclose(colour(loaded), 2, rtol=1e-5)


# Surfaces of fields


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("density", [1e4, 3.0, 1e-4])
def test_the_face_of_a_box(rng: np.random.Generator, density: float) -> None:
    o, d, _, _ = small.fan(rng)
    shape = geometry(PosedField(small.homogeneous(density)))
    surface = expected_surface(shape, Rays(o, d), 0.0)
    if density < 1:  # where nothing is, normals face the ray
        np.testing.assert_allclose(surface.normal.numpy(), -d.numpy(), atol=1e-6)
        return
    np.testing.assert_allclose(surface.normal.numpy().T, [[-1, 0, 0]] * 32)
    along = (surface.point.x.numpy() + 1) / d.x.numpy()
    reach = 2 / d.x.numpy()  # mean depth in a slab of optical depth D:
    mean = 1 / density - reach / np.expm1(np.minimum(density * reach, 50))
    np.testing.assert_allclose(along, mean, atol=0.01)


@pytest.mark.usefixtures("variant")
def test_every_face_of_a_box(rng: np.random.Generator) -> None:
    o, aim = rng.normal(size=(64, 3)), rng.uniform(-0.8, 0.8, (64, 3))
    o *= 4 / np.linalg.norm(o, axis=1, keepdims=True)
    d = (aim - o) / np.linalg.norm(aim - o, axis=1, keepdims=True)
    entered = (-np.sign(d) - o) / d  # distances of the three faces towards the ray
    face = np.eye(3)[entered.argmax(1)]
    rays = Rays(
        *(
            kind(x.T.astype(np.float32))
            for kind, x in ((mi.Point3f, o), (mi.Vector3f, d))
        )
    )
    surface = expected_surface(geometry(PosedField(small.homogeneous(1e4))), rays, 0.0)
    np.testing.assert_allclose(surface.normal.numpy().T, -np.sign(d) * face, atol=1e-6)
    place = o + entered.max(1)[:, None] * d
    np.testing.assert_allclose(surface.point.numpy().T, place, atol=0.01)


@pytest.mark.usefixtures("variant")
def test_normals_face_rays_within_what_is_homogeneous(rng: np.random.Generator) -> None:
    d = small.fan(rng)[1]
    shape = geometry(PosedField(small.homogeneous(3.0)))
    surface = expected_surface(shape, Rays(0 * mi.Point3f(d), d), 0.0)
    np.testing.assert_allclose(surface.normal.numpy(), -d.numpy(), atol=1e-6)


@pytest.mark.usefixtures("variant")
def test_the_surface_of_a_ball(rng: np.random.Generator) -> None:
    # A ball of radius 0.6 in [-1, 1]^3 whose density rises from 0.02 to 3000.
    ball = GridField(GridLayout(1, 48, 48), -small.ONES, small.ONES, step_m=0.02)
    depth = 0.6 - np.linalg.norm(small.vertices(ball), axis=1)
    raw = np.clip(2 + 60 * depth, -4, 8).astype(np.float32)
    ball.set_parameter("density", raw)
    o, d, _, _ = small.fan(rng, 256)
    pose = Pose.upright((0.2, 0.1, 0.0), 0.7, 0.8)
    surface = expected_surface(geometry(PosedField(ball, pose)), Rays(o, d), 1e-4)
    point, normal = surface.point.numpy().T, surface.normal.numpy().T
    outward = (point - pose.translation) / 0.48
    direction = d.numpy().T
    # Grazing rays end in the soft rim.
    steep = ((outward * direction).sum(1) < -0.5) & surface.active.numpy()
    assert 50 < steep.sum() < len(steep)
    radius = np.linalg.norm(outward[steep], axis=1)
    np.testing.assert_allclose(radius, 1, atol=0.05)
    cosine = (outward[steep] * normal[steep]).sum(1) / radius
    assert np.quantile(cosine, 0.1) > np.cos(np.radians(10))
    assert ((normal * direction).sum(1) <= 0).all()


# Derivatives


def problem(folder: Path, rng, name: str, composite: str) -> Derivatives:
    """Differentiate an image of two touching blobs by the parameter with a name.

    One of them is relit; both stand over a lit ground.
    """
    blob = relit(folder, small.blob(rng, step_m=0.1))
    place = T().translate([0, 0.6, -0.5]).scale(0.8)
    seeing = {"object": blob, "other": {**blob, "relit": False, "to_world": place}}
    seeing |= {"composite": composite, "behind": {"type": "direct"}, "relit_samples": 4}
    ground = {"type": "rectangle", "to_world": T().translate([0, 0, -1.2]).scale(5)}
    world = {"ground": ground, "sun": sun(-1, 0.3, -1), "sky": sky(0.5)}
    loaded = scene(seeing, (3.0, 1.0, 0.5), 50.0, **world)
    params = mi.traverse(loaded)
    return Derivatives(params, key_of(params, name), images(loaded, params))


QUICK = [(RGB[0], "other.colour", "depth"), (RGB[0], "object.colour", "depth")]
SLOW = [(name, "object.colour", "interleaved") for name in (*RGB, *SPECTRAL, *MONO)]


@pytest.mark.parametrize(
    ("each_variant", "name", "composite"),
    [*QUICK, *[pytest.param(*row, marks=pytest.mark.slow) for row in SLOW]],
    indirect=["each_variant"],
)
def test_gradients(each_variant, tmp_path: Path, rng, name, composite) -> None:
    derivatives = problem(tmp_path, rng, name, composite)
    derivatives.check([rng.normal(0, 1, derivatives.base.shape)])


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", ["object.density", "other.density"])
def test_what_changes_the_light_is_refused(tmp_path: Path, rng, name: str) -> None:
    derivatives = problem(tmp_path, rng, name, "interleaved")
    with pytest.raises(Exception, match="set relit to false"):
        derivatives.gradient()


def test_a_light_is_refused_without_a_nested_integrator(box) -> None:
    lamp = {"type": "point", "position": [9.0, 0.0, 0.0]}
    loaded = scene({"object": box}, lamp=lamp)
    params = mi.traverse(loaded)
    key = key_of(params, "intensity.value")
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(loaded, params, spp=1)
    with pytest.raises(InputError, match="^lamp.* this parameter detached"):
        dr.backward(dr.mean(image, axis=None))
