"""Composites: the depth composite against A.4 to A.6 by hand, and the interleaved."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.worlds import fields as small

from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import (
    DepthComposite,
    Marches,
    depth_composite,
    sort_by_depth,
)
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import absorption

pytestmark = pytest.mark.usefixtures("variant")

RED, _, BLUE = np.eye(3)


def layer(colour: np.ndarray, opacity: float, depth: float) -> March:
    """Make one ray's march from unpremultiplied colour, opacity and depth."""
    moment = opacity * depth if opacity > 0 else 0.0
    return March(
        mi.Color3f(*map(float, opacity * np.asarray(colour))),
        mi.Float(opacity),
        mi.Float(moment),
    )


def read(one: March) -> tuple[np.ndarray, float, float]:
    """Return premultiplied radiance, opacity and depth of a one-ray march."""
    radiance = one.radiance.numpy()[:, 0]
    return radiance, float(one.opacity[0]), float(one.depth[0])


def test_order_is_chosen_ray_by_ray() -> None:
    ones = mi.Float([1, 1])
    red = March(mi.Color3f(1, 0, 0) * ones, ones, mi.Float([1, 5]))
    blue = March(mi.Color3f(0, 0, 1) * ones, ones, mi.Float([3, 3]))
    radiance = depth_composite([red, blue]).radiance.numpy()
    np.testing.assert_array_equal(radiance, [[1, 0], [0, 0], [0, 1]])


