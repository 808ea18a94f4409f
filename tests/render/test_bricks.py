"""Bricks have no derivatives by rays: their faces are not shared, so values jump."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers import toy_loop as toy

from mi_nerfattack.deploy.surrogate.scene import showing
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.composite import DepthComposite, Seen
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("composite", [DepthComposite(), InterleavedComposite()])
def test_bricks_have_no_derivatives_by_rays(composite, rng) -> None:
    bricks, grid = small.small_bricks(rng), small.blob(rng)
    layers = [PosedField(field) for field in (bricks, grid)]
    rays = small.arguments(layers[0], *small.fan(rng)[:2])[1]
    seen, cotangent = composite.render(layers, rays, 0.0), small.random_march(rng, 32)
    with pytest.raises(InputError, match="brick_field: .* keep the camera detached"):
        composite.backward_rays(layers, rays, seen, Seen(cotangent), 0.0, [0, 1])
    # the objects among them have such derivatives, which poses are attacked by
    (found,) = composite.backward_rays(layers, rays, seen, Seen(cotangent), 0.0, [1])
    by_origin = found.origin.numpy()
    assert np.isfinite(by_origin).all() and by_origin.any()


def test_an_attached_gradient_through_bricks_is_refused(rng) -> None:
    loop, item = toy.make_loop()
    bricks = PosedField(small.small_bricks(rng))
    sensor = showing(loop.sensor, loop.sensor.objects, bricks)
    state = loop.initial(np.zeros((1, 3)))
    seen = sensor.observe(state, 0)
    d_image = dr.ones(mi.TensorXf, seen.image.shape)
    sensor.start_gradient()
    with pytest.raises(InputError, match="brick_field: .* keep the camera detached"):
        sensor.vjp(seen, state, d_image, True)
    sensor.start_gradient()
    assert sensor.vjp(seen, state, d_image, False) is None
