"""The loop's camera in a Mitsuba scene: images, derivatives, refusals, and files."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.reference.derivatives import central_difference
from support.worlds import loops as toy
from support.worlds import loops as walled
from support.worlds.fields import empty_border

import mi_nerfattack as nf
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.render.camera.conventions import opencv_to_mitsuba
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.rollout import (
    KeptBackgrounds,
    Replay,
    Rollout,
    SceneSensor,
    StageSum,
    simulate,
)
from mi_nerfattack.vehicle.dynamics import to_state

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


def scene(
    folder: Path, walls: bool = False, random: bool = False, **entries: Any
) -> mi.Scene:
    """Load fields in fog, between them a wall that a nested prb shows."""
    nested = {"behind": {"type": "prb", "max_depth": 2}} if walls else {}
    described = walled.scene_dict(
        folder, walled.PERSPECTIVE, walls, **nested, **entries
    )
    if random:
        described["sensor"]["sampler"] = {"type": "independent"}
        described["integrator"]["jitter"] = True
        described["sky"] = {"type": "constant"}
    described["integrator"]["id"] = "fields"
    return walled.load(described)


def board() -> mi.Scene:
    """Load a billboard on a floor in daylight, for the path tracer alone."""
    t = mi.ScalarTransform4f()
    colours = np.random.default_rng(3).uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(colours), "raw": True}
    bitmap["accel"] = False  # a GPU's texture unit is less precise
    paint = {"type": "diffuse", "id": "paint", "reflectance": bitmap}
    place = t.translate([6, 0.2, 1.0]).rotate([0, 1, 0], -90)
    return walled.load(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 3},
            "sensor": walled.scene_dict(Path(), walled.PERSPECTIVE, False)["sensor"],
            "board": {
                "type": "rectangle",
                "to_world": place,
                "bsdf": {"type": "twosided", "bsdf": paint},
            },
            "floor": {"type": "rectangle", "to_world": t.scale(40)},
            "light": {"type": "constant"},
        }
    )


def reflectance(loaded: mi.Scene) -> str:
    """Name the colours of the wall, or of the board."""
    keys = list(mi.traverse(loaded).keys())
    ends = "brdf_0.reflectance.value", "brdf_0.reflectance.data"
    return next(key for key in keys if key.endswith(ends))


def drive_of(loaded: mi.Scene, keys: Any, horizon: int, **options: Any) -> Rollout:
    loop = walled.close_loop(SceneSensor(loaded, toy.MOUNT, keys))
    return Rollout(loop, StageSum(toy.square_error), horizon, **options)


def rendered(loaded: mi.Scene, state: np.ndarray) -> np.ndarray:
    """Render the scene's own sensor, put on a vehicle, as linear RGB."""
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
    observation = SceneSensor(loaded, toy.MOUNT).observe(to_state(STATE), 0)
    image = observation.linear.numpy().T.reshape(toy.HEIGHT, toy.WIDTH, 3)
    expected = rendered(loaded, STATE)
    assert expected.std() > 0.01
    assert np.sqrt(((image - expected) ** 2).mean()) < 1e-6


def test_vehicles_are_rendered_together(folder) -> None:
    sensor = SceneSensor(scene(folder), toy.MOUNT)
    both = sensor.observe(to_state(BOTH), 0).image.numpy()
    for image, state in zip(both, BOTH, strict=True):
        alone = sensor.observe(to_state(state[None]), 0).image.numpy()[0]
        np.testing.assert_allclose(image, alone, atol=1e-6)


def test_a_drive_is_the_same_in_any_batch(folder) -> None:
    """Random are places in pixels and along rays, nested paths, and disturbances."""
    loaded = scene(folder, walls=True, random=True)
    loop = replace(
        walled.close_loop(SceneSensor(loaded, toy.MOUNT, seed=5)),
        disturbance=Disturbance(0.3, 0.6, 0.05, seed=2),
    )
    poses = np.array([0.1 * np.cos([k, 2 * k, 3 * k]) for k in range(8)])
    batch = simulate(loop, loop.initial(poses), 12).states_numpy()
    for k, pose in enumerate(poses):
        alone = simulate(loop.numbered(k), loop.initial(pose), 12).states_numpy()
        np.testing.assert_allclose(alone[0], batch[k], atol=1e-5)
    other = simulate(loop.numbered(8), loop.initial(poses[0]), 12).states_numpy()
    assert np.abs(other[0] - batch[0]).max() > 1e-3


