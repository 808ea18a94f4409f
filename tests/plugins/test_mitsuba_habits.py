"""What users of Mitsuba do with a scene, done with `field_integrator`."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.blob_scene import T, load, write_blob

from mi_nerfattack.errors import InputError

pytestmark = pytest.mark.usefixtures("variant")

KEY = "fields.blob.colour"


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
    found = field.texture.numpy()
    np.testing.assert_allclose(found[finest], logit(original.numpy()), atol=1e-3)
    assert not np.delete(found, np.r_[finest], 0).any()


def test_a_colour_of_the_parameters_shows_in_the_texture_and_back(blob) -> None:
    scene = load({"a": blob})
    params, before = mi.traverse(scene), shown(scene)
    texture, original = field_of(scene).texture.numpy(), mi.TensorXf(params[KEY])
    params[KEY] = dr.clip(1 - original, 0.01, 0.99)
    params.update()
    assert np.abs(field_of(scene).texture.numpy() - texture).max() > 1
    assert np.abs(shown(scene) - before).max() > 0.01
    field_of(scene).set_parameter("texture", texture)
    np.testing.assert_array_equal(params[KEY].numpy(), original.numpy())
    np.testing.assert_array_equal(shown(scene), before)


@pytest.mark.parametrize("value", [np.nan, 0.0, 1.0])
def test_a_colour_that_is_none_is_refused(blob, value: float) -> None:
    params = mi.traverse(load({"a": blob}))
    colours = params[KEY].numpy().copy()
    colours[7, 1] = value
    params[KEY] = mi.TensorXf(colours)
    with pytest.raises(Exception, match=r"colour: 1 of \d+ values are not between"):
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
INVISIBLE = {
    "fog": lambda: {"fog": {**FOG, "to_world": T().scale(1.5)}},
    "mask": lambda: pane(MASK),
    "pane": lambda: pane({"type": "thindielectric"}),
    "both": lambda: {**INVISIBLE["fog"](), **INVISIBLE["pane"]()},
}


@pytest.mark.parametrize("name", INVISIBLE)
@pytest.mark.parametrize("nested", [{}, {"behind": {"type": "path"}}])
def test_surfaces_that_light_passes_hide_no_field(blob, name, nested) -> None:
    expected = shown(load({"a": blob, "aovs": True}))[..., 3]
    scene = load({"a": blob, "aovs": True, **nested}, INVISIBLE[name]())
    assert expected.max() > 0.3
    np.testing.assert_allclose(shown(scene)[..., 3], expected, atol=1e-5)


def test_other_surfaces_hide_fields(blob) -> None:
    scene = load({"a": blob, "aovs": True}, pane({**MASK, "opacity": 1.0}))
    assert not shown(scene)[..., 3].any()


# The film


def test_alpha_is_the_opacity(blob) -> None:
    scene = load({"a": blob, "aovs": True}, pixel_format="rgba")
    image = shown(scene)
    np.testing.assert_allclose(image[..., 3], image[..., 4], atol=1e-6)
    assert image[..., 3].min() < 1e-9 and 0.3 < image[..., 3].max() < 1
    # over the surfaces that a nested integrator hits
    behind = load({"a": blob, "behind": {"type": "path"}}, {"floor": floor()})
    wide = load(
        {"a": blob, "behind": {"type": "path"}},
        {"floor": floor()},
        pixel_format="rgba",
    )
    alpha = shown(wide)[..., 3]
    assert (alpha[-1] == 1).all()
    np.testing.assert_allclose(alpha[0], image[0, :, 4], atol=1e-6)
    np.testing.assert_allclose(shown(wide)[..., :3], shown(behind), atol=1e-6)


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


def test_an_image_is_a_png_and_a_finite_loss(blob, tmp_path) -> None:
    scene = load({"a": blob})
    image = mi.render(scene, spp=4)
    assert image.shape == (8, 12, 3)
    path = tmp_path / "a.png"
    mi.util.write_bitmap(str(path), image, write_async=False)
    stored = np.array(mi.Bitmap(str(path)))
    srgb = dr.linear_to_srgb(image).numpy()
    np.testing.assert_allclose(stored / 255, srgb, atol=1.01 / 255)  # dithered
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    params.update()
    loss = dr.mean(dr.square(mi.render(scene, params)), axis=None)
    dr.backward(loss)
    assert 0 < loss.array[0] < np.inf
    assert dr.grad(params[KEY]).numpy().any()


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


@pytest.mark.parametrize("kind", ["aov", "moment"])
@pytest.mark.parametrize("aovs", [False, True])
def test_stock_integrators_around(blob, kind: str, aovs: bool) -> None:
    inside = {"type": "field_integrator", "stop": 0.0, "aovs": aovs, "a": blob}
    around = {"type": kind, "img": inside}
    if kind == "aov":
        around["aovs"] = "dd:depth"
    scene = load({"a": blob}, {"i": around, "floor": floor()})
    alone = load({"a": blob}, {"floor": floor()})
    found, expected = shown(scene), shown(alone)
    assert np.isfinite(found[..., :3]).all() and expected.max() > 0.1
    np.testing.assert_allclose(found[..., :3], expected, atol=1e-5)


@pytest.mark.parametrize("aovs", [False, True])
def test_channels_of_a_nested_aov_come_last(blob, aovs: bool) -> None:
    behind = {"type": "aov", "aovs": "nn:sh_normal", "img": {"type": "path"}}
    more = {"floor": floor(), "light": {"type": "constant"}}
    scene = load({"a": blob, "aovs": aovs, "behind": behind}, more)
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
    scene = load(
        {"a": blob, **nested}, {"light": {"type": "constant"}} if nested else {}
    )
    params = mi.traverse(scene)
    recorded = dr.freeze(lambda scene: mi.render(scene, spp=4, seed=1))

    def check() -> np.ndarray:
        found = np.array(recorded(scene))
        np.testing.assert_allclose(found, shown(scene), atol=1e-6)
        return found

    images = [check(), check()]
    recordings = recorded.n_recordings
    params[KEY] = dr.clip(1 - params[KEY], 0.01, 0.99)
    params.update()
    images += [check()]
    field_of(scene).set_parameter("texture", 0 * field_of(scene).texture)
    images += [check()]
    params["fields.blob.to_world"] = mi.AffineTransform4f().translate([0, 0.4, 0])
    params.update()
    images += [check()]
    np.testing.assert_array_equal(images[0], images[1])
    for before, after in zip(images[1:], images[2:], strict=False):
        assert np.abs(before - after).max() > 0.01
    assert recorded.n_recordings == recordings <= 2
