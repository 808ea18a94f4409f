"""What users of Mitsuba do with a scene, done with `field_integrator`."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds.fields import T, load, write_blob

from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

KEY = "fields.blob.colour"
SUN = {"type": "constant"}


@pytest.fixture
def blob(tmp_path: Path, variant: str, rng: np.random.Generator) -> dict[str, Any]:
    return write_blob(tmp_path, rng)


def shown(scene: mi.Scene, **options: Any) -> np.ndarray:
    """Render with one seed, (height, width, channels)."""
    return np.array(mi.render(scene, **{"spp": 4, "seed": 1, **options}))


def field_of(scene: mi.Scene) -> Any:
    return scene.integrator().volumes[0].field


def logit(colour: np.ndarray) -> np.ndarray:
    return np.log(colour / (1 - colour))


def floor() -> dict[str, Any]:
    return {"type": "rectangle", "to_world": T().translate([0, 0, -1.1]).scale(4)}


# Parameters


def test_a_texture_set_in_python_shows_in_the_parameters(blob, rng) -> None:
    scene = load({"a": blob})
    params, field, before = mi.traverse(scene), field_of(scene), shown(scene)
    original = mi.TensorXf(params[KEY])
    finest = field.levels()[-1].vertices
    colours = rng.uniform(0.1, 0.9, original.shape)
    raw = np.zeros((field.n_vertices, 3), np.float32)
    raw[finest] = logit(colours)
    field.set_parameter("texture", raw)
    for now in (params, mi.traverse(scene)):
        np.testing.assert_allclose(now[KEY].numpy(), colours, atol=5e-5)
    assert np.abs(shown(scene) - before).max() > 0.01
    # The values from before are a change, which Mitsuba must not leave out.
    params[KEY] = original
    params.update()
    texture = field.texture.numpy()
    np.testing.assert_allclose(texture[finest], logit(original.numpy()), atol=1e-3)
    assert not np.delete(texture, np.r_[finest], 0).any()


@pytest.mark.parametrize("value", [np.nan, 1.0])
def test_a_colour_that_is_none_is_refused(blob, value: float) -> None:
    params = mi.traverse(load({"a": blob}))
    colours = params[KEY].numpy().copy()
    colours[7, 1] = value
    params[KEY] = mi.TensorXf(colours)
    with pytest.raises(Exception, match=r"colour: 1 of \d+ values are not between"):
        params.update()


@pytest.mark.parametrize("rows", [-1, 1])
def test_colours_of_another_number_of_vertices_are_refused(blob, rows: int) -> None:
    params = mi.traverse(load({"a": blob}))
    count = params[KEY].shape[0]
    params[KEY] = mi.TensorXf(np.full((count + rows, 3), 0.5, np.float32))
    with pytest.raises(Exception, match=rf"expected \({count}, 3\)"):
        params.update()


def test_a_film_gets_another_size_after_loading(blob) -> None:
    scene = load({"a": blob, "aovs": True})
    shown(scene)
    params = mi.traverse(scene)
    params["camera.film.size"] = [24, 10]
    params["camera.film.crop_size"] = [24, 10]
    params.update()
    dr.enable_grad(params[KEY])
    params.update()
    image = mi.render(scene, params, spp=4)
    assert image.shape == (10, 24, 10)
    assert image.numpy()[..., 3].max() > 0.3
    dr.backward(dr.mean(image[..., :3]))
    assert dr.grad(params[KEY]).numpy().any()


# Surfaces that light passes straight


def pane(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Describe a rectangle between camera and blob."""
    place = T().translate([-2, 0, 0]).rotate([0, 1, 0], -90).scale(3)
    return {"pane": {"type": "rectangle", "to_world": place, "bsdf": bsdf}}


FOG = {
    "type": "cube",
    "bsdf": {"type": "null"},
    "interior": {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.5},
}
MASK = {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}


