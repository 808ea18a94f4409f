"""Derivatives of `field_integrator`: each one right, or refused with what works."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.blob_scene import T, load, write_blob
from helpers.derivatives import central_difference

from mi_nerfattack.fields import save_field

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def blob(tmp_path: Path, rng: np.random.Generator) -> dict[str, Any]:
    return write_blob(tmp_path, rng)


class Case:
    """A loss of an image as a function of one number that changes one parameter.

    Args:
        scene: the scene.
        key: of the parameter.
        change: gives the parameter's value for a number and its present value.
        loss: of the image.
    """

    def __init__(
        self,
        scene: mi.Scene,
        key: str,
        change: Callable[[Any, Any], Any],
        loss: Callable[[Any], Any],
        spp: int = 128,
    ) -> None:
        self.scene, self.key, self.change, self.loss = scene, key, change, loss
        self.params, self.spp = mi.traverse(scene), spp
        value = self.params[key]
        self.base = type(value)(value)

    def value(self, number: Any) -> Any:
        self.params[self.key] = self.change(number, self.base)
        self.params.update()
        # one seed for both passes: a difference needs that
        seeds = {"seed": 5, "seed_grad": 7} if dr.grad_enabled(number) else {"seed": 7}
        image = mi.render(self.scene, self.params, spp=self.spp, **seeds)
        return self.loss(image)

    def gradient(self) -> float:
        number = mi.Float(0)
        dr.enable_grad(number)
        dr.backward(self.value(number))
        return float(dr.grad(number)[0])

    def check(self, step: float, rel: float = 1e-2) -> float:
        found = self.gradient()
        expected = central_difference(
            lambda s: float(dr.detach(self.value(mi.Float(s))).array[0]), step
        )
        assert abs(expected) > 1e-4, "the loss does not depend on it"
        assert found == pytest.approx(expected, rel=rel)
        return found


def pattern(image: Any, first: int = 0, channels: int = 3, where: Any = True) -> Any:
    """Weigh pixels by their place, linearly: noise of two passes cancels."""
    height, width, _ = image.shape
    row, column = np.mgrid[:height, :width]
    weight = np.stack([column + (1 + c) * row for c in range(channels)], axis=-1)
    part = dr.select(where, image[..., first : first + channels], 0)
    return dr.mean(part * mi.TensorXf((weight / width).astype(np.float32)), axis=None)


def test_camera_pose(blob) -> None:
    def shift(s, base):
        return mi.AffineTransform4f().translate([0, s, 0.5 * s]) @ base

    Case(load({"a": blob}), "camera.to_world", shift, pattern).check(1e-2)


def test_field_of_view(blob) -> None:
    Case(load({"a": blob}), "camera.x_fov", lambda s, b: b + s, pattern).check(0.5)


MOVES = {
    "shift": lambda s: mi.AffineTransform4f().translate([0.2 * s, s, 0]),
    "turn": lambda s: mi.AffineTransform4f().rotate([0.2, 0.1, 1], 60 * s),
}


@pytest.mark.parametrize("composite", ["interleaved", "depth"])
@pytest.mark.parametrize("name", MOVES)
def test_field_pose(blob, composite, name) -> None:
    other = {**blob, "id": "other", "to_world": T().translate([-0.3, 0.7, 0.1])}
    scene = load({"a": blob, "b": other, "composite": composite})
    key = "fields.other.to_world"
    Case(scene, key, lambda s, base: MOVES[name](s) @ base, pattern).check(1e-2)


def test_field_size(blob) -> None:
    # positions of samples are constants of the derivative: their number must not matter
    scene = load({"a": {**blob, "step_m": 0.01}})

    def grow(s, base):
        return mi.AffineTransform4f().scale(1 + s) @ base

    Case(scene, "fields.blob.to_world", grow, pattern).check(1e-2)


AOVS = {
    "opacity": (3, 1),
    "layer colour": (5, 3),
    "layer opacity": (8, 1),
    "layer depth": (9, 1),
}
# Colours change neither opacity nor depth.
BY_KEY = {"density": [*AOVS], "to_world": [*AOVS], "colour": ["layer colour"]}


@pytest.mark.parametrize(
    ("key", "aov"), [(key, aov) for key, aovs in BY_KEY.items() for aov in aovs]
)
def test_losses_on_aovs(blob, key, aov) -> None:
    first, channels = AOVS[aov]
    other = {**blob, "id": "other", "to_world": T().translate([0.8, 0.5, 0.1])}
    nested = {"a": blob, "b": other, "composite": "depth", "aovs": True}

    def change(s, base):
        if key == "to_world":
            return mi.AffineTransform4f().translate([0, s, 0]) @ base
        return base + s if key == "density" else dr.clip(base + s, 0.01, 0.99)

    scene = load(nested)
    hit = mi.render(scene, spp=128, seed=7)[..., 8:9] > 0.2  # depth: infinite elsewhere

    def loss(image):
        return pattern(image, first, channels, hit)

    Case(scene, f"fields.blob.{key}", change, loss).check(1e-2)


def test_depth_of_the_whole(blob) -> None:
    scene = load({"a": blob, "aovs": True})
    hit = mi.render(scene, spp=128, seed=7)[..., 3:4] > 0.2

    def loss(image):
        return pattern(image, 4, 1, hit)

    Case(scene, "fields.blob.density", lambda s, b: b + s, loss).check(1e-2)


def test_shares_of_the_interleaved_composite_are_refused(blob) -> None:
    other = {**blob, "id": "other", "to_world": T().translate([0.8, 0.5, 0.1])}
    scene = load({"a": blob, "b": other, "aovs": True})
    case = Case(
        scene,
        "fields.blob.density",
        lambda s, b: b + s,
        lambda i: dr.mean(i[..., 5:6], axis=None),
    )
    with pytest.raises(Exception, match="set composite to depth"):
        case.gradient()
    case.loss = pattern
    case.check(1e-2)


def room() -> dict[str, Any]:
    return {
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -1.2]).scale(4),
            "bsdf": {
                "type": "diffuse",
                "id": "paint",
                "reflectance": {"type": "rgb", "value": [0.4, 0.6, 0.3]},
            },
        },
        "light": {"type": "constant", "radiance": {"type": "rgb", "value": 0.8}},
    }


BEHIND = {
    "paint": "floor.bsdf.reflectance.value",
    "light": "light.radiance.value",
}


@pytest.mark.parametrize("name", BEHIND)
def test_what_a_nested_prb_shows(blob, name) -> None:
    scene = load({"a": blob, "behind": {"type": "prb", "max_depth": 3}}, room())
    Case(scene, BEHIND[name], lambda s, b: b + s, pattern).check(0.02)


@pytest.mark.parametrize("name", BEHIND)
def test_what_a_nested_path_shows_is_refused(blob, name) -> None:
    scene = load({"a": blob, "behind": {"type": "path", "max_depth": 3}}, room())
    with pytest.raises(Exception, match='nest <integrator type="prb"/>'):
        Case(scene, BEHIND[name], lambda s, b: b + s, pattern).gradient()


def behind_glass(integrator: str, blob: dict[str, Any]) -> mi.Scene:
    """Load a blob seen directly and through a glass ball, which an emitter shows it."""
    glass = {
        "type": "sphere",
        "center": [-1.9, 0.1, 0.3],
        "radius": 0.35,
        "bsdf": {"type": "dielectric"},
    }
    lamp = {
        "type": "cube",
        "to_world": T().scale(8),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}},
        "emitter": {
            "type": "field_emitter",
            "stop": 0.0,
            "a": {"type": "ref", "id": "blob"},
        },
    }
    nested = {
        "a": {"type": "ref", "id": "blob"},
        "behind": {"type": integrator, "max_depth": 6},
    }
    return load(nested, {"blob": blob, "glass": glass, "lamp": lamp})


def test_a_field_behind_glass_that_an_emitter_shares(blob) -> None:
    def change(s, base):
        return base + s

    scene = behind_glass("prb", blob)
    key = next(k for k in mi.traverse(scene).keys() if k.endswith("blob.density"))  # noqa: SIM118
    Case(scene, key, change, pattern).check(0.02)
    with pytest.raises(Exception, match='nest <integrator type="prb"/>'):
        Case(behind_glass("path", blob), key, change, pattern).gradient()


def test_the_pose_of_a_field_behind_glass(blob) -> None:
    def change(s, base):
        return mi.AffineTransform4f().translate([0, s, 0.3 * s]) @ base

    scene = behind_glass("prb", blob)
    key = next(k for k in mi.traverse(scene).keys() if k.endswith("blob.to_world"))  # noqa: SIM118
    Case(scene, key, change, pattern).check(0.01)


@pytest.mark.parametrize("key", ["camera.to_world", "fields.open.to_world"])
def test_a_field_that_ends_at_its_box_at_once_is_refused(tmp_path, key) -> None:
    save_field(tmp_path / "open.safetensors", small.homogeneous(0.7))
    name = str(tmp_path / "open.safetensors")
    scene = load({"a": {"type": "grid_field", "id": "open", "filename": name}})

    def shift(s, base):
        return mi.AffineTransform4f().translate([0, s, 0]) @ base

    with pytest.raises(Exception, match="leave cells at its border empty"):
        Case(scene, key, shift, pattern).gradient()


def test_camera_among_surfaces_is_refused(blob) -> None:
    def shift(s, base):
        return mi.AffineTransform4f().translate([0, s, 0]) @ base

    scene = load({"a": blob}, room())
    with pytest.raises(Exception, match="no derivative by the camera"):
        Case(scene, "camera.to_world", shift, pattern).gradient()


def test_a_surface_that_moves_is_refused(blob) -> None:
    def shift(s, base):
        return mi.AffineTransform4f().translate([0, s, 0]) @ base

    scene = load({"a": blob, "behind": {"type": "prb"}}, room())
    with pytest.raises(Exception, match="at which fields end"):
        Case(scene, "floor.to_world", shift, pattern).gradient()


@pytest.mark.parametrize("habit", ["forward", "forward_to", "before rendering"])
@pytest.mark.parametrize("name", ["colour", "density"])
def test_forward_mode_in_every_habit(blob, habit, name) -> None:
    def change(s, base):
        return dr.clip(base + s, 0.01, 0.99) if name == "colour" else base + s

    scene, key = load({"a": blob}), f"fields.blob.{name}"
    expected = Case(scene, key, change, pattern).gradient()
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
    found = float(dr.grad(loss).array[0])
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("key", ["fields.blob.to_world", "camera.to_world"])
def test_forward_mode_by_the_pose_is_refused(blob, key) -> None:
    scene = load({"a": blob})
    params = mi.traverse(scene)
    number = mi.Float(0)
    dr.enable_grad(number)
    params[key] = mi.AffineTransform4f().translate([0, number, 0]) @ params[key]
    params.update()
    loss = pattern(mi.render(scene, params, spp=4))
    with pytest.raises(Exception, match="use dr.backward"):
        dr.forward(number)
    del loss
