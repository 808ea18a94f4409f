"""What a camera adds to images, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support.reference.derivatives import central_difference, nothing_compiled
from support.reference.loop import row_type, tensor, tensor_type

from mi_nerfattack.backend.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.disturbance import Disturbance, blur, standard_normal

pytestmark = pytest.mark.usefixtures("variant")

SHAPE = (3, 5, 9, 3)
ALL = Disturbance(
    exposure_ev_sd=0.9, blur_px_sd=0.6, noise_sd=0.04, colour_ev_sd=0.3, seed=7
)
SIZES = ("exposure_ev_sd", "blur_px_sd", "noise_sd", "colour_ev_sd")


@pytest.fixture
def image(rng):
    return rng.uniform(0, 1, SHAPE)


def blurred(image, blurs):
    rows = zip(image, blurs, strict=True)
    return np.stack([gaussian_filter(x, (s, s, 0)) if s else x for x, s in rows])


@pytest.mark.parametrize("largest", [0.02, 2.3, 5.0])  # beyond the image, too
def test_blur_is_that_of_scipy(image, largest):
    blurs = np.array([0.0, 0.4 * largest, largest])
    actual = np.array(blur(row_type()(image.ravel()), SHAPE, blurs)).reshape(SHAPE)
    # Dr.Jit keeps weights in single precision
    np.testing.assert_allclose(actual, blurred(image, blurs), rtol=0, atol=3e-7)
    for k in range(3):  # each image is blurred as in a batch
        alone = blur(row_type()(image[k].ravel()), (1, *SHAPE[1:]), blurs[k : k + 1])
        assert np.array_equal(np.array(alone), actual[k].ravel())


def test_light_is_blurred_and_exposed_and_values_get_noise(image):
    exposures, blurs = ALL.draws(3)
    light = blurred(srgb_to_linear_numpy(image), blurs)
    value = linear_to_srgb_numpy(light * 2.0 ** exposures[:, None, None])
    noise = np.array(standard_normal(row_type(), SHAPE, 7, 2)).reshape(SHAPE)
    expected = np.clip(value + 0.04 * noise, 0, 1)
    frame = tensor(image)
    for _ in range(2):  # the image stays as it is
        disturbed = np.array(ALL.apply(frame, 2))
        np.testing.assert_allclose(disturbed, expected, atol=2e-6)
    assert (expected == 1).any() and (value > 1 - 1e-9).any()  # some is clipped


def test_exposures_and_blurs_are_normal_and_half_normal():
    exposures, blurs = ALL.draws(20000)
    assert exposures.std(0) == pytest.approx(np.hypot(0.9, 0.3), rel=0.03)
    # what the channels share is the exposure
    assert np.cov(exposures.T)[0, 1] == pytest.approx(0.81, rel=0.04)
    assert abs(exposures.mean()) < 0.025 and blurs.min() >= 0
    assert np.sqrt((blurs**2).mean()) == pytest.approx(0.6, rel=0.03)
    assert abs(np.corrcoef(exposures[:, 0], blurs)[0, 1]) < 0.03
    for few, many in zip(ALL.draws(2), ALL.draws(5), strict=True):
        assert np.array_equal(few, many[:2])  # a drive's own, whatever the batch


def test_noise_is_normal_and_independent_of_pixel_row_step_and_seed():
    shape = (2, 60, 90, 3)

    def draw(seed, step):
        return np.array(standard_normal(mi.Float, shape, seed, step)).reshape(shape)

    first = draw(5, 3)
    fields = [first[0], first[1], draw(5, 4)[0], draw(6, 3)[0]]
    moments = [(first**k).mean() for k in (1, 2, 3, 4)]
    np.testing.assert_allclose(moments, [0, 1, 0, 3], atol=0.12)
    flat = np.stack([field.ravel() for field in fields])
    flat = np.vstack([flat, np.roll(flat[0], 1), np.roll(flat[0], 3)])
    correlations = np.corrcoef(flat) - np.eye(6)
    assert np.abs(correlations).max() < 4 / np.sqrt(flat.shape[1])
    assert np.array_equal(draw(5, 3), first)
    alone = np.array(standard_normal(mi.Float, (1, *shape[1:]), 5, 3))
    assert np.array_equal(alone, first[0].ravel())  # whatever the batch


@pytest.mark.parametrize("names", [SIZES, *((name,) for name in SIZES)])
def test_derivatives_are_exact(image, rng, names):
    sizes = {name: getattr(ALL, name) for name in names}
    disturbance = Disturbance(seed=7, **sizes)
    frame, weight = tensor(image), rng.normal(size=SHAPE)
    by_image = np.array(disturbance.vjp(frame, 1, tensor(weight)))
    along = rng.normal(size=SHAPE)
    expected = (by_image * along).sum()

    def value(s):
        return (
            np.array(disturbance.apply(tensor(image + s * along), 1)) * weight
        ).sum()

    assert central_difference(value, 1e-6) == pytest.approx(expected, rel=1e-7)


def test_other_steps_and_sizes_compile_nothing():
    # memory of NumPy's may be aligned in any way, for which there are other kernels
    frame = mi.TensorXf(dr.linspace(mi.Float, 0, 1, int(np.prod(SHAPE))), SHAPE)
    dr.eval(frame)

    def work(disturbance, step):
        np.array(disturbance.apply(frame, step))
        np.array(disturbance.vjp(frame, step, frame))

    work(ALL, 0)
    value = frame.array
    np.array(blur(value, SHAPE, np.array([0.5, 1.0, 0.5])))
    with nothing_compiled():
        work(replace(ALL, noise_sd=0.1, exposure_ev_sd=0.2), 5)
        np.array(blur(value, SHAPE, np.array([0.6, 1.1, 0.4])))  # of the same reach


def test_nothing_is_disturbed_by_default_and_sizes_are_checked(image):
    assert not Disturbance(seed=3)
    unchanged = np.array(Disturbance().apply(tensor_type()(image), 0))
    assert np.array_equal(unchanged, image)
    with pytest.raises(InputError) as caught:
        Disturbance(noise_sd=-0.1)
    assert caught.value.where == "Disturbance.noise_sd"
