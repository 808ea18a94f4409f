"""The loop's camera in a Mitsuba scene: images, derivatives and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers import walled_scene as walled
from helpers.derivatives import central_difference
from helpers.small_fields import empty_border

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout import (
    ClosedLoop,
    KeptBackgrounds,
    Replay,
    Rollout,
    SceneSensor,
    StageSum,
)
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import ExplicitEuler

STATE = np.array([[0.3, 0.2, -0.04]])
BOTH = np.array([[0.3, 0.2, -0.04], [-0.2, -0.1, 0.08]])
KEY = "fields.near.colour"


@pytest.fixture
def folder(tmp_path: Path, variant: str) -> Path:
    """Fields whose border is empty, as that of fitted ones."""
    walled.write_fields(tmp_path)
    for name in ("near", "far", "fog"):
        path = tmp_path / f"{name}.safetensors"
        field = load_field(path)
        empty_border(field)
        save_field(path, field)
    return tmp_path


def scene(folder: Path, walls: bool = False, **more: Any) -> mi.Scene:
    """Load fields in fog, between them a wall that a nested prb shows."""
    nested = {"behind": {"type": "prb", "max_depth": 2}} if walls else {}
    described = walled.scene_dict(folder, walled.PERSPECTIVE, walls, **nested, **more)
    described["integrator"]["id"] = "fields"
    return walled.load(described)


def board() -> mi.Scene:
    """Load a billboard on a floor in daylight, for the path tracer alone."""
    t = mi.ScalarTransform4f()
    colours = np.random.default_rng(3).uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32)
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(colours),
        "raw": True,
        "filter_type": "bilinear",
        "accel": False,  # a GPU's texture unit is less precise
    }
    place = t.translate([6, 0.2, 1.0]).rotate([0, 1, 0], -90).scale([1, 1, 1])
    described = walled.scene_dict(Path(), walled.PERSPECTIVE, walls=False)
    return walled.load(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 3},
            "sensor": described["sensor"],
            "board": {
                "type": "rectangle",
                "to_world": place,
                "bsdf": {
                    "type": "twosided",
                    "bsdf": {"type": "diffuse", "id": "paint", "reflectance": bitmap},
                },
            },
            "floor": {"type": "rectangle", "to_world": t.scale(40)},
            "light": {"type": "constant"},
        }
    )


def bitmap_key(loaded: mi.Scene) -> str:
    return next(k for k in mi.traverse(loaded).keys() if k.endswith("reflectance.data"))  # noqa: SIM118


def close(sensor: Any) -> ClosedLoop:
    """Let the toy policy drive on what a sensor sees."""
    car, policy = Dubins(toy.SPEED, toy.LIMIT), TorchPolicy(toy.SmoothPolicy())
    parts = sensor, policy, 0, car, ExplicitEuler(), toy.DT
    return ClosedLoop(*parts, eight_bit=False)


def rendered(loaded: mi.Scene, state: np.ndarray) -> np.ndarray:
    """Render the scene's own sensor, put on a vehicle, as linear RGB."""
    from mi_nerfattack.render.camera.conventions import opencv_to_mitsuba
    from mi_nerfattack.render.camera.intrinsics import mount_matrix

    params = mi.traverse(loaded)
    matrix = opencv_to_mitsuba(mount_matrix(state, toy.MOUNT)[0])
    params["sensor.to_world"] = mi.AffineTransform4f(np.asarray(matrix))
    params.update()
    return mi.render(loaded).numpy()


@pytest.mark.parametrize("kind", ["fields", "fields and a wall", "prb"])
def test_image_is_that_of_mi_render(folder, kind) -> None:
    loaded = board() if kind == "prb" else scene(folder, kind.endswith("wall"))
    if kind == "prb":  # one light, no other random number
        loaded.integrator().max_depth = 1
    seen = SceneSensor(loaded, toy.MOUNT).observe(close(None).initial(STATE), 0)
    found = seen.linear.numpy().T.reshape(toy.HEIGHT, toy.WIDTH, 3)
    expected = rendered(loaded, STATE)
    assert expected.std() > 0.01
    assert np.sqrt(((found - expected) ** 2).mean()) < 1e-6


