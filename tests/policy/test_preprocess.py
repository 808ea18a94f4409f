"""From the camera's image to a network's input: values, derivatives, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.preprocess import (
    Crop,
    FractionalCrop,
    Normalise,
    Preprocess,
    Resize,
    ToLinear,
    antialias,
    area,
    bilinear,
    channels_first,
    channels_last,
    time_channels_last,
    time_first,
    to_bgr,
    to_grey,
    to_yuv,
)

STAGES = {
    "crop": Crop(1, 2, 3, 0),
    "fraction": FractionalCrop(0.25, 0.0, 0.1, 0.2),
    "bilinear": Resize(5, 9, bilinear),
    "antialias": Resize(5, 3, antialias),
    "area": Resize(4, 3, area),
    "linear": ToLinear(),
    "yuv": to_yuv(),
    "grey": to_grey(),
    "bgr": to_bgr(),
    "normalise": Normalise(255.0, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
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
    ("stage", "code"), [(to_yuv(), cv2.COLOR_RGB2YUV), (to_grey(), cv2.COLOR_RGB2GRAY)]
)
def test_colours_are_opencvs(stage, code, rng):
    image = picture(rng)
    expected = cv2.cvtColor(image, code).reshape(12, 20, -1)
    # OpenCV rounds 0.492 and 0.877 to the same digits, and its luma to fixed point
    np.testing.assert_allclose(applied(stage, image), expected, atol=1e-5)


def test_bgr_and_linear(rng):
    image = picture(rng)
    np.testing.assert_array_equal(applied(to_bgr(), image), image[..., ::-1])
    levels = np.float32([0.0, 0.04045, 0.5, 1.0]).reshape(1, 4, 1).repeat(3, 2)
    # IEC 61966-2-1: 0.04045 / 12.92, and 0.5 has 21.4 % of the light
    expected = [0.0, 0.0031308, 0.2140411, 1.0]
    np.testing.assert_allclose(
        applied(ToLinear(), levels)[0, :, 1], expected, atol=1e-7
    )


@pytest.mark.parametrize(
    ("filter", "code", "size"),
    [
        (bilinear, cv2.INTER_LINEAR, (7, 5)),
        (bilinear, cv2.INTER_LINEAR, (41, 30)),
        (area, cv2.INTER_AREA, (10, 4)),
        (area, cv2.INTER_AREA, (7, 5)),
    ],
)
def test_resize_is_opencvs(filter, code, size, rng):
    image = picture(rng)
    expected = cv2.resize(image, size, interpolation=code)
    np.testing.assert_allclose(
        applied(Resize(*size, filter), image), expected, atol=1e-5
    )


def test_antialias_is_torchs(rng):
    planes = torch.rand(2, 3, 188, 366, dtype=torch.float64)
    expected = torch.nn.functional.interpolate(
        planes, (66, 200), mode="bilinear", antialias=True
    )
    torch.testing.assert_close(Resize(200, 66).apply(planes), expected)


def test_resize_to_the_same_size_is_nothing():
    planes = torch.rand(1, 3, 4, 6)
    assert Resize(6, 4).apply(planes) is planes


def test_crops():
    planes = torch.arange(80.0).reshape(1, 1, 8, 10)
    cut = Crop(1, 2, 3, 4).apply(planes)
    assert torch.equal(cut, planes[:, :, 1:6, 3:6])
    # 0.3 of 8 rows is 2.4: two; 0.25 of 10 columns is 2.5: three
    cut = FractionalCrop(0.3, 0.0, 0.25, 0.0).apply(planes)
    assert torch.equal(cut, planes[:, :, 2:, 3:])


def test_normalise():
    planes = torch.rand(2, 3, 4, 5, dtype=torch.float64)
    stage = Normalise(255.0, (10.0, 20.0, 30.0), (2.0,))
    expected = (255 * planes - torch.tensor([10.0, 20, 30])[:, None, None]) / 2
    torch.testing.assert_close(stage.apply(planes), expected)


def test_layouts():
    frames = torch.rand(2, 4, 3, 5, 6)
    flat = channels_first(frames)
    assert flat.shape == (2, 12, 5, 6)
    assert torch.equal(flat[:, 3:6], frames[:, 1])  # frame by frame, oldest first
    assert torch.equal(channels_last(frames), flat.permute(0, 2, 3, 1))
    assert torch.equal(time_first(frames), frames)
    assert time_channels_last(frames).shape == (2, 4, 5, 6, 3)


def test_stages_follow_each_other(rng):
    image = torch.rand(1, 6, 8, 3)
    preprocess = Preprocess([Crop(2, 0, 0, 0), to_grey(), Normalise(2.0)])
    expected = 2 * (image[:, 2:] @ torch.tensor([0.299, 0.587, 0.114]))[:, None]
    torch.testing.assert_close(preprocess.transform(image), expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Crop(-1, 0, 0, 0), "none below 0"),
        (lambda: FractionalCrop(0.5, 0.5, 0, 0), "below 1"),
        (lambda: Resize(0, 4), "at least 1"),
        (lambda: Normalise(0.0), "scale 0"),
        (lambda: Normalise(1.0, std=(0.0,)), "positive"),
        (lambda: Preprocess(frames=0), "at least 1"),
        (lambda: Crop(4, 4, 0, 0).apply(torch.rand(1, 3, 8, 9)), "9 x 8 pixels"),
        (lambda: to_yuv().apply(torch.rand(1, 1, 8, 9)), "meets an image of 1"),
        (lambda: Normalise(1.0, (0, 0)).apply(torch.rand(1, 3, 8, 9)), "2 channels"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(InputError, match=message):
        make()