def direction(colours: np.ndarray) -> np.ndarray:
    """Return a random direction that is small where a colour is near 0 or 1."""
    rng = np.random.default_rng(1)
    along = rng.uniform(-1, 1, colours.shape) * colours * (1 - colours)
    return along.astype(np.float32)


CASES = ["field", "field before a wall", "wall behind fields", "billboard"]


@pytest.mark.parametrize("case", CASES)
def test_gradient_of_a_drive_at_a_held_camera_path(folder, case) -> None:
    is_board = case == "billboard"
    loaded = board() if is_board else scene(folder, walls="wall" in case)
    key = KEY if case in CASES[:2] else reflectance(loaded)
    drive = drive_of(loaded, [key], 10, adjoint=KeptBackgrounds())
    initial = drive.loop.initial(STATE)
    drive = drive.open_loop(initial)
    params = mi.traverse(loaded)
    base = params[key].numpy().copy()
    along = direction(base)

    opt = mi.ad.Adam(lr=0.05, params={key: params[key]})
    params.update(opt)
    dr.backward(drive(params, initial))
    derivative = float((dr.grad(opt[key]).numpy().astype(float) * along).sum())

    def value(s: float) -> float:
        moved = type(params[key])(base + s * along)
        drive.loop.sensor.set_parameters({key: moved})
        return drive.measure(initial).value

    assert abs(derivative) > 1e-6
    assert derivative == pytest.approx(central_difference(value, 0.02), rel=1e-3)


def test_an_attached_gradient_is_that_of_the_whole_loop(folder) -> None:
    drive = drive_of(scene(folder), [KEY], 5, attached=True)
    initial, sensor = drive.loop.initial(STATE), drive.loop.sensor
    base = sensor.params[KEY].numpy().copy()
    along = direction(base)
    gradient = drive.gradient(drive.run(initial)).parameters[KEY].numpy()

    def value(s: float) -> float:
        sensor.set_parameters({KEY: mi.TensorXf(base + s * along)})
        return drive.measure(initial).value

    expected = central_difference(value, 0.02)
    assert float((gradient * along).sum()) == pytest.approx(expected, rel=0.05)


def test_all_adjoints_agree_and_nothing_stays_attached(folder) -> None:
    keys = [KEY, "fields.near.density", "fields.far.to_world"]
    loaded, gradients = scene(folder), []
    for adjoint in (Replay(), KeptBackgrounds()):
        drive = drive_of(loaded, keys, 4, adjoint=adjoint)
        evaluation, sensor = drive.run(drive.loop.initial(BOTH)), drive.loop.sensor
        gradients.append(drive.gradient(evaluation).parameters)
        assert not any(dr.grad_enabled(sensor.params[key]) for key in keys)
        assert not dr.grad_enabled(sensor.fields[0].packed)
        assert not any(layer.has_pose_gradients for layer in sensor.layers)
    for key in keys[:2]:
        one, other = (parameters[key].numpy() for parameters in gradients)
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max())
    one, other = (np.array(parameters[keys[2]].matrix) for parameters in gradients)
    assert np.abs(one).max() > 0
    np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5 * np.abs(one).max())


def test_a_users_own_leaf_keeps_its_gradient(folder) -> None:
    loaded = scene(folder)
    params, drive = mi.traverse(loaded), drive_of(loaded, (), 2)
    dr.enable_grad(params[KEY])
    params.update()
    dr.backward(drive(params, drive.loop.initial(STATE)))
    assert np.abs(dr.grad(params[KEY]).numpy()).max() > 0


def attached_gradient(loaded: mi.Scene, key: str) -> None:
    drive = drive_of(loaded, [key], 2, attached=True)
    drive.gradient(drive.run(drive.loop.initial(STATE)))


