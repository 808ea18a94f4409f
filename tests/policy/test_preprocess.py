"""From the camera's image to a network's input: values, derivatives, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from support.faults.refusals import refusals

from mi_nerfattack.policy import preprocess as pre

STAGES = {
    "crop": pre.Crop(1, 2, 3, 0),
    "fraction": pre.FractionalCrop(0.25, 0.0, 0.1, 0.2),
    "bilinear": pre.Resize(5, 9, pre.bilinear),
    "antialias": pre.Resize(5, 3, pre.antialias),
    "area": pre.Resize(4, 3, pre.area),
    "linear": pre.ToLinear(),
    "yuv": pre.to_yuv(),
    "grey": pre.to_grey(),
    "bgr": pre.to_bgr(),
    "normalise": pre.Normalise(255.0, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
}


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_derivatives_in_float64(stage):
    planes = torch.rand(2, 3, 8, 11, dtype=torch.float64)
    tangent = torch.randn_like(planes)
    leaf = planes.clone().requires_grad_(True)
    result = stage.apply(leaf)
    weight = torch.randn_like(result)
    (gradient,) = torch.autograd.grad(result, leaf, weight)
    reverse = (gradient * tangent).sum().item()
    scale = (gradient * tangent).abs().sum().item()
    step = 1e-6
    change = stage.apply(planes + step * tangent) - stage.apply(planes - step * tangent)
    numeric = (change * weight).sum().item() / (2 * step)
    assert numeric == pytest.approx(reverse, abs=1e-7 * scale)


def picture(rng, height=12, width=20):
    return rng.random((height, width, 3)).astype(np.float32)


def applied(stage, image):
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    return stage.apply(planes)[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize(
    ("stage", "code"),
    [(pre.to_yuv(), cv2.COLOR_RGB2YUV), (pre.to_grey(), cv2.COLOR_RGB2GRAY)],
)
def test_colours_are_opencvs(stage, code, rng):
    image = picture(rng)
    expected = cv2.cvtColor(image, code).reshape(12, 20, -1)
    # OpenCV rounds 0.492 and 0.877 to the same digits, and its luma to fixed point
    np.testing.assert_allclose(applied(stage, image), expected, atol=1e-5)


def test_bgr_linear_crops_and_normalising(rng):
    image = picture(rng)
    np.testing.assert_array_equal(applied(pre.to_bgr(), image), image[..., ::-1])
    levels = np.float32([0.0, 0.04045, 0.1, 0.5, 1.0]).reshape(1, 5, 1).repeat(3, 2)
    # IEC 61966-2-1: 0.04045 / 12.92, and 0.5 has 21.4 % of the light
    expected = [0.0, 0.0031308, 0.0100228, 0.2140411, 1.0]
    linear = applied(pre.ToLinear(), levels)[0, :, 1]
    np.testing.assert_allclose(linear, expected, atol=1e-7)
    cut = applied(pre.Crop(1, 2, 3, 4), image)
    np.testing.assert_array_equal(cut, image[1:10, 3:16])
    # 0.3 of 12 rows is 3.6: four; 0.125 of 20 columns is 2.5: three
    cut = applied(pre.FractionalCrop(0.3, 0.0, 0.125, 0.0), image)
    np.testing.assert_array_equal(cut, image[4:, 3:])
    stage = pre.Normalise(255.0, (10.0, 20.0, 30.0), (2.0,))
    expected = (255 * image - [10.0, 20.0, 30.0]) / 2
    np.testing.assert_allclose(applied(stage, image), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("filter", "code", "size"),
    [
        (pre.bilinear, cv2.INTER_LINEAR, (7, 5)),
        (pre.bilinear, cv2.INTER_LINEAR, (41, 30)),
        (pre.area, cv2.INTER_AREA, (10, 4)),
        (pre.area, cv2.INTER_AREA, (7, 5)),
    ],
)
def test_resize_is_opencvs(filter, code, size, rng):
    image = picture(rng)
    expected = cv2.resize(image, size, interpolation=code)
    np.testing.assert_allclose(
        applied(pre.Resize(*size, filter), image), expected, atol=1e-5
    )


def test_layouts():
    frames = torch.rand(2, 4, 3, 5, 6)
    flat = pre.channels_first(frames)
    assert flat.shape == (2, 12, 5, 6)
    assert torch.equal(flat[:, 3:6], frames[:, 1])  # frame by frame, oldest first
    assert torch.equal(pre.channels_last(frames), flat.permute(0, 2, 3, 1))
    assert torch.equal(pre.time_first(frames), frames)
    assert pre.time_channels_last(frames).shape == (2, 4, 5, 6, 3)


def test_antialias_is_torchs(rng):
    planes = torch.rand(2, 3, 188, 366, dtype=torch.float64)
    expected = torch.nn.functional.interpolate(
        planes, (66, 200), mode="bilinear", antialias=True
    )
    torch.testing.assert_close(pre.Resize(200, 66).apply(planes), expected)


def meets(stage, channels=3):
    return lambda: stage().apply(torch.rand(1, channels, 8, 9))


test_refusals = refusals(
    (lambda: pre.Crop(-1, 0, 0, 0), "none below 0"),
    (lambda: pre.FractionalCrop(0.5, 0.5, 0, 0), "below 1"),
    (lambda: pre.Resize(0, 4), "at least 1"),
    (lambda: pre.Normalise(0.0), "scale 0"),
    (lambda: pre.Normalise(1.0, std=(0.0,)), "positive"),
    (lambda: pre.Preprocess(frames=0), "at least 1"),
    (meets(lambda: pre.Crop(4, 4, 0, 0)), "9 x 8 pixels"),
    (meets(pre.to_yuv, 1), "meets an image of 1"),
    (meets(lambda: pre.Normalise(1.0, (0, 0))), "2 channels"),
)
