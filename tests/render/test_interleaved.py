"""The interleaved composite: identities, references, derivatives, hard points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.derivatives import central_difference
from helpers.variants import later

from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import DepthComposite, Seen
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import absorption

pytestmark = pytest.mark.usefixtures("variant")

COUNT = 24


def make_rays(rng: np.random.Generator, t_max: float = 10.0) -> Rays:
    origin, direction, _, _ = small.fan(rng, COUNT)
    far, jitter = dr.opaque(mi.Float, t_max), dr.opaque(mi.Float, 0.5)
    return Rays(origin, direction, far, jitter, mi.Bool(True))


def pair(rng: np.random.Generator) -> list[PosedField]:
    """Make two blobs of different scale, step and pose that overlap."""
    one = PosedField(small.blob(rng, step_m=0.03))
    other = PosedField(
        small.blob(rng, 3.0, 0.05), Pose.upright((0.2, 0.1, 0.1), 0.4, 0.7)
    )
    return [one, other]


def as_rows(seen: March) -> np.ndarray:
    rows = [*seen.radiance, seen.opacity, seen.moment]
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


def test_one_field_is_its_march(rng: np.random.Generator) -> None:
    rays = make_rays(rng)
    for field in (small.blob(rng), small.small_ngp(cone=0.02)):
        posed = PosedField(field, Pose.upright((0.1, 0.0, 0.0), 0.3, 1.2))
        seen = InterleavedComposite().render([posed], rays, 0.0).total
        np.testing.assert_allclose(
            as_rows(seen), as_rows(march(posed, rays, 0.0)), rtol=1e-5, atol=1e-6
        )


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
    [
        pytest.param((0, 0, 0), 0.0, id="empty ray"),
        pytest.param((-9, 0, 0), 10.0, id="behind the camera"),
        pytest.param((0, 9, 0), 10.0, id="beside"),
    ],
)
def test_nothing_is_seen(rng, move, t_max) -> None:
    fields = [PosedField(small.blob(rng), Pose.upright(move, 0.0)) for _ in range(2)]
    seen = InterleavedComposite().render(fields, make_rays(rng, t_max), 0.0).total
    assert (as_rows(seen) == 0).all() and (seen.depth.numpy() == np.inf).all()


def test_opaque_box_inside_fog(rng: np.random.Generator) -> None:
    fog = PosedField(small.homogeneous(0.5, -1.0))
    box = PosedField(small.homogeneous(1e5, 1.0), Pose.upright((0, 0, 0), 0.0, 0.3))
    rays = make_rays(rng)
    rays.origin, rays.direction = mi.Point3f(-3, 0.1, 0.1), mi.Vector3f(1, 0, 0)
    seen = InterleavedComposite().render([fog, box], rays, 0.0)
    passed = np.exp(-0.5 * 0.7)  # from x = -1 to x = -0.3
    raw = small.sigmoid_to_linear(np.array([-1.0, 1.0]))
    expected = (1 - passed) * raw[0] + passed * raw[1]
    assert seen.total.opacity[0] == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(seen.total.radiance.numpy(), expected, rtol=2e-4)


@pytest.mark.parametrize("which", [1, *later(0)])
def test_parameters_against_differences(rng, which: int) -> None:
    fields, rays = pair(rng), make_rays(rng)
    composite = InterleavedComposite()
    cotangent = small.random_march(rng, COUNT)
    item = fields[which].field
    base = item.packed.numpy().copy()
    tangent = rng.normal(size=base.shape)

    def shifted(s: float) -> float:
        item.packed = mi.Float((base + s * tangent).astype(np.float32))
        return small.pairing(composite.render(fields, rays, 0.0).total, cotangent)

    expected = central_difference(shifted, 2e-2)
    item.packed = mi.Float(base)
    seen = composite.render(fields, rays, 0.0)

    def attach() -> mi.Float:
        leaf = mi.Float(base)
        dr.enable_grad(leaf)
        item.packed = leaf
        return leaf

    leaf = attach()
    composite.backward(fields, rays, seen, Seen(cotangent), 0.0)
    backward = float(np.dot(dr.grad(leaf).numpy().astype(float), tangent))
    leaf = attach()
    dr.set_grad(leaf, mi.Float(tangent.astype(np.float32)))
    forward = small.pairing(composite.forward(fields, rays, seen, 0.0).total, cotangent)
    assert forward == pytest.approx(backward, rel=1e-4)
    assert backward == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_rays_against_differences(rng: np.random.Generator) -> None:
    fields, rays = pair(rng), make_rays(rng)
    composite = InterleavedComposite()
    cotangent = small.random_march(rng, COUNT)
    seen = composite.render(fields, rays, 0.0)
    layers = composite.backward_rays(fields, rays, seen, Seen(cotangent), 0.0, [0, 1])
    first, second = layers
    slopes = first.origin + second.origin, first.direction + second.direction
    tangent = rng.normal(size=(3, COUNT)).astype(np.float32)
    for name, slope in zip(("origin", "direction"), slopes, strict=True):
        before = getattr(rays, name)

        def shifted(s: float, name=name, before=before) -> float:
            setattr(rays, name, before + s * mi.Vector3f(tangent))
            seen = composite.render(fields, rays, 0.0).total
            setattr(rays, name, before)
            return small.pairing(seen, cotangent)

        found = float((slope.numpy().astype(float) * tangent).sum())
        # Samples that cross the faces of cells, kinks of the field, cost accuracy.
        assert found == pytest.approx(central_difference(shifted, 1e-3), rel=2e-2)