@settings(max_examples=30)
@example([(BLUE, 0.7, 4), (RED, 1.0, 2)])  # an opaque one in front
@example([(RED, 0.5, 2), (BLUE, 0.0, 1), (RED, 0.0, 3)])  # empty ones around
@example([(RED, 0.0, 1), (BLUE, 0.0, 1)])  # nothing
@example([(RED, 1.0, 2), (BLUE, 1.0, 2)])  # equal depths: the list's order
@given(
    st.lists(
        st.tuples(
            st.tuples(*[st.floats(0, 1, width=32)] * 3),
            st.sampled_from([0.0, 0.25, 0.5, 1.0]),
            st.integers(1, 5),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_any_layers_against_a_sequential_fold(layers) -> None:
    marches = [layer(np.array(c), a, float(z)) for c, a, z in layers]
    radiance, opacity, depth = read(depth_composite(marches))

    order = sorted(layers, key=lambda item: item[2] if item[1] > 0 else np.inf)
    colour, moment, passed = np.zeros(3), 0.0, 1.0
    for c, a, z in order:
        colour += passed * a * np.array(c)
        moment += passed * a * z
        passed *= 1 - a
    np.testing.assert_allclose(radiance, colour, atol=1e-6)
    assert opacity == pytest.approx(1 - passed, abs=1e-6)
    expected = moment / (1 - passed) if passed < 1 else np.inf
    assert depth == pytest.approx(expected, rel=1e-5)
    depths = [float(m.depth[0]) for m in sort_by_depth(marches)]
    assert depths == sorted(depths)
    shares = DepthComposite().shares(Marches(depth_composite(marches), marches))
    for name in ("radiance", "opacity", "moment"):
        summed = sum(np.array(getattr(share, name)) for share in shares)
        composed = np.array(getattr(depth_composite(marches), name))
        np.testing.assert_allclose(summed, composed, atol=1e-5)


def test_a_march_differs_from_nothing_in_any_part() -> None:
    black, white, green = np.array([[0, 0, 0], [1, 1, 1], [0, 0.5, 0]])
    rows = [(black, 0, 0), (white, 0, 0), (green, 0, 0), (black, 0.5, 0), (black, 0, 2)]
    colours, opacity, moment = map(list, zip(*rows, strict=True))
    one = March(mi.Color3f(np.array(colours).T), mi.Float(opacity), mi.Float(moment))
    assert one.differs().numpy().tolist() == [False, True, True, True, True]


def test_layer_behind_an_opaque_one_has_no_gradient() -> None:
    front, back = layer(RED, 1.0, 2.0), layer(BLUE, 0.5, 3.0)
    dr.enable_grad(front, back)
    dr.backward(dr.sum(depth_composite([back, front]).radiance))
    assert (dr.grad(back.radiance).numpy() == 0).all()
    assert dr.grad(front.radiance).numpy().ravel() == pytest.approx([1, 1, 1])
    # Less of the front lets (0, 0, 0.5) through, summed over the colours.
    assert dr.grad(front.opacity)[0] == pytest.approx(-0.5)


# Interleaved


def make_rays(rng: np.random.Generator, t_max: float = 10.0) -> Rays:
    origin, direction, _, _ = small.fan(rng, 24)
    far, jitter = dr.opaque(mi.Float, t_max), dr.opaque(mi.Float, 0.5)
    return Rays(origin, direction, far, jitter, mi.Bool(True))


def as_rows(integrals: March) -> np.ndarray:
    rows = [*integrals.radiance, integrals.opacity, integrals.moment]
    return np.stack([np.array(row) for row in rows])


def test_absorption_against_float64() -> None:
    x = np.concatenate([[0.0], np.geomspace(1e-7, 50, 200)])
    phi, slope = absorption(mi.Float(x.astype(np.float32)))
    x = np.maximum(x.astype(np.float32).astype(np.float64), 1e-300)
    expected = -np.expm1(-x) / x
    np.testing.assert_allclose(phi.numpy(), expected, rtol=2e-6)
    with np.errstate(all="ignore"):
        exact = (np.exp(-x) * (x + 1) - 1) / x**2
    exact = np.where(x < 1e-3, -0.5 + x / 3, exact)
    np.testing.assert_allclose(slope.numpy(), exact, rtol=2e-5)


def test_fields_apart_are_the_depth_composite(rng: np.random.Generator) -> None:
    front, back = (
        PosedField(small.blob(rng), Pose.upright((x, 0.0, 0.0), 0.0, 0.4))
        for x in (-1.0, 1.0)
    )
    rays = make_rays(rng)
    for fields in ([front, back], [back, front]):
        exact = InterleavedComposite().render(fields, rays, 0.0).total
        folded = DepthComposite().render(fields, rays, 0.0).total
        assert exact.opacity.numpy().max() > 0.3
        np.testing.assert_allclose(as_rows(exact), as_rows(folded), atol=2e-6)


@pytest.mark.parametrize(
    ("move", "t_max"),
    [((0, 0, 0), 0.0), ((-9, 0, 0), 10.0), ((0, 9, 0), 10.0)],
    ids=["empty ray", "behind the camera", "beside"],
)
def test_nothing_is_seen(rng, move, t_max) -> None:
    fields = [PosedField(small.blob(rng), Pose.upright(move, 0.0)) for _ in range(2)]
    integrals = InterleavedComposite().render(fields, make_rays(rng, t_max), 0.0).total
    assert (as_rows(integrals) == 0).all() and (integrals.depth.numpy() == np.inf).all()


def test_opaque_box_inside_fog(rng: np.random.Generator) -> None:
    fog = PosedField(small.homogeneous(0.5, -1.0))
    box = PosedField(small.homogeneous(1e5, 1.0), Pose.upright((0, 0, 0), 0.0, 0.3))
    rays = make_rays(rng)
    rays.origin, rays.direction = mi.Point3f(-3, 0.1, 0.1), mi.Vector3f(1, 0, 0)
    marches = InterleavedComposite().render([fog, box], rays, 0.0)
    passed = np.exp(-0.5 * 0.7)  # from x = -1 to x = -0.3
    raw = small.sigmoid_to_linear(np.array([-1.0, 1.0]))
    expected = (1 - passed) * raw[0] + passed * raw[1]
    assert marches.total.opacity[0] == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(marches.total.radiance.numpy(), expected, rtol=2e-4)