@pytest.mark.parametrize("nested", [{}, {"behind": {"type": "path"}}])
@pytest.mark.parametrize("is_mask", [True, False], ids=["mask", "fog and pane"])
def test_surfaces_that_light_passes_hide_no_field(blob, is_mask, nested) -> None:
    expected = shown(load({"a": blob, "aovs": True}))[..., 3]
    assert expected.max() > 0.3
    entries = pane(MASK if is_mask else {"type": "thindielectric"})
    if not is_mask:
        entries["fog"] = {**FOG, "to_world": T().scale(1.5)}
    scene = load({"a": blob, "aovs": True, **nested}, entries)
    np.testing.assert_allclose(shown(scene)[..., 3], expected, atol=1e-5)


# The film


def test_alpha_is_the_opacity(blob) -> None:
    scene = load({"a": blob, "aovs": True}, pixel_format="rgba")
    image = shown(scene)
    np.testing.assert_allclose(image[..., 3], image[..., 4], atol=1e-6)
    assert image[..., 3].min() < 1e-9 and 0.3 < image[..., 3].max() < 1
    # over the surfaces that a nested integrator hits
    nested, entries = {"a": blob, "behind": {"type": "path"}}, {"floor": floor()}
    behind = shown(load(nested, entries))
    wide = shown(load(nested, entries, pixel_format="rgba"))
    assert (wide[-1, :, 3] == 1).all()
    np.testing.assert_allclose(wide[0, :, 3], image[0, :, 4], atol=1e-6)
    np.testing.assert_allclose(wide[..., :3], behind, atol=1e-6)


def test_the_film_names_what_it_holds(blob) -> None:
    scene = load({"a": blob, "aovs": True})
    image = shown(scene)
    bitmap = scene.sensors()[0].film().bitmap()
    names = [one.name for one in bitmap.struct_()]
    layer = [f"blob.{name}" for name in (*"RGBA", "moment")]
    assert names == [*"RGB", "opacity", "moment", *layer]
    assert scene.integrator().aov_names()[1] == "depth"
    held = np.array(bitmap, copy=False)
    covered = image[..., 3] > 0
    for first in (3, 8):  # an opacity, and what comes after it
        opacity, depth = image[covered, first], image[covered, first + 1]
        np.testing.assert_allclose(held[covered, first], opacity, rtol=1e-6)
        np.testing.assert_allclose(held[covered, first + 1], depth * opacity, rtol=1e-4)


@pytest.mark.usefixtures("no_variant_left")
def test_a_film_of_spectral_bands(blob) -> None:
    mi.set_variant("llvm_ad_spectral")
    band = {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}
    film = {"type": "specfilm", "band": band}
    image = shown(load({"a": blob}, **film), spp=64)
    assert image.shape == (8, 12, 1)
    colour = shown(load({"a": blob}), spp=64)
    assert image[4, 6, 0] > 0.1 and not image[colour.max(-1) == 0].any()
    layered = load({"a": blob, "aovs": True}, **film)
    with pytest.raises(InputError, match="Spec.*: .*set aovs to false, or use"):
        layered.integrator().render(layered, spp=1)


# Stock integrators around and inside


@pytest.mark.parametrize("aovs", [False, True])
@pytest.mark.parametrize("kind", ["aov", "moment"])
def test_images_and_derivatives_through_stock_integrators(blob, kind, aovs) -> None:
    inside = {"type": "field_integrator", "stop": 0.0, "aovs": aovs, "a": blob}
    inside["behind"] = {"type": "prb", "max_depth": 1}  # without noise
    around = {"type": kind, "img": inside}
    if kind == "aov":
        around["aovs"] = "dd:depth"

    def differentiated(outer: dict[str, Any]) -> list[np.ndarray]:
        """Return an image and its derivatives."""
        scene = load({"a": blob}, {"i": outer, "floor": floor(), "sun": SUN})
        params = mi.traverse(scene)
        ends = ".colour", ".density", ".radiance.value"
        keys = [key for key, _ in params if key.endswith(ends)]
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, spp=4, seed=1, seed_grad=2)[..., : 3 + aovs]
        dr.backward(dr.mean(image[..., :3] * image[..., :3]) + dr.mean(image[..., -1]))
        return [image.numpy(), *(np.array(dr.grad(params[key])) for key in keys)]

    expected = differentiated(inside)
    assert len(expected) == 4 and all(np.abs(part).max() > 1e-4 for part in expected)
    actual = differentiated(around)
    np.testing.assert_allclose(actual[0], expected[0], atol=1e-5)
    for part, reference in zip(actual[1:], expected[1:], strict=True):
        np.testing.assert_allclose(part, reference, rtol=1e-3, atol=1e-6)


