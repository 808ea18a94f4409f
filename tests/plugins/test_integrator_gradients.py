"""Derivatives of `field_integrator`: each one right, or refused with what works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import central_difference, key_of
from support.worlds import fields as small
from support.worlds import loops as toy
from support.worlds.fields import T, load, write_blob

from mi_nerfattack.fields import GridLayout, save_field

pytestmark = pytest.mark.usefixtures("variant")

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "glass.xml"


@pytest.fixture
def blob(tmp_path: Path, rng: np.random.Generator) -> dict[str, Any]:
    return write_blob(tmp_path, rng)


def beside(blob: dict[str, Any], place=(0.8, 0.5, 0.1)) -> dict[str, Any]:
    """Describe two blobs."""
    return {"a": blob, "b": {**blob, "id": "other", "to_world": T().translate(place)}}


def paint(s: Any, base: Any) -> Any:
    """Change colours by one number, each at its own rate."""
    along = np.random.default_rng(2).uniform(0, 1, base.shape).astype(np.float32)
    values = dr.detach(base).numpy()
    return base + s * mi.TensorXf(along * values * (1 - values))


def move(s: Any, base: Any) -> Any:
    """Move a pose by one number."""
    return mi.AffineTransform4f().translate([0.2 * s, s, 0.3 * s]) @ base


CHANGES = {
    "add": lambda s, base: base + s,
    "move": move,
    "turn": lambda s, base: mi.AffineTransform4f().rotate([0.2, 0.1, 1], 60 * s) @ base,
    "grow": lambda s, base: mi.AffineTransform4f().scale(1 + s) @ base,
    "paint": paint,
}


class Case:
    """A loss of an image as a function of one number that changes one parameter."""

    def __init__(self, scene: mi.Scene, key: str, change: str, loss: Any = None):
        self.scene, self.change, self.loss = scene, CHANGES[change], loss or pattern
        self.params = mi.traverse(scene)
        self.key = key_of(self.params, key)
        value = self.params[self.key]
        self.base = type(value)(value)

    def value(self, number: Any) -> Any:
        self.params[self.key] = self.change(number, self.base)
        self.params.update()
        # one seed for both passes: a difference needs that
        seeds = {"seed": 5, "seed_grad": 7} if dr.grad_enabled(number) else {"seed": 7}
        return self.loss(mi.render(self.scene, self.params, spp=128, **seeds))

    def gradient(self) -> float:
        number = mi.Float(0)
        dr.enable_grad(number)
        dr.backward(self.value(number))
        return float(dr.grad(number)[0])

    def check(self, step: float = 1e-2, rel: float = 1e-2) -> None:
        derivative = self.gradient()
        expected = central_difference(
            lambda s: float(dr.detach(self.value(mi.Float(s))).array[0]), step
        )
        assert abs(expected) > 1e-4, "the loss does not depend on it"
        assert derivative == pytest.approx(expected, rel=rel)


def pattern(image: Any, first: int = 0, channels: int = 3, where: Any = True) -> Any:
    """Weigh pixels by their place, linearly: noise of two passes cancels."""
    height, width, _ = image.shape
    row, column = np.mgrid[:height, :width]
    weight = np.stack([column + (1 + c) * row for c in range(channels)], axis=-1)
    part = dr.select(where, image[..., first : first + channels], 0)
    return dr.mean(part * mi.TensorXf((weight / width).astype(np.float32)), axis=None)


# Poses, channels, surfaces


@pytest.mark.parametrize(
    ("key", "change", "composite"),
    [
        ("camera.to_world", "move", "interleaved"),
        ("camera.x_fov", "add", "interleaved"),
        ("fields.other.to_world", "move", "interleaved"),
        ("fields.other.to_world", "turn", "depth"),
        ("fields.blob.to_world", "grow", "interleaved"),
    ],
)
def test_poses(blob, key, change, composite) -> None:
    nested = {"a": blob}
    if "other" in key:
        nested = beside(blob, (-0.3, 0.7, 0.1))
    if (
        change == "grow"
    ):  # places of samples are constants: their number must not matter
        nested = {"a": {**blob, "step_m": 0.01}}
    scene = load({**nested, "composite": composite})
    Case(scene, key, change).check(0.5 if change == "add" else 1e-2)


@pytest.mark.parametrize("kind", ["field_integrator", "prb"])
def test_a_sky_turns_with_the_pose_of_its_field(tmp_path, kind) -> None:
    ngp = small.small_ngp()
    small.empty_border(ngp, 8)
    save_field(tmp_path / "ngp.safetensors", ngp)
    filename = str(tmp_path / "ngp.safetensors")
    described = {"type": "ngp_field", "id": "ngp", "filename": filename}
    if kind == "field_integrator":
        scene = load({"a": described})
    else:
        lamp = {"type": "field_emitter", "stop": 0.0, "a": described}
        black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}}
        cube = {"type": "cube", "to_world": T().scale(8), "bsdf": black, "lamp": lamp}
        scene = load({"type": kind, "max_depth": 2}, {"cube": cube})
    Case(scene, "ngp.to_world", "turn").check()


AOVS = {
    "opacity": (3, 1),
    "depth": (4, 1),
    "layer colour": (5, 3),
    "layer opacity": (8, 1),
    "layer depth": (9, 1),
}
# Colours change neither opacity nor depth.
BY_KEY = {
    "density": ("add", [*AOVS]),
    "to_world": ("move", ["opacity", "layer colour", "layer depth"]),
    "colour": ("paint", ["layer colour"]),
}


@pytest.mark.parametrize(
    ("key", "aov"), [(key, aov) for key, (_, aovs) in BY_KEY.items() for aov in aovs]
)
def test_losses_on_aovs(blob, key, aov) -> None:
    scene = load({**beside(blob), "composite": "depth", "aovs": True})
    hit = mi.render(scene, spp=128, seed=7)[..., 8:9] > 0.2  # depth: infinite elsewhere

    def loss(image):
        return pattern(image, *AOVS[aov], hit)

    Case(scene, f"fields.blob.{key}", BY_KEY[key][0], loss).check()


def room() -> dict[str, Any]:
    reflectance = {"type": "rgb", "value": [0.4, 0.6, 0.3]}
    floor = {
        "type": "rectangle",
        "to_world": T().translate([0, 0, -1.2]).scale(4),
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
    }
    radiance = {"type": "rgb", "value": 0.8}
    return {"floor": floor, "light": {"type": "constant", "radiance": radiance}}


def behind_glass(integrator: str, blob: dict[str, Any]) -> mi.Scene:
    """Load a blob seen directly and through a glass ball, which an emitter shows it."""
    shared = {"type": "ref", "id": "blob"}
    lamp = {
        "type": "cube",
        "to_world": T().scale(8),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}},
        "emitter": {"type": "field_emitter", "stop": 0.0, "a": shared},
    }
    glass = {"type": "sphere", "center": [-1.9, 0.1, 0.3], "radius": 0.35}
    glass["bsdf"] = {"type": "dielectric"}
    nested = {"a": shared, "behind": {"type": integrator, "max_depth": 6}}
    return load(nested, {"blob": blob, "glass": glass, "lamp": lamp})


@pytest.mark.parametrize(
    ("key", "change", "step"),
    [
        ("floor.bsdf.reflectance.value", "add", 0.02),
        ("light.radiance.value", "add", 0.02),
        ("blob.density", "add", 0.02),
        ("blob.to_world", "move", 0.01),
    ],
)
def test_what_a_nested_prb_shows_and_a_nested_path_refuses(
    blob, key, change, step
) -> None:
    def scene(integrator: str) -> mi.Scene:
        if key.startswith("blob"):
            return behind_glass(integrator, blob)
        return load({"a": blob, "behind": {"type": integrator, "max_depth": 3}}, room())

    Case(scene("prb"), key, change).check(step)
    with pytest.raises(Exception, match='nest <integrator type="prb"/>'):
        Case(scene("path"), key, change).gradient()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "change", "step"),
    [
        ("hydrant.colour", "paint", 0.1),
        ("board.bsdf.brdf_0.reflectance.data", "paint", 0.1),
        ("hydrant.to_world", "move", 2e-2),
    ],
)
def test_glass_metal_and_a_billboard_of_the_example(
    tmp_path, key, change, step
) -> None:
    """With a soft object: differences need edges wider than a step."""
    field = toy.blob(GridLayout(3, 6, 12), 0.4, 3.5, 0.02, 2)
    field.lower, field.upper = (x + [0, 0, 0.4] for x in (field.lower, field.upper))
    small.empty_border(field)
    red = np.tile(np.float32([0.8, -0.8, -0.8]), (field.n_vertices, 1))
    field.set_parameter("texture", red)
    path = tmp_path / "soft.safetensors"
    save_field(path, field)
    size = {"width": 24, "height": 12, "parallel": False}
    scene = mi.load_file(str(EXAMPLE), object=str(path), **size)
    Case(scene, key, change).check(step, rel=2e-2)


# What has no derivative


def opened(path: Path) -> dict[str, Any]:
    """Describe a field that ends at its box at once."""
    save_field(path / "open.safetensors", small.homogeneous(0.7))
    filename = str(path / "open.safetensors")
    return {"a": {"type": "grid_field", "id": "open", "filename": filename}}


@pytest.mark.parametrize(
    ("nested", "key", "remedy"),
    [
        ("open", "camera.to_world", "leave cells at its border empty"),
        ("open", "fields.open.to_world", "leave cells at its border empty"),
        ("room", "camera.to_world", "no derivative by the camera"),
        ("prb", "floor.to_world", "at which fields end"),
        ("interleaved", "fields.blob.density", "set composite to depth"),
    ],
)
def test_what_has_no_derivative_is_refused(blob, tmp_path, nested, key, remedy) -> None:
    seeing: dict[str, Any] = {"a": blob}
    if nested == "open":
        seeing = opened(tmp_path)
    if nested == "prb":
        seeing["behind"] = {"type": "prb"}
    if nested == "interleaved":
        seeing = {**beside(blob), "aovs": True}
    scene = load(seeing, room() if nested in ("room", "prb") else {})
    case = Case(scene, key, "add" if key.endswith("density") else "move")
    if nested == "interleaved":  # in the image itself it has one
        case.check()
        case.loss = lambda image: pattern(image, 5)
    with pytest.raises(Exception, match=remedy):
        case.gradient()


@pytest.mark.parametrize("habit", ["forward", "forward_to", "before rendering"])
@pytest.mark.parametrize("name", ["colour", "density"])
def test_forward_mode_in_every_habit(blob, habit, name) -> None:
    scene, key = load({"a": blob}), f"fields.blob.{name}"
    expected = Case(scene, key, "add").gradient()
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    if habit == "before rendering":
        dr.set_grad(params[key], 1)
        dr.forward_from(params[key], dr.ADFlag.ClearEdges)
    loss = pattern(mi.render(scene, params, spp=128, seed=5, seed_grad=7))
    if habit == "forward":
        dr.forward(params[key])
    else:
        dr.set_grad(params[key], 1)
        dr.forward_to(loss)
    derivative = float(dr.grad(loss).array[0])
    assert derivative == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "key", ["light.radiance.value", "floor.bsdf.reflectance.value"]
)
@pytest.mark.parametrize("is_leaf", [True, False])
def test_forward_mode_by_what_a_nested_prb_shows(blob, key, is_leaf) -> None:
    nested = {"a": blob, "behind": {"type": "prb", "max_depth": 3}}
    expected = Case(load(nested, room()), key, "add").gradient()
    scene = load(nested, room())
    params, number = mi.traverse(scene), mi.Float(0)
    source = params[key] if is_leaf else number
    dr.enable_grad(source)
    if not is_leaf:
        params[key] = params[key] + number
    params.update()
    loss = pattern(mi.render(scene, params, spp=128, seed=5, seed_grad=7))
    dr.forward(source)
    assert float(dr.grad(loss).array[0]) == pytest.approx(expected, rel=1e-3)


def test_forward_mode_by_a_field_that_an_emitter_shares(blob) -> None:
    expected = Case(behind_glass("prb", blob), "blob.density", "add").gradient()
    scene = behind_glass("prb", blob)
    params = mi.traverse(scene)
    key = key_of(params, "blob.density")
    dr.enable_grad(params[key])
    params.update()
    loss = pattern(mi.render(scene, params, spp=128, seed=5, seed_grad=7))
    dr.forward(params[key])
    assert float(dr.grad(loss).array[0]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("key", ["fields.blob.to_world", "camera.to_world"])
def test_forward_mode_by_the_pose_is_refused(blob, key) -> None:
    scene = load({"a": blob})
    params = mi.traverse(scene)
    number = mi.Float(0)
    dr.enable_grad(number)
    params[key] = move(number, params[key])
    params.update()
    loss = pattern(mi.render(scene, params, spp=4))
    with pytest.raises(Exception, match="use dr.backward"):
        dr.forward(number)
    del loss


def test_forward_mode_by_the_pose_of_what_an_emitter_shows_is_refused(blob) -> None:
    lamp = {"type": "field_emitter", "a": blob}
    cube = {"type": "cube", "to_world": T().scale(8), "emitter": lamp}
    scene = load({"type": "path"}, {"lamp": cube})
    params, number = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(number)
    key = key_of(params, "blob.to_world")
    params[key] = move(number, params[key])
    params.update()
    dr.forward(number, dr.ADFlag.ClearEdges)
    loss = pattern(mi.render(scene, params, spp=4))
    with pytest.raises(Exception, match="use dr.backward"):
        dr.forward_to(loss)