def test_vehicles_are_rendered_together(folder) -> None:
    sensor = SceneSensor(scene(folder), toy.MOUNT)
    loop = close(sensor)
    both = sensor.observe(loop.initial(BOTH), 0).image.numpy()
    alone = [sensor.observe(loop.initial(BOTH[k : k + 1]), 0) for k in (0, 1)]
    for image, one in zip(both, alone, strict=True):
        np.testing.assert_allclose(image, one.image.numpy()[0], atol=1e-6)


def direction(colours: np.ndarray) -> np.ndarray:
    """Return a random direction that is small where a colour is near 0 or 1."""
    rng = np.random.default_rng(1)
    along = rng.uniform(-1, 1, colours.shape) * colours * (1 - colours)
    return along.astype(np.float32)


CASES = ["field", "field before a wall", "wall behind fields", "billboard"]


@pytest.mark.parametrize("case", CASES)
def test_gradient_of_a_drive_at_a_held_camera_path(folder, case) -> None:
    if case == "billboard":
        loaded = board()
        key = bitmap_key(loaded)
    else:
        loaded = scene(folder, walls="wall" in case)
        key = KEY
        if case == "wall behind fields":
            key = next(
                k
                for k in mi.traverse(loaded).keys()  # noqa: SIM118
                if k.endswith("reflectance.value")
            )
    sensor = SceneSensor(loaded, toy.MOUNT, [key])
    loop = close(sensor)
    initial = loop.initial(STATE)
    drive = Rollout(loop, StageSum(toy.square_error), 10, adjoint=KeptBackgrounds())
    drive = drive.open_loop(initial)
    params = mi.traverse(loaded)
    base = params[key].numpy().copy()
    along = direction(base)

    opt = mi.ad.Adam(lr=0.05, params={key: params[key]})
    params.update(opt)
    dr.backward(drive(params, initial))
    gradient = dr.grad(opt[key]).numpy()
    found = float((gradient.astype(float) * along).sum())

    def value(s: float) -> float:
        kind = type(params[key])
        sensor.set_parameters({key: kind(base + s * along)})
        return drive.measure(initial).value

    assert abs(found) > 1e-6
    assert found == pytest.approx(central_difference(value, 0.02), rel=1e-3)


def test_an_attached_gradient_is_that_of_the_whole_loop(folder) -> None:
    sensor = SceneSensor(scene(folder), toy.MOUNT, [KEY])
    loop = close(sensor)
    initial = loop.initial(STATE)
    drive = Rollout(loop, StageSum(toy.square_error), 5, attached=True)
    params = sensor.params
    base = params[KEY].numpy().copy()
    along = direction(base)
    found = drive.gradient(drive.run(initial)).parameters[KEY].numpy()

    def value(s: float) -> float:
        sensor.set_parameters({KEY: mi.TensorXf(base + s * along)})
        return drive.measure(initial).value

    expected = central_difference(value, 0.02)
    assert float((found * along).sum()) == pytest.approx(expected, rel=0.05)


def test_all_adjoints_agree_and_nothing_stays_attached(folder) -> None:
    keys = [KEY, "fields.near.density", "fields.far.to_world"]
    sensor = SceneSensor(scene(folder), toy.MOUNT, keys)
    loop = close(sensor)
    found = []
    for adjoint in (Replay(), KeptBackgrounds()):
        drive = Rollout(loop, StageSum(toy.square_error), 4, adjoint=adjoint)
        gradient = drive.gradient(drive.run(loop.initial(BOTH)))
        found.append(gradient.parameters)
        assert not any(dr.grad_enabled(sensor.params[key]) for key in keys)
        assert not dr.grad_enabled(sensor.fields[0].packed)
    for key in keys[:2]:
        one, other = (parameters[key].numpy() for parameters in found)
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max())
    one, other = (np.array(parameters[keys[2]].matrix) for parameters in found)
    assert np.abs(one).max() > 0
    np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5 * np.abs(one).max())


def test_a_users_own_leaf_keeps_its_gradient(folder) -> None:
    loaded = scene(folder)
    params = mi.traverse(loaded)
    sensor = SceneSensor(loaded, toy.MOUNT)
    loop = close(sensor)
    drive = Rollout(loop, StageSum(toy.square_error), 2)
    dr.enable_grad(params[KEY])
    params.update()
    dr.backward(drive(params, loop.initial(STATE)))
    assert np.abs(dr.grad(params[KEY]).numpy()).max() > 0


