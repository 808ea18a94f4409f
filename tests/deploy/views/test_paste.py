"""Pasting by depth against the geometry of a box of known density and colour."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from support.faults.refusals import refusals
from support.reference.derivatives import nothing_compiled
from support.worlds.fields import homogeneous, sigmoid_to_linear

from mi_nerfattack.deploy import CameraFrame
from mi_nerfattack.deploy.views.paste import Paster
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = from_fov(16, 12, 60.0)
GREY = 90


def box_interval(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays (12, 16) enter and leave the box [-1, 1]^3, metres."""
    x = (np.arange(16) + 0.5 - CAMERA.cx) / CAMERA.fx
    y = (np.arange(12) + 0.5 - CAMERA.cy) / CAMERA.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((12, 16))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    towards = rays @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        a, b = ((side - pose[:3, 3]) / towards for side in (-1.0, 1.0))
    return np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)


AHEAD = look_at((-8.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def pasted(depth: float, *objects: PosedField, pose=AHEAD) -> CameraFrame:
    return Paster(CAMERA, objects).paste(frame_at(pose, depth))


def posed(density, raw=0.0, x=0.0, scale=1.0) -> PosedField:
    return PosedField(homogeneous(density, raw), Pose.upright((x, 0, 0), 0.0, scale))


def frame_at(pose: np.ndarray, depth: float) -> CameraFrame:
    image = np.full((12, 16, 3), GREY, np.uint8)
    return CameraFrame(image, np.full((12, 16), depth, np.float32), pose)


def rolled(pose: np.ndarray, angle: float) -> np.ndarray:
    turn = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    turn[:2, :2] = [[c, -s], [s, c]]
    return pose @ turn


@pytest.mark.parametrize("wall", [np.inf, 9.0])
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_near_box_covers_what_lies_behind(wall, angle):
    density, raw = 30.0, 0.4
    pose = rolled(look_at((-4.0, 0.7, 0.3), (0.0, 0.2, 0.0)), angle)
    frame = pasted(wall, posed(density, raw), pose=pose)
    near, far = box_interval(pose)
    inside, outside = far - near > 0.2, far - near < 0
    assert inside.sum() > 20 and outside.sum() > 20
    linear = sigmoid_to_linear(np.array(raw))
    level = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    assert abs(frame.image[inside].astype(float) - level).max() <= 1.0
    assert (frame.image[outside] == GREY).all()
    assert (frame.depth[outside] == np.float32(wall)).all()
    length, passed = far - near, np.exp(-density * (far - near))
    expected = near + 1 / density - length * passed / (1 - passed)
    assert abs(frame.depth - expected)[inside].max() < 2e-3
    assert frame.depth.dtype == np.float32 and frame.image.dtype == np.uint8


@pytest.mark.parametrize(("length", "is_pasted"), [(0.6, False), (0.8, True)])
def test_half_opacity_decides_and_walls_hide(length, is_pasted):
    # 1 - exp(-x) passes one half at x = 0.69; along the axis the box is 2 m thick
    pose = look_at((-4.0, 1e-3, 1e-3), (0.0, 1e-3, 1e-3))
    frame = pasted(np.inf, posed(length / 2), pose=pose)
    assert np.isfinite(frame.depth[5:7, 7:9]).all() == is_pasted
    behind = look_at((4.0, 0.0, 0.0), (8.0, 0.0, 0.0))
    for at in (pose, behind):
        hidden = pasted(2.0, posed(30.0), pose=at)
        assert (hidden.image == GREY).all() and (hidden.depth == 2.0).all()


@pytest.mark.parametrize("order", [1, -1])
def test_walls_among_objects(order):
    """Near: thin, so that half of a ray passes it. Far: behind the wall at 7 m."""
    near, far = posed(0.25, 3.0, -4.0, 0.5), posed(60, -3.0, 2.0, 2.0)
    for items in ([near], [far], [near, far][::order]):
        frame = pasted(7.0, *items)
        assert (frame.image == GREY).all() and (frame.depth == 7.0).all()
    dark = posed(60, -3.0, -3.0, 0.5)
    frame = pasted(np.inf, *[posed(60, 3.0), dark][::order])
    assert frame.image[6, 8].max() < 100  # the nearer one is on top
    assert frame.depth[6, 8] == pytest.approx(4.5, abs=0.05)


def test_wall_between_two_objects_hides_the_farther_alone():
    near, far = posed(2.0, 3.0, -4.0, 0.5), posed(60, -3.0, 2.0, 2.0)
    alone = pasted(7.0, near)
    assert (alone.depth < 7).sum() > 3
    frame = pasted(7.0, far, near)
    assert (frame.image == alone.image).all() and (frame.depth == alone.depth).all()
    layers = frame.layers(["far", "near"])
    assert not layers["far"].any() and np.isinf(layers["far.Z"]).all()
    assert layers["near"][..., 3].sum() == (alone.depth < 7).sum()
    total = sum(layers[name] for name in ("scene", "far", "near"))
    assert (total == layers[""]).all()
    nearest = np.minimum(layers["scene.Z"], layers["near.Z"])
    assert (nearest == layers["Z"]).all()


def test_no_kernel_is_compiled_after_the_first_frame():
    item = posed(30.0)
    paster = Paster(CAMERA, [item])
    first = paster.paste(frame_at(look_at((-4, 0, 0), (0, 0, 0)), np.inf))
    with nothing_compiled():
        item.field.set_parameter("texture", item.field.texture.numpy() - 1.0)
        item.move(np.array([0.3, 0.1, 0.0, 0, 0, 0]))
        second = paster.paste(frame_at(look_at((-5, 1, 0.5), (0, 0, 0)), np.inf))
    assert second.image[6, 8].max() < first.image[6, 8].min() - 20


def test_without_objects_frames_stay():
    frame = frame_at(AHEAD, np.inf)
    assert Paster(CAMERA, []).paste(frame) is frame


def paste(camera=CAMERA, pose=AHEAD, make=posed):
    return lambda: Paster(camera, [make(1.0)]).paste(frame_at(pose, np.inf))


FAR = look_at((5e5, 5.4e6, 0.0), (5e5 + 1, 5.4e6, 0.0))
test_bad_input = refusals(
    (paste(pose=FAR), r"camera at \[500000.0, 5400000.0, 0.0\] m:"),
    (paste(from_fov(8, 6, 60.0)), "frame: image .12, 16, 3.*6 x 8 pixels"),
    (paste(make=homogeneous), "objects: GridField"),
)


def test_objects_die_with_their_paster():
    gc.collect()
    gc.disable()
    try:
        thing = posed(30.0)
        paster, alive = Paster(CAMERA, [thing]), weakref.ref(thing.field)
        paster.paste(frame_at(AHEAD, np.inf))
        del thing, paster
        assert alive() is None
    finally:
        gc.enable()