def test_what_has_no_derivative_is_refused(folder) -> None:
    path = {"type": "scene", "i": {"type": "path"}, "s": {"type": "perspective"}}
    fields, plain = scene(folder), board()
    described = walled.scene_dict(folder, walled.PERSPECTIVE)
    described["integrator"]["id"] = "fields"
    unnested = walled.load(described)
    painted = SceneSensor(unnested, toy.MOUNT, [reflectance(unnested)])
    for call, message in (
        (lambda: SceneSensor(fields, toy.MOUNT, ["near.texture"]), "there are: .*near"),
        (lambda: SceneSensor(fields, toy.MOUNT, sensor=1), "sensor: 1; .* 1"),
        (lambda: SceneSensor(walled.load(path), toy.MOUNT), "field_integrator or prb"),
        (painted.start_gradient, 'nest <integrator type="prb"/>'),
        (lambda: attached_gradient(scene(folder, walls=True), KEY), "by the camera"),
        (lambda: attached_gradient(plain, reflectance(plain)), "PRBIntegrator"),
        (lambda: SceneSensor(fields, toy.MOUNT, ["sensor.x_fov"]), "sensor.x_fov"),
        (lambda: SceneSensor(fields, toy.MOUNT, ["sensor.film.size"]), "film.size"),
        (lambda: SceneSensor(plain, toy.MOUNT, ["board.to_world"]), "prb_projective"),
    ):
        with pytest.raises(InputError, match=message):
            call()


def test_detached_values_are_set_too(folder) -> None:
    drive = drive_of(scene(folder), [KEY], 3)
    initial, sensor = drive.loop.initial(STATE), drive.loop.sensor
    bright = {KEY: mi.TensorXf(np.full(sensor.params[KEY].shape, 0.9, np.float32))}
    value = drive(bright, initial)
    assert value[0] == pytest.approx(drive.measure(initial).value, rel=1e-6)
    np.testing.assert_allclose(sensor.params[KEY].numpy(), 0.9, rtol=1e-5)
    assert sensor.keys == (KEY,)


def test_a_texture_of_another_size_is_shown(variant) -> None:
    """A red board, whose scattered light is no more of the other colours."""
    loaded, state = board(), to_state(STATE)
    sensor, red = SceneSensor(loaded, toy.MOUNT), [0.9, 0.0, 0.0]
    before = sensor.observe(state, 0).linear.numpy()
    texture = mi.TensorXf(np.full((4, 2, 3), red, np.float32))
    sensor.set_parameters({reflectance(loaded): texture})
    change = sensor.observe(state, 0).linear.numpy() - before
    assert change[0].max() > 0.1 and change[1:].min() < -0.1


def test_nothing_is_left_of_a_gradient_that_failed_or_of_images(folder) -> None:
    loaded = scene(folder)
    drive = drive_of(loaded, [KEY, "fields.near.to_world"], 3)
    params, sensor = mi.traverse(loaded), drive.loop.sensor
    evaluation = drive.run(drive.loop.initial(STATE))

    def gradient() -> np.ndarray:
        dr.enable_grad(params[KEY])
        params.update()
        dr.backward(dr.sum(mi.render(loaded, params), axis=None))
        derivative = dr.grad(params[KEY]).numpy().copy()
        params[KEY] = dr.detach(params[KEY])
        params.update()
        return derivative

    rendered(loaded, STATE)  # puts the scene's sensor there
    expected = gradient()
    assert np.abs(expected).max() > 0
    drive.by_images(evaluation.trajectory, [1])

    def interrupt(step: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drive.gradient(evaluation, sensor.pose_keys, on_step=interrupt)
    assert not dr.grad_enabled(params["fields.near.to_world"].matrix)
    actual = gradient()
    np.testing.assert_allclose(actual, expected, atol=1e-4 * np.abs(expected).max())


ROOT = Path(nf.__file__).parents[1]
MOST = 34


@pytest.mark.usefixtures("variant")
def test_a_frame_and_its_gradient_enter_few_files():
    scene: mi.Scene = mi.load_file(
        str(nf.bundled("demo.xml")), parallel=False, width=40, height=13
    )
    mount = nf.bundled_place().mount
    sensor = nf.SceneSensor(scene, mount, ["fields.hydrant.colour"])
    state = to_state(np.array([[-8.0, -1.75, 0.0]]))
    ones, entered = dr.ones(mi.TensorXf, (1, 13, 40, 3)), set()

    def note(frame, event, _):
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT) and path.suffix == ".py":
            entered.add(path.relative_to(ROOT))

    sys.setprofile(note)
    try:
        observation = sensor.observe(state, 0)
        sensor.start_gradient()
        sensor.vjp(observation, state, ones, attached=False)
        (gradient,) = sensor.gradients().values()
    finally:
        sys.setprofile(None)
    sensor.stop_gradient()
    assert gradient.numpy().any()
    ours = {path for path in entered if path.parts[0] in ("mi_nerfattack", "plugins")}
    assert 20 < len(ours) <= MOST, sorted(map(str, ours))