def test_what_has_no_derivative_is_refused(folder) -> None:
    with pytest.raises(
        InputError, match=r"no parameter of the scene; there are: .*near"
    ):
        SceneSensor(scene(folder), toy.MOUNT, ["near.texture"])
    with pytest.raises(InputError, match="sensor: 1; the scene has 1"):
        SceneSensor(scene(folder), toy.MOUNT, sensor=1)
    path = {
        "type": "scene",
        "integrator": {"type": "path"},
        "s": {"type": "perspective"},
    }
    with pytest.raises(InputError, match="use field_integrator or prb"):
        SceneSensor(walled.load(path), toy.MOUNT)
    described = walled.scene_dict(folder, walled.PERSPECTIVE)
    described["integrator"]["id"] = "fields"
    loaded = walled.load(described)
    painted = next(
        k
        for k in mi.traverse(loaded).keys()  # noqa: SIM118
        if k.endswith("reflectance.value")
    )
    sensor = SceneSensor(loaded, toy.MOUNT, [painted])
    with pytest.raises(InputError, match='nest <integrator type="prb"/>'):
        sensor.start_gradient()
    sensor = SceneSensor(scene(folder, walls=True), toy.MOUNT, [KEY])
    drive = Rollout(close(sensor), StageSum(toy.square_error), 2, attached=True)
    with pytest.raises(InputError, match="no derivative by the camera"):
        drive.gradient(drive.run(drive.loop.initial(STATE)))
    loaded = board()
    sensor = SceneSensor(loaded, toy.MOUNT, [bitmap_key(loaded)])
    drive = Rollout(close(sensor), StageSum(toy.square_error), 2, attached=True)
    with pytest.raises(
        InputError, match="PRBIntegrator has no derivative by the camera"
    ):
        drive.gradient(drive.run(drive.loop.initial(STATE)))


def test_constants_of_the_derivative_are_refused(folder) -> None:
    for key in ("sensor.x_fov", "sensor.film.size"):
        with pytest.raises(InputError, match="a constant of the derivative"):
            SceneSensor(scene(folder), toy.MOUNT, [key])
    with pytest.raises(InputError, match="prb_projective by shapes"):
        SceneSensor(board(), toy.MOUNT, ["board.to_world"])


def test_detached_values_are_set_too(folder) -> None:
    sensor = SceneSensor(scene(folder), toy.MOUNT, [KEY])
    loop = close(sensor)
    drive = Rollout(loop, StageSum(toy.square_error), 3)
    bright = {KEY: mi.TensorXf(np.full(sensor.params[KEY].shape, 0.9, np.float32))}
    initial = loop.initial(STATE)
    value = drive(bright, initial)
    assert value[0] == pytest.approx(drive.measure(initial).value, rel=1e-6)
    np.testing.assert_allclose(sensor.params[KEY].numpy(), 0.9, rtol=1e-5)
    assert sensor.keys == (KEY,)


def test_nothing_is_left_of_a_gradient_that_failed_or_of_images(folder) -> None:
    loaded = scene(folder)
    sensor = SceneSensor(loaded, toy.MOUNT, [KEY, "fields.near.to_world"])
    params, loop = mi.traverse(loaded), close(sensor)
    drive = Rollout(loop, StageSum(toy.square_error), 3)
    evaluation = drive.run(loop.initial(STATE))

    def gradient() -> np.ndarray:
        dr.enable_grad(params[KEY])
        params.update()
        dr.backward(dr.sum(mi.render(loaded, params), axis=None))
        found = dr.grad(params[KEY]).numpy().copy()
        params[KEY] = dr.detach(params[KEY])
        params.update()
        return found

    rendered(loaded, STATE)  # puts the scene's sensor there
    expected = gradient()
    assert np.abs(expected).max() > 0
    drive.by_images(evaluation.trajectory, [1])

    def interrupt(step: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drive.gradient(evaluation, sensor.pose_keys, on_step=interrupt)
    assert not dr.grad_enabled(params["fields.near.to_world"].matrix)
    found = gradient()
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
