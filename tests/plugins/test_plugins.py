"""The Mitsuba plugins: loading, parameters, values, and what they refuse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small

from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

KINDS = ("grid_field", "ngp_field")


@pytest.fixture
def grid(tmp_path: Path, variant: str, rng: np.random.Generator) -> Path:
    """A file with a coloured blob in [-1, 1]^3."""
    path = tmp_path / "grid.safetensors"
    save_field(path, small.blob(rng))
    return path


@pytest.fixture
def ngp(tmp_path: Path, variant: str) -> Path:
    """A file with an NGP in [-1, 1]^3."""
    path = tmp_path / "ngp.safetensors"
    save_field(path, small.small_ngp())
    return path


@pytest.fixture
def paths(grid: Path, ngp: Path) -> dict[str, Path]:
    """A file of each kind."""
    return dict(zip(KINDS, (grid, ngp), strict=True))


def volume(path: Path, kind: str = "grid_field", more: str = "", **names: str) -> str:
    """Write a volume as XML; the id defaults to `object`."""
    attributes = "".join(f' {k}="{v}"' for k, v in ({"id": "object"} | names).items())
    return (
        f'<volume type="{kind}"{attributes}>'
        f'<string name="filename" value="{path}"/>{more}</volume>'
    )


def load(text: str) -> Any:
    """Load an XML string whose root gets the version."""
    head, tail = text.split(" ", 1)
    return mi.load_string(f'{head} version="3.0.0" {tail}', parallel=False)


def nesting(plugin: str, inside: str) -> str:
    """Write a field_integrator, or a cube with a field_emitter, as XML."""
    if plugin == "field_integrator":
        return f'<integrator type="{plugin}">{inside}</integrator>'
    return f'<shape type="cube"><emitter type="{plugin}">{inside}</emitter></shape>'


def points(rng: np.random.Generator, count: int = 50) -> tuple[np.ndarray, Any]:
    """Make positions in [-1.2, 1.2]^3, as an array and as interactions."""
    place = rng.uniform(-1.2, 1.2, (count, 3)).astype(np.float32)
    it = dr.zeros(mi.Interaction3f, count)
    it.p = mi.Point3f(place.T.copy())
    return place.astype(float), it


# Loading


@pytest.mark.parametrize("kind", KINDS)
def test_volumes_load_from_xml_and_dict(paths, kind: str) -> None:
    from_xml = load(volume(paths[kind], kind))
    from_dict = mi.load_dict({"type": kind, "filename": str(paths[kind])})
    for loaded in (from_xml, from_dict):
        assert isinstance(loaded, mi.Volume)
        assert str(loaded).startswith(f"{kind}[") and "quantity=density" in str(loaded)


def test_emitter_loads_from_xml_and_dict(grid: Path) -> None:
    from_xml = load(nesting("field_emitter", volume(grid)))
    nested = {"type": "grid_field", "filename": str(grid)}
    emitter = {"type": "field_emitter", "object": nested}
    from_dict = mi.load_dict({"type": "cube", "emitter": emitter}, parallel=False)
    for loaded in (from_xml, from_dict):
        assert "FieldEmitter[fields=(object), stop=1e-06]" in str(loaded)


def test_integrator_loads_from_xml_and_dict(paths) -> None:
    both = volume(paths["ngp_field"], "ngp_field", id="scene")
    both += volume(paths["grid_field"])
    from_xml = load(nesting("field_integrator", both))
    nested = [{"type": kind, "filename": str(paths[kind])} for kind in KINDS]
    from_dict = mi.load_dict(
        {"type": "field_integrator", "scene": nested[1], "object": nested[0]}
    )
    for loaded in (from_xml, from_dict):
        assert str(loaded) == (
            "FieldIntegrator[fields=(scene, object), InterleavedComposite, stop=1e-06]"
        )
        assert loaded.aov_names() == []
    aovs = '<boolean name="aovs" value="true"/>'
    layers = [f"{name}.{c}" for name in ("scene", "object") for c in "RGBAZ"]
    loaded = load(nesting("field_integrator", aovs + both))
    assert loaded.aov_names() == ["opacity", "depth", *layers]


def test_relative_names_follow_mitsubas_file_resolver(grid: Path) -> None:
    mi.file_resolver().append(str(grid.parent))
    loaded = mi.load_dict({"type": "grid_field", "filename": grid.name})
    assert isinstance(loaded, mi.Volume)


def test_parameters_show_under_the_id_and_are_differentiable(paths) -> None:
    both = volume(paths["ngp_field"], "ngp_field", id="scene")
    both += volume(paths["grid_field"])
    loaded = load(nesting("field_integrator", both))
    params = mi.traverse(loaded)
    names = ("table", "density_weights", "colour_weights", "sky")
    expected = {"object.colour", "object.density", *[f"scene.{n}" for n in names]}
    expected |= {"object.to_world", "scene.to_world"}
    assert set(params.keys()) == expected
    for name in params.keys():  # noqa: SIM118  not a dict
        assert not params.flags(name) & mi.ParamFlags.NonDifferentiable.value


# Errors


def refuse(text: str, message: str) -> None:
    """Check that an XML string is refused with a message."""
    with pytest.raises(Exception, match=message):
        load(text)


def test_unknown_parameters_are_named(grid: Path) -> None:
    more, message = '<float name="foo" value="1"/>', '(?s)1 unreferenced pro.*"foo"'
    refuse(volume(grid, more=more), message)
    for plugin in ("field_integrator", "field_emitter"):
        refuse(nesting(plugin, volume(grid) + more), message)


UNEVEN = "fields take rotation, translation and uniform scale"


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        ('<scale x="2"/>', UNEVEN),
        ('<scale x="-1"/>', UNEVEN),
        ('<matrix value="1 .5 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>', UNEVEN),
        ('<scale value="0"/>', "is singular"),
    ],
)
def test_volumes_refuse_transforms(grid: Path, transform: str, message: str) -> None:
    more = f'<transform name="to_world">{transform}</transform>'
    refuse(volume(grid, more=more), f"to_world: .*{message}")


def test_volumes_refuse_quantities(grid: Path) -> None:
    more = '<string name="quantity" value="colour"/>'
    refuse(volume(grid, more=more), "quantity: 'colour'; allowed: density, radiance")


def test_volumes_refuse_files(paths, tmp_path: Path) -> None:
    refuse(volume(paths["ngp_field"]), 'holds a ngp_field; use <volume type="ngp_field')
    refuse(
        volume(paths["grid_field"], "ngp_field"),
        'holds a grid_field; use <volume type="grid_field',
    )
    refuse(volume(tmp_path / "none.safetensors"), "none.safetensors: does not exist")
    refuse('<volume type="grid_field"/>', "filename")


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ("", "no nested volume; give one or more of grid_field"),
        ('<float name="stop" value="1"/>', "stop: 1.0; allowed is 0 <= stop < 1"),
        ('<float name="stop" value="-0.1"/>', "stop: -0.1"),
        ('<bsdf type="diffuse"/>', "cannot use the nested BSDF"),
    ],
)
@pytest.mark.parametrize("plugin", ["field_emitter", "field_integrator"])
def test_nesting_plugins_refuse(grid: Path, plugin: str, inside: str, message) -> None:
    refuse(nesting(plugin, inside + (volume(grid) if inside else "")), message)


def test_integrator_takes_one_sampling_integrator(grid: Path) -> None:
    one = '<integrator type="path"/>'
    assert load(nesting("field_integrator", volume(grid) + one)).behind is not None
    two = nesting("field_integrator", volume(grid) + 2 * one)
    refuse(two, "and one sampling integrator such as path")


# Values


def test_eval_equals_float64_interpolation(grid: Path, rng) -> None:
    place, it = points(rng)
    more = '<transform name="to_world"><scale value="1.5"/></transform>'
    loaded = load(volume(grid, more=more))
    density, radiance = small.eval_grid(load_field(grid), place / 1.5)
    np.testing.assert_allclose(loaded.eval_1(it).numpy(), density / 1.5, rtol=1e-4)
    spectrum = loaded.eval(it).numpy()
    np.testing.assert_allclose(spectrum, np.tile(density / 1.5, (3, 1)), rtol=1e-4)
    np.testing.assert_allclose(loaded.eval_3(it).numpy().T, radiance, atol=1e-5)


def test_outside_of_the_box_is_empty(paths, rng) -> None:
    place, it = points(rng)
    outside = (np.abs(place) > 1).any(1)
    assert outside.any() and not outside.all()
    for kind, path in paths.items():
        loaded = load(volume(path, kind))
        assert ((loaded.eval_1(it).numpy() == 0) == outside).all()
        assert (loaded.eval_3(it).numpy()[:, outside] == 0).all()


def test_radiance_as_quantity(grid: Path, rng: np.random.Generator) -> None:
    place, it = points(rng)
    inside = (np.abs(place) < 1).all(1)
    loaded = load(volume(grid, more='<string name="quantity" value="radiance"/>'))
    _, radiance = small.eval_grid(load_field(grid), place)
    np.testing.assert_allclose(
        loaded.eval(it).numpy().T[inside], radiance[inside], atol=1e-5
    )
    luminance = radiance @ [0.212671, 0.715160, 0.072169]
    np.testing.assert_allclose(
        loaded.eval_1(it).numpy()[inside], luminance[inside], atol=1e-4
    )
    assert loaded.max() == 1


def test_box_and_bound_in_the_world(paths, rng: np.random.Generator) -> None:
    more = (
        '<transform name="to_world"><rotate z="1" angle="45"/><scale value="2"/>'
        '<translate x="5"/></transform>'
    )
    _, it = points(rng, 5000)
    it.p = 2 * it.p + mi.Vector3f(5, 0, 0)
    for kind, path in paths.items():
        loaded = load(volume(path, kind, more))
        box, reach = loaded.bbox(), 2 * np.sqrt(2)
        np.testing.assert_allclose(box.min, [5 - reach, -reach, -2], rtol=1e-5)
        np.testing.assert_allclose(box.max, [5 + reach, reach, 2], rtol=1e-5)
        peak = loaded.eval_1(it).numpy().max()
        assert 0 < peak <= loaded.max() < 10 * peak
        assert loaded.max_per_channel() == [loaded.max()] * 3


def test_a_density_given_back_changes_nothing() -> None:
    name = bundled("hydrant/field.safetensors")
    camera = '<lookat origin="-2, 0.3, 0.6" target="0, 0, 0.375" up="0, 0, 1"/>'
    scene = load(
        f"""<scene ><integrator type="field_integrator">
        <boolean name="aovs" value="true"/>{volume(name)}</integrator>
        <sensor type="perspective"><float name="fov" value="35"/>
        <transform name="to_world">{camera}</transform>
        <film type="hdrfilm"><integer name="width" value="32"/>
        <integer name="height" value="48"/></film></sensor></scene>"""
    )
    before = np.array(mi.render(scene, spp=1))
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("density"))
    params[key] = params[key] + 0
    params.update()
    after = np.array(mi.render(scene, spp=1))
    assert before[..., 3].max() > 0.99
    np.testing.assert_allclose(after[..., :4], before[..., :4], atol=1e-4)


@pytest.mark.parametrize("kind", ["grid_field", "ngp_field"])
def test_steps_can_be_set(paths, kind: str) -> None:
    more = '<float name="step_m" value="0.003"/>'
    assert load(volume(paths[kind], kind, more)).field.step_m == pytest.approx(0.003)
    refuse(
        volume(paths[kind], kind, more.replace("0.003", "0")), "step_m: 0.0; must be"
    )