def test_derivatives_inside_moment_replay_random_numbers(blob) -> None:
    """Positions on rays and paths of several bounces are those of the image."""
    inside = {"type": "field_integrator", "a": blob, "jitter": True}
    inside["behind"] = {"type": "prb", "max_depth": 4}
    grey = {"type": "rgb", "value": 0.5}
    ball = {"type": "sphere", "center": [0, 0, -1]}
    ball["bsdf"] = {"type": "diffuse", "reflectance": grey}

    def gradient(outer: dict[str, Any]) -> float:
        scene = load({}, {"i": outer, "sun": SUN, "floor": floor(), "ball": ball})
        params, key = mi.traverse(scene), "ball.bsdf.reflectance.value"
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, spp=4, seed=1, seed_grad=2)[..., :3]
        dr.backward(dr.mean(image, axis=None))
        return float(dr.sum(dr.grad(params[key]))[0])

    expected = gradient(inside)
    assert expected > 0.05
    around = gradient({"type": "moment", "img": inside})
    assert around == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("aovs", [False, True])
def test_channels_of_a_nested_aov_come_last(blob, aovs: bool) -> None:
    behind = {"type": "aov", "aovs": "nn:sh_normal", "img": {"type": "path"}}
    entries = {"floor": floor(), "light": {"type": "constant"}}
    scene = load({"a": blob, "aovs": aovs, "behind": behind}, entries)
    names = scene.integrator().aov_names()
    assert names[-3:] == ["nn.X", "nn.Y", "nn.Z"]
    image = shown(scene)
    assert image.shape[2] == 3 + len(names)
    np.testing.assert_allclose(image[-1, :, -3:], [[0, 0, 1]] * 12, atol=1e-6)
    assert not image[0, :, -3:].any()


# Recorded functions


@pytest.mark.parametrize("nested", [{}, {"behind": {"type": "path"}}])
def test_a_recorded_function_renders_what_changed(blob, nested) -> None:
    gc.collect()  # Dr.Jit also looks into emitters of scenes that have been dropped
    scene = load({"a": blob, **nested}, {"light": SUN} if nested else {})
    params = mi.traverse(scene)
    recorded = dr.freeze(lambda scene: mi.render(scene, spp=4, seed=1))

    def check() -> np.ndarray:
        image = np.array(recorded(scene))
        np.testing.assert_allclose(image, shown(scene), atol=1e-6)
        return image

    images = [check(), check()]
    recordings = recorded.n_recordings
    changes = {
        KEY: lambda base: dr.clip(1 - base, 0.01, 0.99),
        "fields.blob.to_world": mi.AffineTransform4f()
        .translate([0, 0.4, 0])
        .__matmul__,
    }
    for key, change in changes.items():
        params[key] = change(params[key])
        params.update()
        images += [check()]
    field_of(scene).set_parameter("texture", 0 * field_of(scene).texture)
    images += [check()]
    np.testing.assert_array_equal(images[0], images[1])
    for before, after in zip(images[1:], images[2:], strict=False):
        assert np.abs(before - after).max() > 0.01
    assert recorded.n_recordings == recordings <= 2
