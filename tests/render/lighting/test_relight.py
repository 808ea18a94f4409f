"""Relit fields and their shadows against closed forms, and derivatives under them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.derivatives import Derivatives, images
from helpers.variants import MONO, RGB, SPECTRAL, later

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.lighting.relight import Relighting
from mi_nerfattack.render.lighting.surface import expected_surface, geometry
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

RAW = 0.3
RHO = small.sigmoid_to_linear(np.array(RAW))
SUN = {"type": "rgb", "value": [2.0, 1.0, 0.5]}
SUN_RGB = np.array(SUN["value"])


@pytest.fixture
def box(tmp_path: Path, variant: str) -> str:
    """A file with an opaque box [-1, 1]^3 of one colour, as a wall of density 1e4."""
    save_field(tmp_path / "box.safetensors", small.homogeneous(1e4, RAW))
    return str(tmp_path / "box.safetensors")


def opaque(position=(0.0, 0.0, 0.0), scale: float = 1.0) -> PosedField:
    """Place an opaque box [-1, 1]^3."""
    return PosedField(small.homogeneous(1e4, RAW), Pose.upright(position, 0.0, scale))


def volume(name: str, **more: Any) -> dict[str, Any]:
    """Describe a relit grid."""
    return {"type": "grid_field", "filename": name, "relit": True, **more}


def scene(seeing: dict[str, Any], eye=(3.0, 0.0, 0.0), **more: Any) -> mi.Scene:
    """Load a scene of 8 x 8 pixels that looks at the origin."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    film["pixel_format"] = "luminance" if mi.is_monochromatic else "rgb"
    sensor = {"type": "perspective", "fov": 10, "film": film}
    sensor["to_world"] = mi.ScalarTransform4f().look_at(list(eye), [0, 0, 0], [0, 0, 1])
    integrator = {"type": "field_integrator", "stop": 0.0, **seeing}
    everything = {"type": "scene", "i": integrator, "sensor": sensor, **more}
    return mi.load_dict(everything, parallel=False)


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> mi.ScalarTransform4f:
    """Move by metres."""
    return mi.ScalarTransform4f().translate([x, y, z])


def sun(direction, **more: Any) -> dict[str, Any]:
    """Describe a sun of irradiance `SUN` whose light travels along a direction."""
    direction = [float(v) for v in direction]
    return {"type": "directional", "direction": direction, "irradiance": SUN, **more}


def sky(radiance: float) -> dict[str, Any]:
    """Describe a white sky all around."""
    return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}


def colour(loaded: mi.Scene, spp: int = 4) -> np.ndarray:
    """Render and average over all pixels, colour channels only."""
    image = np.array(mi.render(loaded, spp=spp))
    return image[..., : 1 if mi.is_monochromatic else 3].mean((0, 1))


def expected(rgb) -> np.ndarray:
    """Turn a colour into what the variant's film records."""
    rgb = np.array(rgb)
    return rgb @ [[0.212671], [0.71516], [0.072169]] if mi.is_monochromatic else rgb


