"""The Mitsuba plugins: loading, parameters, values, and what they refuse."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import Derivatives, images, key_of
from support.worlds import fields as small
from support.worlds.fields import T

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import Occupancy, load_field, save_field
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.named_file import NamedFile
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

KINDS = ("grid_field", "ngp_field", "brick_field")
NESTING = pytest.mark.parametrize("plugin", ["field_emitter", "field_integrator"])


@pytest.fixture
def volumes(tmp_path: Path, variant: str, rng: np.random.Generator) -> dict[str, Any]:
    """A volume of each kind in [-1, 1]^3."""
    fields = small.blob(rng), small.small_ngp(), small.small_bricks(rng)
    described = {}
    for kind, field in zip(KINDS, fields, strict=True):
        path = tmp_path / f"{kind}.safetensors"
        save_field(path, field)
        described[kind] = {"type": kind, "filename": str(path)}
    return described


# Loading


@NESTING
def test_nested_fields_show_under_their_ids(volumes, plugin: str) -> None:
    nested = {"scene": volumes["ngp_field"], "object": volumes["grid_field"]}
    loaded = mi.load_dict({"type": plugin, **nested})
    assert "[fields=(scene, object)" in str(loaded)
    params = mi.traverse(loaded)
    names = ("table", "density_weights", "colour_weights", "sky", "to_world")
    expected = {f"object.{n}" for n in ("colour", "density", "to_world")}
    assert set(params.keys()) == expected | {f"scene.{n}" for n in names}
    for name in params.keys():  # noqa: SIM118  not a dict
        assert not params.flags(name) & mi.ParamFlags.NonDifferentiable.value
    if plugin == "field_integrator":
        assert loaded.aov_names() == []
        layers = [f"{name}.{c}" for name in ("scene", "object") for c in "RGBAZ"]
        loaded = mi.load_dict({"type": plugin, "aovs": True, **nested})
        assert loaded.aov_names() == ["opacity", "depth", *layers]


def test_relative_names_follow_mitsubas_file_resolver(volumes) -> None:
    path = Path(volumes["grid_field"]["filename"])
    mi.file_resolver().append(str(path.parent))
    loaded = mi.load_dict({"type": "grid_field", "filename": path.name})
    assert isinstance(loaded, mi.Volume)


def test_a_scene_file_names_bundled_fields_and_its_digest_covers_them(tmp_path) -> None:
    name, path = "cube/field.safetensors", tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="field_integrator"><volume '
        f'type="grid_field"><string name="filename" value="bundled:{name}"/>'
        "</volume></integrator></scene>"
    )
    (volume,) = mi.load_file(str(path)).integrator().volumes
    expected = load_field(bundled(name)).texture.numpy()
    np.testing.assert_array_equal(volume.field.texture.numpy(), expected)
    digest = hashlib.sha256(path.read_bytes())
    digest.update(hashlib.sha256(bundled(name).read_bytes()).digest())
    assert NamedFile("scene.xml", path).content()["sha256"] == digest.hexdigest()


# What is refused

UNEVEN = np.diag([2.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1])
SHEARED = np.eye(4)
SHEARED[0, 1] = 0.5


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"foo": 1.0}, '(?s)unreferenced pro.*"foo"'),
        *[({"to_world": m}, "to_world: .*uniform scale") for m in (*UNEVEN, SHEARED)],
        ({"to_world": np.diag([0.0, 0, 0, 1])}, "to_world: .*is singular"),
        ({"quantity": "colour"}, "quantity: 'colour'; .*density, radiance"),
        ({"step_m": 0.0}, "step_m: 0.0"),
        ({"density_limit": 0.0}, "density_limit: 0.0"),
        ({"type": "ngp_field"}, 'use <volume type="grid_field'),
        ({"type": "brick_field"}, 'use <volume type="grid_field'),
        ({"filename": "none.safetensors"}, "none.safetensors: does not exist"),
        ({"filename": "bundled:none"}, "none: not a bundled file"),
        ({"filename": None}, "filename"),
    ],
)
def test_volumes_refuse(volumes, properties: dict[str, Any], message: str) -> None:
    wrong = {**volumes["grid_field"], **properties}
    if "to_world" in properties:
        wrong["to_world"] = mi.ScalarTransform4f(properties["to_world"])
    present = {key: value for key, value in wrong.items() if value is not None}
    with pytest.raises(Exception, match=message):
        mi.load_dict(present)


@pytest.mark.parametrize(
    ("nested", "message"),
    [
        (None, "no nested volume"),
        ({"foo": 1.0}, '(?s)unreferenced pro.*"foo"'),
        ({"stop": 1.0}, "stop: 1.0; allowed is 0 <= stop < 1"),
        ({"stop": -0.1}, "stop: -0.1"),
        ({"b": {"type": "diffuse"}}, "cannot use the nested BSDF"),
        ({"one": {"type": "path"}, "two": {"type": "path"}}, "cannot use|one sampling"),
    ],
)
@NESTING
def test_nesting_plugins_refuse(volumes, plugin: str, nested, message: str) -> None:
    inside = {} if nested is None else {"a": volumes["grid_field"], **nested}
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": plugin, **inside})


# Values


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_bounds_in_the_world(volumes, rng, kind: str) -> None:
    turn = T().translate([5, 0, 0]).scale(2).rotate([0, 0, 1], 90)
    loaded = mi.load_dict({**volumes[kind], "to_world": turn, "step_m": 0.003})
    assert loaded.field.step_m == pytest.approx(0.003)
    place = rng.uniform(-1.2, 1.2, (4000, 3)).astype(np.float32)
    x, y, z = place.T
    it = dr.zeros(mi.Interaction3f, len(place))
    it.p = 2 * mi.Point3f(np.stack([-y, x, z])) + mi.Vector3f(5, 0, 0)
    evaluate = small.eval_grid if kind == "grid_field" else small.evaluate
    density, radiance = evaluate(load_field(volumes[kind]["filename"]), place)
    evaluated = loaded.eval_1(it).numpy()
    outside = (np.abs(place) > 1).any(1)
    density = np.where(outside, 0, density / 2)
    np.testing.assert_allclose(evaluated, density, rtol=1e-4, atol=1e-7)
    spectrum = loaded.eval(it).numpy()
    np.testing.assert_allclose(spectrum, np.tile(evaluated, (3, 1)), rtol=1e-5)
    colour = loaded.eval_3(it).numpy().T
    assert not colour[outside].any()
    if kind == "grid_field":
        np.testing.assert_allclose(colour[~outside], radiance[~outside], atol=1e-5)
    assert 0 < evaluated.max() <= loaded.max() < 10 * evaluated.max()
    assert loaded.max_per_channel() == [loaded.max()] * 3
    askew = T().translate([5, 0, 0]).scale(2).rotate([0, 0, 1], 45)
    box, reach = mi.load_dict({**volumes[kind], "to_world": askew}).bbox(), np.sqrt(8)
    np.testing.assert_allclose(box.min, [5 - reach, -reach, -2], rtol=1e-5)
    np.testing.assert_allclose(box.max, [5 + reach, reach, 2], rtol=1e-5)


def test_a_density_given_back_changes_nothing() -> None:
    name = str(bundled("hydrant/field.safetensors"))
    nested = {"aovs": True, "a": {"type": "grid_field", "filename": name}}
    view = {"eye": (-2, 0.3, 0.6), "target": (0, 0, 0.375), "fov": 35}
    scene = small.load(nested, **view, width=32, height=48)
    before = np.array(mi.render(scene, spp=1))
    params = mi.traverse(scene)
    key = key_of(params, "density")
    params[key] = params[key] + 0
    params.update()
    after = np.array(mi.render(scene, spp=1))
    assert before[..., 3].max() > 0.99
    np.testing.assert_allclose(after[..., :4], before[..., :4], atol=1e-4)


# Bricks and thin parts


def volume_of(field: Any) -> mi.Volume:
    """Make the volume ``scene`` of a loaded field."""
    from mi_nerfattack.plugins import loaded  # of the variant

    return loaded.volume_of(PosedField(field), "scene")


def shown(volume: Any, **nested: Any) -> np.ndarray:
    loaded = small.load({**nested, "scene": volume}, width=24, height=16)
    return mi.render(loaded, spp=1).numpy()


def test_a_file_and_a_field_in_memory_are_seen_alike_before_the_sky(volumes) -> None:
    bricks = volumes["brick_field"]
    image = shown(bricks)
    shared = shown(volume_of(load_field(bricks["filename"])))
    np.testing.assert_allclose(image, shared, atol=1e-6)
    opacity = shown(bricks, aovs=True)[..., 3]
    sky = image[opacity == 0]
    assert len(sky) > 10 and sky.std() > 0.01 and opacity.max() > 0.9


def test_bricks_have_no_derivative_and_no_normals(volumes) -> None:
    loaded = small.load({"scene": volumes["brick_field"]})
    params = mi.traverse(loaded)
    key = "fields.scene.to_world"
    assert params.flags(key) & mi.ParamFlags.NonDifferentiable.value
    dr.enable_grad(params[key].matrix)
    params.update()
    image = mi.render(loaded, params, spp=1)
    with pytest.raises(InputError, match="brick_field: .* keep the camera detached"):
        dr.backward(dr.mean(image))
    with pytest.raises(RuntimeError, match="cannot be relit; set relit to false"):
        mi.load_dict({**volumes["brick_field"], "relit": True})


def test_colours_beside_bricks_have_a_derivative_in_an_emitter(volumes, rng) -> None:
    lamp = {"type": "field_emitter", "a": volumes["grid_field"]}
    lamp["b"] = volumes["brick_field"]
    cube = {"type": "cube", "to_world": T().scale(1.1), "emitter": lamp}
    loaded = small.load({"type": "prb", "max_depth": 1}, {"cube": cube})
    params = mi.traverse(loaded)
    derivatives = Derivatives(params, key_of(params, "colour"), images(loaded, params))
    direction = rng.normal(0, 1, derivatives.base.shape)
    backward = float(derivatives.gradient() @ direction.ravel())
    expected = derivatives.difference(direction, 0.05)
    assert backward == pytest.approx(expected, rel=1e-3)


def test_thin_parts_that_are_skipped_have_no_derivative_by_a_pose(tmp_path) -> None:
    """Also in the image: a file that is loaded with `skip_thin` shows fewer parts."""
    ngp = small.small_ngp()
    small.empty_border(ngp, 8)
    cells = ngp.occupancy.cells  # every second octant is thin
    ngp.occupy(Occupancy(cells, np.full(cells.shape, 0b01010101, np.uint8)))
    path = tmp_path / "ngp.safetensors"
    save_field(path, ngp)
    described = {"type": "ngp_field", "filename": str(path)}
    full, thin = shown(described), shown({**described, "skip_thin": True})
    assert np.abs(full - thin).max() > 0.01
    # files have half precision
    np.testing.assert_allclose(thin, shown(volume_of(ngp)), atol=1e-3)
    params = mi.traverse(small.load({"scene": volume_of(ngp)}))
    dr.enable_grad(params["fields.scene.to_world"].matrix)
    with pytest.raises(InputError, match="set skip_thin to false"):
        params.update()
    ngp.see_all()
    params.update()
