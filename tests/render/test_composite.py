"""The depth composite against A.4 to A.6 written out by hand."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mi_nerfattack.render.composite import (
    DepthComposite,
    Seen,
    depth_composite,
    sort_by_depth,
)
from mi_nerfattack.render.rays import March

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


def read(march: March) -> tuple[np.ndarray, float, float]:
    """Return premultiplied radiance, opacity and depth of a one-ray march."""
    radiance = march.radiance.numpy()[:, 0]
    return radiance, float(march.opacity[0]), float(march.depth[0])


def test_two_layers_are_a6_times_its_divisor() -> None:
    front, back = (np.array([0.9, 0.2, 0.1]), 0.3), (np.array([0.1, 0.5, 0.8]), 0.6)
    seen = depth_composite([layer(*back, depth=7.0), layer(*front, depth=4.0)])
    a = 0.3 + 0.6 * (1 - 0.3)
    colour = (front[0] * 0.3 + back[0] * 0.6 * (1 - 0.3)) / a  # A.6
    radiance, opacity, depth = read(seen)
    assert opacity == pytest.approx(a)
    np.testing.assert_allclose(radiance, a * colour, rtol=1e-6)
    # The mean of the depths, weighted by what each layer contributes.
    assert depth == pytest.approx((4 * 0.3 + 7 * 0.42) / a)


def test_order_is_chosen_ray_by_ray() -> None:
    ones = mi.Float([1, 1])
    red = March(mi.Color3f(1, 0, 0) * ones, ones, mi.Float([1, 5]))
    blue = March(mi.Color3f(0, 0, 1) * ones, ones, mi.Float([3, 3]))
    seen = depth_composite([red, blue]).radiance.numpy()
    np.testing.assert_array_equal(seen, [[1, 0], [0, 0], [0, 1]])


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
    shares = DepthComposite().shares(Seen(depth_composite(marches), marches))
    for name in ("radiance", "opacity", "moment"):
        parts = sum(np.array(getattr(share, name)) for share in shares)
        whole = np.array(getattr(depth_composite(marches), name))
        np.testing.assert_allclose(parts, whole, atol=1e-5)


def test_over_is_associative(rng: np.random.Generator) -> None:
    a, b, c = [layer(rng.random(3), rng.random(), 1 + rng.random()) for _ in range(3)]
    left, right = read(a.over(b).over(c)), read(a.over(b.over(c)))
    for x, y in zip(left, right, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-6)


def leaves(rng: np.random.Generator, count: int = 16) -> list[np.ndarray]:
    """Make radiance, opacity and moment (5, count) of three layers apart in depth."""
    result = []
    for k in range(3):
        opacity = rng.uniform(0.2, 0.8, (1, count))
        depth = rng.uniform(1, 2, (1, count)) + 3 * rng.permutation(3)[k]
        result.append(
            np.concatenate([rng.random((3, count)), opacity, opacity * depth])
        )
    return result


def marches(values: list[np.ndarray]) -> list[March]:
    """Make marches of (5, n) arrays."""
    rows = [[mi.Float(row.astype(np.float32)) for row in v] for v in values]
    return [March(mi.Color3f(*r[:3]), r[3], r[4]) for r in rows]


def test_gradient_against_differences(rng: np.random.Generator) -> None:
    base = leaves(rng)
    tangent = [rng.normal(size=v.shape) for v in base]
    cotangent = small.random_march(rng, 16)

    def objective(s: float) -> float:
        moved = [v + s * t for v, t in zip(base, tangent, strict=True)]
        return small.pairing(depth_composite(marches(moved)), cotangent)

    expected = (objective(1e-3) - objective(-1e-3)) / 2e-3
    layers = marches(base)
    dr.enable_grad(layers)
    seen = depth_composite(layers)
    dr.backward(
        dr.sum(
            dr.dot(seen.radiance, cotangent.radiance)
            + seen.opacity * cotangent.opacity
            + seen.moment * cotangent.moment
        )
    )
    found = 0.0
    for item, t in zip(layers, tangent, strict=True):
        grad = dr.grad(item)
        rows = [*grad.radiance, grad.opacity, grad.moment]
        found += sum(float(r.numpy() @ t[k]) for k, r in enumerate(rows))
    assert found == pytest.approx(expected, rel=2e-3)


def test_layer_behind_an_opaque_one_has_no_gradient() -> None:
    front, back = layer(RED, 1.0, 2.0), layer(BLUE, 0.5, 3.0)
    dr.enable_grad(front, back)
    dr.backward(dr.sum(depth_composite([back, front]).radiance))
    assert (dr.grad(back.radiance).numpy() == 0).all()
    assert dr.grad(front.radiance).numpy().ravel() == pytest.approx([1, 1, 1])
    # Less of the front lets (0, 0, 0.5) through, summed over the colours.
    assert dr.grad(front.opacity)[0] == pytest.approx(-0.5)