@pytest.mark.parametrize("angle_deg", [0, 60, 85])
def test_sun_on_a_box_is_lamberts_law(box: str, angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    light = sun((-np.cos(angle), 0.0, -np.sin(angle)))
    found = colour(scene({"object": volume(box)}, light=light))
    wanted = RHO * np.cos(angle) / np.pi * np.array(SUN["value"])
    np.testing.assert_allclose(found, wanted, rtol=1e-2)


@pytest.mark.parametrize("each_variant", RGB + SPECTRAL + MONO, indirect=True)
def test_every_variant(each_variant: str, tmp_path: Path) -> None:
    name = str(tmp_path / "box.safetensors")
    save_field(name, small.homogeneous(1e4, RAW))
    seeing = {"object": volume(name), "relit_samples": 64}
    found = colour(scene(seeing, light=sky(2.0)), spp=64)
    np.testing.assert_allclose(found, 2 * expected([RHO] * 3).squeeze(), rtol=3e-2)


@pytest.mark.parametrize("each_variant", MONO, indirect=True)
def test_a_grey_sun_in_mono(tmp_path: Path, each_variant: str) -> None:
    name = str(tmp_path / "box.safetensors")
    save_field(name, small.homogeneous(1e4, RAW))
    found = colour(scene({"object": volume(name)}, light=sun((-1, 0, 0))))
    np.testing.assert_allclose(found, expected(RHO / np.pi * SUN_RGB), rtol=1e-2)


def test_light_from_behind_is_dark(box: str) -> None:
    assert not colour(scene({"object": volume(box)}, light=sun((1, 0, 0)))).any()


def test_a_wall_blocks_the_sun(box: str) -> None:
    wall = {"type": "rectangle", "to_world": moved(0, 0, 5).scale(9)}
    wall["bsdf"] = {"type": "diffuse"}
    light = sun((-np.sqrt(0.5), 0, -np.sqrt(0.5)))
    lit = scene({"object": volume(box)}, light=light)
    blocked = scene({"object": volume(box)}, light=light, wall=wall)
    wanted = RHO / np.pi * np.sqrt(0.5) * SUN_RGB
    np.testing.assert_allclose(colour(lit), wanted, rtol=1e-2)
    assert not colour(blocked).any()


def test_one_object_shades_another(box: str) -> None:
    light = sun((-np.sqrt(0.5), 0, -np.sqrt(0.5)))
    roof = volume(box, to_world=moved(3, 0, 3))  # on the way of the light
    seeing = {"object": volume(box), "roof": roof}
    assert colour(scene(seeing, (3, 0, 0), light=light)).max() < 1e-6


def test_a_point_light_falls_off_with_its_distance(box: str) -> None:
    intensity = {"type": "rgb", "value": 8.0}
    lamp = {"type": "point", "position": [9.0, 0.0, 0.0], "intensity": intensity}
    eye = (60.0, 0.0, 0.0)
    loaded = scene({"object": volume(box)}, eye, lamp=lamp)
    params = mi.traverse(loaded)
    params["sensor.x_fov"] = 0.05
    params.update()
    # The lamp stands 8 m from the face x = 1, and so does 1 per mill of clearance.
    np.testing.assert_allclose(colour(loaded), RHO * 8 / 64 / np.pi, rtol=1e-2)


def test_without_emitters(box: str) -> None:
    loaded = scene({"object": volume(box)})
    with pytest.raises(InputError, match="no emitter.*add one .* or remove relit"):
        loaded.integrator().render(loaded, spp=1)


def test_no_light_samples(box: str) -> None:
    with pytest.raises(RuntimeError, match="relit_samples: 0"):
        scene({"object": volume(box), "relit_samples": 0}, light=sky(1.0))


def test_off_by_default(box: str) -> None:
    seeing = {"object": {"type": "grid_field", "filename": box}}
    plain = np.array(mi.render(scene(seeing), spp=2))
    lit = np.array(mi.render(scene(seeing, light=sky(3.0)), spp=2))
    refused = {"object": volume(box, relit=False)}
    off = np.array(mi.render(scene(refused, light=sky(3.0)), spp=2))
    assert (plain == lit).all() and (plain == off).all()


# Shadows


def downward(x, y) -> Rays:
    """Make rays that hit the ground z = 0 at given places, from just above it."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float32), np.asarray(y, np.float32))
    origin = mi.Point3f(mi.Float(x.copy()), mi.Float(y.copy()), 0.3)
    count = mi.Float(np.zeros_like(x))
    return Rays(origin, mi.Vector3f(count, 0, -1), mi.Float(dr.inf))


def independent(count: int, seed: int = 1) -> mi.Sampler:
    """Make a sampler for a number of rays."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return sampler


def lights(**emitters: Any) -> mi.Scene:
    """Load a scene of emitters alone."""
    return mi.load_dict({"type": "scene", **emitters}, parallel=False)


def ground_gain(loaded: mi.Scene, rays: Rays, samples: int) -> np.ndarray:
    """Return the gain of a ground below z = 0 under a box at 1 <= z <= 3, (n, 3)."""
    ground = opaque((0, 0, -8), 8.0)
    rule = Relighting((False, True), samples)
    sampler = independent(dr.width(rays.origin))
    gains = rule.gains(loaded, sampler, [ground, opaque((0, 0, 2))], rays)
    return gains[0].numpy().T


@pytest.mark.usefixtures("variant")
def test_a_shadow_falls_where_geometry_says() -> None:
    # Light along (-1, 0, -1): the box [-1, 1]^2 x [1, 3] shades -4 < x < 0, |y| < 1.
    loaded = lights(sun=sun((-1, 0, -1)))
    x, y = np.meshgrid(np.linspace(-5, 2, 29) + 0.11, np.linspace(-2, 2, 17) + 0.07)
    found = ground_gain(loaded, downward(x.ravel(), y.ravel()), 1)
    shaded = (x > -4) & (x < 0) & (np.abs(y) < 1)
    # Shadow rays start 2 steps of 0.08 m above the ground, so sideways 0.16 m.
    edge = (np.abs(x) < 0.2) | (np.abs(x + 4) < 0.2) | (np.abs(np.abs(y) - 1) < 0.05)
    wanted = np.where(shaded, 0.0, 1.0)[~edge]
    for channel in found.T:
        np.testing.assert_allclose(channel.reshape(x.shape)[~edge], wanted, atol=1e-5)


def corner_factor(a: float) -> float:
    """Return the form factor of a square of edge a over its corner, at height 1.

    Source: Howell, Catalog of Radiation Heat Transfer Configuration Factors, B-4.
    """
    r = np.sqrt(1 + a**2)
    return 2 * a / r * np.arctan(a / r) / (2 * np.pi)


@pytest.mark.usefixtures("variant")
def test_sun_and_sky_in_a_shadow() -> None:
    # Under the middle of the box only its lower face is seen; the sun stands above.
    radiance = 0.3
    loaded = lights(sun=sun((0, 0, -1)), sky=sky(radiance))
    rays = downward(np.zeros(256), np.zeros(256))
    found = ground_gain(loaded, rays, 64).mean(0)
    height = 1 - 0.16  # of the box above where shadow rays start
    light = np.pi * radiance
    wanted = light * (1 - 4 * corner_factor(1 / height)) / (light + SUN_RGB)
    np.testing.assert_allclose(found, wanted, rtol=2e-2)


@pytest.mark.usefixtures("variant")
def test_far_from_objects_nothing_changes() -> None:
    loaded = lights(sun=sun((0, 0, -1)))
    found = ground_gain(loaded, downward([4.0, -6.0], [5.0, 3.0]), 16)
    np.testing.assert_array_equal(found, 1)


def test_surfaces_behind_are_shaded_too(box: str) -> None:
    # A white ground seen from the side under a hovering box, sun above, dim sky.
    ground = {"type": "rectangle", "to_world": moved().scale(50)}
    ground["bsdf"] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    hovering = volume(box, to_world=moved(0, 0, 2))
    seeing = {"object": hovering, "behind": {"type": "direct"}, "relit_samples": 64}
    world = {"ground": ground, "sun": sun((0, 0, -1)), "sky": sky(0.3)}
    loaded = scene(seeing, (0, -6, 0.5), **world)
    params = mi.traverse(loaded)
    params["sensor.x_fov"] = 0.05
    params.update()
    light = np.pi * 0.3
    wanted = 0.5 / np.pi * light * (1 - 4 * corner_factor(1.0))
    np.testing.assert_allclose(colour(loaded, 256), wanted, rtol=2e-2)


def test_lights_and_sky_behind_are_not_shaded(box: str) -> None:
    hovering = volume(box, to_world=moved(0, 0, 4))
    seeing = {"object": hovering, "behind": {"type": "direct"}}
    lamp = {"type": "rectangle", "to_world": moved().scale(3)}
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
    loaded = scene(seeing, (0, -6, 3.0), lamp=lamp, sun=sun((0, 0, -1)))
    np.testing.assert_allclose(colour(loaded), 2, rtol=1e-5)


# Surfaces of fields


def ball(step_m: float = 0.02) -> GridField:
    """Make a ball of radius 0.6 in [-1, 1]^3 whose density rises from 0.02 to 3000."""
    field = GridField(GridLayout(1, 48, 48), -small.ONES, small.ONES, step_m=step_m)
    depth = 0.6 - np.linalg.norm(small.vertices(field), axis=1)
    raw = np.clip(2 + 60 * depth, -4, 8).astype(np.float32)
    field.set_parameter("density", raw)
    return field


@pytest.mark.usefixtures("variant")
def test_the_face_of_a_box(rng: np.random.Generator) -> None:
    o, d, _, _ = small.fan(rng)
    for density in (1e4, 3.0):
        shape = geometry(PosedField(small.homogeneous(density)))
        surface = expected_surface(shape, Rays(o, d), 0.0)
        np.testing.assert_allclose(surface.normal.numpy().T, [[-1, 0, 0]] * 32)
        along = (surface.point.x.numpy() + 1) / d.x.numpy()
        reach = 2 / d.x.numpy()  # mean depth in a slab of optical depth D:
        mean = 1 / density - reach / np.expm1(np.minimum(density * reach, 50))
        np.testing.assert_allclose(along, mean, atol=0.01)


@pytest.mark.usefixtures("variant")
def test_the_surface_of_a_ball(rng: np.random.Generator) -> None:
    o, d, _, _ = small.fan(rng, 256)
    pose = Pose.upright((0.2, 0.1, 0.0), 0.7, 0.8)
    surface = expected_surface(geometry(PosedField(ball(), pose)), Rays(o, d), 1e-4)
    point, normal = surface.point.numpy().T, surface.normal.numpy().T
    outward = (point - pose.translation) / 0.48
    direction = d.numpy().T
    # Grazing rays end in the soft rim.
    steep = (outward * direction).sum(1) < -0.5
    steep &= surface.active.numpy()
    assert steep.sum() > 50
    radius = np.linalg.norm(outward[steep], axis=1)
    np.testing.assert_allclose(radius, 1, atol=0.05)
    cosine = (outward[steep] * normal[steep]).sum(1) / radius
    assert np.quantile(cosine, 0.1) > np.cos(np.radians(10))
    assert ((normal * direction).sum(1) <= 0).all()


@pytest.mark.usefixtures("variant")
def test_where_nothing_is_normals_face_the_ray(rng: np.random.Generator) -> None:
    o, d, _, _ = small.fan(rng)
    missed = expected_surface(geometry(opaque((9, 9, 9))), Rays(o, d), 0.0)
    assert not missed.active.numpy().any()
    np.testing.assert_allclose(missed.normal.numpy(), -d.numpy(), atol=1e-6)
    faint = geometry(PosedField(small.homogeneous(1e-4)))
    surface = expected_surface(faint, Rays(o, d), 0.0)
    np.testing.assert_allclose(surface.normal.numpy(), -d.numpy(), atol=1e-6)


# Derivatives


def small_scene(name: str, composite: str) -> mi.Scene:
    """Load two touching blobs, one of them relit, over a lit ground."""
    beside = mi.ScalarTransform4f().translate([0, 0.6, -0.5]).scale(0.8)
    other = {"type": "grid_field", "filename": name, "to_world": beside}
    ground = {"type": "rectangle", "to_world": moved(z=-1.2).scale(5)}
    seeing = {"object": volume(name), "other": other, "relit_samples": 4}
    seeing |= {"composite": composite, "behind": {"type": "direct"}}
    world = {"ground": ground, "sun": sun((-1, 0.3, -1)), "sky": sky(0.5)}
    loaded = scene(seeing, (3.0, 1.0, 0.5), **world)
    params = mi.traverse(loaded)
    params["sensor.x_fov"] = 50.0
    params.update()
    return loaded


def problem(folder: Path, rng, name: str, composite: str) -> Derivatives:
    """Differentiate the image of two blobs by the parameter with a name."""
    path = str(folder / "blob.safetensors")
    save_field(path, small.blob(rng, step_m=0.1))
    loaded = small_scene(path, composite)
    params = mi.traverse(loaded)
    (key,) = [key for key in params.keys() if key.endswith(name)]  # noqa: SIM118
    return Derivatives(params, key, images(loaded, params))


@pytest.mark.slow
@pytest.mark.parametrize("each_variant", [*RGB, *SPECTRAL, *MONO], indirect=True)
def test_gradients_in_every_variant(each_variant, tmp_path: Path, rng) -> None:
    found = problem(tmp_path, rng, "object.colour", "interleaved")
    found.check([rng.normal(0, 1, found.base.shape)])


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", ["other.colour", *later("object.colour")])
def test_gradients_of_the_depth_composite(tmp_path: Path, rng, name: str) -> None:
    found = problem(tmp_path, rng, name, "depth")
    found.check([rng.normal(0, 1, found.base.shape)])


@pytest.mark.usefixtures("variant")
def test_what_changes_the_light_is_refused(tmp_path: Path, rng) -> None:
    for name in ("object.density", "other.density"):
        found = problem(tmp_path, rng, "object.colour", "interleaved")
        (key,) = [k for k in found.params.keys() if k.endswith(name)]  # noqa: SIM118
        value = found.params[key]
        dr.enable_grad(value)
        found.params[key] = value
        found.params.update()
        with pytest.raises(Exception, match="set relit to false"):
            dr.backward(dr.sum(found.output(), axis=None))


def test_gradients_include_the_light(box: str) -> None:
    # The image is texture colour times E / pi: twice the light, twice the gradient.
    gradients = []
    for radiance in (1.0, 2.0):
        loaded = scene({"object": volume(box)}, light=sky(radiance))
        params = mi.traverse(loaded)
        key = "i.object.colour"
        found = Derivatives(params, key, images(loaded, params))
        gradients.append(found.gradient())
    assert np.abs(gradients[0]).max() > 0
    np.testing.assert_allclose(gradients[1], 2 * gradients[0], rtol=1e-3, atol=1e-7)
