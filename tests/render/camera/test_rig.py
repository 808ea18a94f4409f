"""Several cameras of a vehicle: their images in one frame."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals

from mi_nerfattack.render.camera.disturbance import Disturbance, side_by_side
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig, camera_seed

pytestmark = pytest.mark.usefixtures("variant")

SIZES = (4, 3), (2, 5)
RIG = Rig(
    ("front", "left"),
    tuple(from_fov(*size, 90.0) for size in SIZES),
    (CameraMount(), CameraMount(left_m=0.4, yaw_deg=60.0)),
)


def pictures(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {
        name: rng.uniform(0.1, 0.9, (2, high, wide, 3)).astype(np.float32)
        for name, (wide, high) in zip(RIG.names, SIZES, strict=True)
    }


def test_images_lie_side_by_side_and_are_black_below(rng):
    images = pictures(rng)
    frame = RIG.join(images)
    assert frame.shape == (2, 5, 6, 3) and RIG.size == (6, 5)
    assert RIG.columns == {"front": slice(0, 4), "left": slice(4, 6)}
    assert not frame[:, 3:, :4].any()
    for split_images in (
        RIG.split(frame),
        {k: v.numpy() for k, v in RIG.split(torch.tensor(frame)).items()},
        {k: v.numpy() for k, v in RIG.split(mi.TensorXf(frame)).items()},
    ):
        assert list(split_images) == ["front", "left"]
        for name, image in images.items():
            assert np.array_equal(split_images[name], image)
    together = side_by_side([mi.TensorXf(x) for x in images.values()], RIG.layout)
    assert np.array_equal(together.numpy(), frame)


def test_derivatives_pass_when_a_frame_is_taken_apart_and_put_together(rng):
    frame, weight = RIG.join(pictures(rng)), rng.normal(size=(2, 5, 6, 3))
    inside = RIG.join({k: np.ones_like(v) for k, v in pictures(rng).items()})
    value = mi.TensorXf(frame)
    dr.enable_grad(value)
    images = list(RIG.split(value).values())
    shown = side_by_side(images, RIG.layout)
    dr.backward(dr.sum(shown.array * mi.Float(weight.ravel().astype(np.float32))))
    gradient = dr.grad(value).numpy()
    np.testing.assert_allclose(gradient, weight * inside, rtol=1e-6)
    value = torch.tensor(frame, requires_grad=True)
    RIG.split(value)["left"].sum().backward()
    assert value.grad is not None and value.grad.sum() == 2 * 2 * 5 * 3


def test_one_camera_is_the_smallest_rig():
    rig = Rig.of_one(RIG.cameras[0], RIG.mounts[0])
    image = np.zeros((3, 4, 3))
    assert rig.split(image) == {"camera": image} and rig.layout.join([image]) is image
    assert rig.others is None and RIG.others is not None
    assert Rig.of_one(RIG.cameras[0], RIG.mounts[0], "front") + RIG.others == RIG
    assert camera_seed(7, 0) == 7 != camera_seed(7, 1) != camera_seed(7, 2)


def test_what_identities_hold_of_a_mount_is_what_it_was():
    old = {"height_m": 1.4, "forward_m": 0.5, "pitch_deg": 6.0}
    assert CameraMount().described() == old
    assert RIG.mounts[1].described() == old | {"left_m": 0.4, "yaw_deg": 60.0}


def test_a_disturbance_ends_where_an_image_does(rng):
    disturbance = Disturbance(exposure_ev_sd=0.5, blur_px_sd=1.0, noise_sd=0.02, seed=3)
    images = pictures(rng)
    shown = disturbance.apply(mi.TensorXf(RIG.join(images)), 4, RIG.layout)
    disturbed = RIG.split(shown.numpy())
    # the first image is what it is without the second one, and so is the second
    alone = disturbance.apply(mi.TensorXf(images["front"]), 4).numpy()
    assert np.array_equal(disturbed["front"], alone)
    images["front"] = np.zeros_like(images["front"])
    again = disturbance.apply(mi.TensorXf(RIG.join(images)), 4, RIG.layout).numpy()
    assert np.array_equal(RIG.split(again)["left"], disturbed["left"])
    assert not again[:, 3:, :4].any()  # nor has the frame noise where no image is
    plain = Disturbance(noise_sd=0.02, seed=3)
    grey = RIG.join({k: np.full_like(v, 0.5) for k, v in images.items()})
    noise = RIG.split(plain.apply(mi.TensorXf(grey), 4, RIG.layout).numpy())
    assert not np.array_equal(noise["front"][:, :3, :2], noise["left"][:, :3, :2])


def test_the_derivative_of_a_disturbed_frame(rng):
    disturbance = Disturbance(exposure_ev_sd=0.3, blur_px_sd=1.0, seed=3)
    frame, direction = RIG.join(pictures(rng)), rng.normal(size=(2, 5, 6, 3))
    weight = mi.TensorXf(rng.normal(size=frame.shape).astype(np.float32))

    def value(step: float) -> float:
        moved = mi.TensorXf((frame + step * direction).astype(np.float32))
        shown = disturbance.apply(moved, 0, RIG.layout)
        return float((shown.numpy() * weight.numpy()).astype(float).sum())

    gradient = disturbance.vjp(mi.TensorXf(frame), 0, weight, RIG.layout).numpy()
    expected = (value(1e-2) - value(-1e-2)) / 2e-2
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=5e-3)


test_refused = refusals(
    (lambda: RIG.split(np.zeros((5, 7, 3))), "frame: 7 x 5 px; .* 6 x 5 px"),
    (lambda: Rig((), (), ()), "rig: 0 names, 0 cameras"),
    (lambda: RIG + RIG, "rig: cameras front, left, front, left; .*differ"),
    (lambda: RIG.require_one("replay", "x"), r"replay: .* 2 \(front, left\); x"),
)
