"""The march against closed forms and a float64 reference."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.reference.derivatives import nothing_compiled
from support.worlds import fields as small

from mi_nerfattack.fields import GridField, GridLayout, Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField, object_footprints
from mi_nerfattack.render.rays import March

pytestmark = pytest.mark.usefixtures("variant")

SIGMA = 0.7
quick = settings(max_examples=20)


def along_x(
    field, pose: Pose | None = None, x: float = -3.0, active: bool = True, **kwargs
) -> March:
    """March one ray from (x, 0.1, 0.2) along +x."""
    origin, direction = mi.Point3f(x, 0.1, 0.2), mi.Vector3f(1, 0, 0)
    dr.make_opaque(origin, direction)
    posed, rays = small.arguments(PosedField(field, pose), origin, direction, **kwargs)
    rays.active = mi.Bool(active)
    return march(posed, rays, 0.0)


def slab(near: float, length: float, sigma: float = SIGMA) -> tuple[float, float]:
    """Return opacity and expected depth of a homogeneous slab, from its integral."""
    passed = np.exp(-sigma * length)
    opacity = 1 - passed
    return opacity, near + 1 / sigma - length * passed / opacity


# Closed forms


@pytest.mark.parametrize(
    ("start", "t_max", "near", "length", "jitter"),
    [
        pytest.param(-3, 10, 2, 2, 0.0, id="from outside"),
        pytest.param(-3, 2.5, 2, 0.5, 0.999, id="cut by t_max"),
        pytest.param(-0.25, 0.5, 0, 0.5, 0.5, id="inside, cut by t_max"),
        pytest.param(-1, 10, 0, 2, 0.999, id="from the face"),
    ],
)
def test_slab(start, t_max, near, length, jitter) -> None:
    integrals = along_x(small.homogeneous(SIGMA), x=start, t_max=t_max, jitter=jitter)
    opacity, depth = slab(near, length)
    colour = small.sigmoid_to_linear(np.array(0.3))
    assert integrals.opacity[0] == pytest.approx(opacity, rel=1e-4)
    np.testing.assert_allclose(integrals.radiance.numpy(), opacity * colour, rtol=2e-4)
    # A sample stands at jitter, the mean of its short interval near the middle.
    offset = (jitter - 0.5) * 0.01
    assert integrals.depth[0] == pytest.approx(depth + offset, abs=2e-4)


@pytest.mark.parametrize(
    "kwargs",
    [
        pytest.param({"x": 1.5}, id="box behind"),
        pytest.param({"t_max": 1.9}, id="ends before the box"),
        pytest.param({"t_max": 0.0}, id="empty ray"),
        pytest.param({"pose": Pose.upright((0, 5, 0), 0.0)}, id="beside"),
        pytest.param({"active": False}, id="masked"),
    ],
)
def test_rays_that_miss_are_empty_and_infinitely_far(kwargs) -> None:
    integrals = along_x(small.homogeneous(), **kwargs)
    assert integrals.opacity[0] == 0 and integrals.depth[0] == np.inf
    assert (integrals.radiance.numpy() == 0).all() and integrals.moment[0] == 0


@quick
@given(
    scale=st.floats(0.3, 3),
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    seed=st.integers(0, 9),
)
def test_any_pose_against_the_float64_reference(scale, angles, seed) -> None:
    rng = np.random.default_rng(seed)
    field = small.blob(rng)
    turn = Rotation.from_euler("zyx", angles).as_matrix()
    pose = Pose(turn, np.array([0.2, 0.1, -0.1]), scale)
    o, d, origin, direction = small.fan(rng, 2)
    integrals = march(*small.arguments(PosedField(field, pose), o, d), 0.0)
    for k in range(2):
        colour, opacity, moment = small.reference_march(
            field, pose, origin[k], direction[k], 10.0, 2000
        )
        # The midpoint rule errs by (step / blob)^2.
        assert integrals.opacity[k] == pytest.approx(opacity, rel=5e-3, abs=1e-4)
        assert integrals.moment[k] == pytest.approx(moment, rel=5e-3, abs=1e-3)
        radiance = integrals.radiance.numpy()[:, k]
        np.testing.assert_allclose(radiance, colour, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize(
    ("sigma", "step", "cone", "near", "opacity_error", "depth_error"),
    [
        (SIGMA, 0.01, 1 / 32, 9, 1e-4, 0.02),
        (SIGMA, 1e-4, 0.0, 50, 1e-3, 0.02),
        (1e-4, 0.01, 0.0, 2, 1e-4, 2e-3),
        (50.0, 1e-3, 0.0, 2, 1e-4, 2e-3),
    ],
    ids=["growing steps", "many small steps", "thin", "opaque"],
)
def test_other_slabs(sigma, step, cone, near, opacity_error, depth_error) -> None:
    field = small.homogeneous(sigma)
    field.cone, field.step_m = cone, step
    integrals = along_x(field, x=-1 - near, t_max=100)
    opacity, depth = slab(near, 2, sigma)
    radiance = opacity * small.sigmoid_to_linear(np.array(0.3))
    assert integrals.opacity[0] == pytest.approx(opacity, rel=opacity_error)
    assert integrals.radiance.x[0] == pytest.approx(radiance, rel=opacity_error)
    assert integrals.depth[0] == pytest.approx(depth, abs=depth_error)


# Lattice and poses


def test_lattice_grows_with_the_cone() -> None:
    field = small.small_ngp(cone=0.1)
    posed = PosedField(field)
    # uniform up to step / cone = 0.8 m after 10 steps, then times exp(0.1) a step
    t = posed.lattice(mi.Float([0, 5, 10, 11, 20])).numpy()
    expected = [0, 0.4, 0.8, 0.8 * np.exp(0.1), 0.8 * np.e]
    np.testing.assert_allclose(t, expected, rtol=1e-5)
    back = posed.lattice_index(mi.Float(t)).numpy()
    np.testing.assert_allclose(back, [0, 5, 10, 11, 20], rtol=2e-4, atol=1e-3)


def test_a_transform_that_changes_is_followed() -> None:
    posed = PosedField(small.homogeneous(SIGMA))
    posed.move(np.array([0, 9.0, 0, 0, 0, 0]))
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[0, 3] = 0.5
    mi.set_property(posed.to_world, mi.AffineTransform4f(matrix))
    posed.follow("to_world")
    assert posed.pose.scale == pytest.approx(2) and not posed.offset.any()
    origin, direction = mi.Point3f(-5, 0.1, 0.2), mi.Vector3f(1, 0, 0)
    dr.make_opaque(origin, direction)
    integrals = march(*small.arguments(posed, origin, direction), 0.0)
    # twice as large from x = -1.5 on, and half as dense
    opacity, depth = slab(3.5, 4, SIGMA / 2)
    assert integrals.opacity[0] == pytest.approx(opacity, rel=1e-4)
    assert integrals.depth[0] == pytest.approx(depth, abs=2e-4)


def test_footprints_are_where_boxes_stand() -> None:
    corners = np.array([-1.0, -2, 0]), np.array([3.0, 4, 1])
    field = GridField(GridLayout(1, 4, 4), *corners)
    pose = Pose.upright((10, 20, 5), np.pi / 2, 2.0)  # (x, y) to (10 - 2 y, 20 + 2 x)
    (footprint,) = object_footprints([PosedField(field, pose)])
    np.testing.assert_allclose(footprint, [[14, 18], [14, 26], [2, 26], [2, 18]])


TRANSPOSED = np.eye(4)
TRANSPOSED[3, 0] = 1.0


@pytest.mark.parametrize(
    ("call", "fault"),
    [
        (lambda: Pose.from_matrix(np.diag([1.0, 1, -1, 1])), "3x3 rotation"),
        (lambda: Pose.from_matrix(TRANSPOSED), "last row"),
        (lambda: Pose.from_matrix(np.full((4, 4), np.nan)), "singular"),
        (lambda: Pose(np.eye(3), np.zeros(3), 0.0), "scale: "),
        (lambda: Pose(np.eye(3), np.zeros(3), np.nan), "scale: "),
    ],
)
def test_other_poses_are_refused(call, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        call()


# Skipping and stopping


def speck_rays(rng: np.random.Generator, pose: Pose) -> tuple[mi.Point3f, mi.Vector3f]:
    """Make 128 rays from all around, most of which meet the speck."""
    origin = rng.normal(size=(128, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    aim = 0.4 + rng.uniform(-0.2, 0.2, (128, 3))
    aim = aim @ pose.rotation.T * pose.scale + pose.translation - origin
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    o, d = [mi.Point3f(x.T.astype(np.float32).copy()) for x in (origin, aim)]
    return o, mi.Vector3f(d)


@pytest.mark.parametrize("cone", [0.0, 1 / 64])
@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
def test_skipping_empty_cells_changes_nothing(rng, cone: float, jitter: float) -> None:
    field = small.speck()
    field.cone = cone
    pose = Pose.upright((0.1, 0, 0), 0.4, 1.1)
    o, d = speck_rays(rng, pose)
    full = march(*small.arguments(PosedField(field, pose), o, d, jitter=jitter), stop=0)
    assert (full.opacity.numpy() > 0.1).mean() > 0.1
    # Density fades out within a vertex, 2 / 15, of the speck, and cells reach 1 / 30.
    centres = (np.stack(np.indices((30, 30, 30)), -1) + 0.5) / 15 - 1
    field.occupy(Occupancy((np.abs(centres - 0.4) < 0.37).all(-1)))
    assert field.occupancy.fraction < 0.1
    skipped = march(
        *small.arguments(PosedField(field, pose), o, d, jitter=jitter), stop=0
    )
    for name in ("opacity", "moment", "radiance"):
        a, b = getattr(full, name).numpy(), getattr(skipped, name).numpy()
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-6)


def test_density_falls_to_zero_in_empty_cells() -> None:
    field = small.homogeneous(SIGMA)
    cells = np.zeros((4, 4, 4), bool)
    cells[2] = True  # 0 <= x < 0.5
    field.occupy(Occupancy(cells))
    # The factor, t^4 over a 16th of the cell on either side, takes a tenth away.
    opacity, depth = slab(3.025, 0.45)
    integrals = along_x(field)
    assert integrals.opacity[0] == pytest.approx(opacity, abs=SIGMA * 0.01)
    assert integrals.depth[0] == pytest.approx(depth, abs=0.01)


# What is compiled


def test_other_poses_and_textures_compile_nothing(rng: np.random.Generator) -> None:
    field = GridField(GridLayout(1, 4, 4), -small.ONES, small.ONES)
    o, d, _, _ = small.fan(rng, 8)

    def look(x: float, yaw: float, scale: float) -> None:
        noise = rng.normal(size=(field.n_vertices, 3)).astype(np.float32)
        field.set_parameter("texture", noise)
        posed = PosedField(field, Pose.upright((x, 0, 0), yaw, scale))
        dr.eval(march(*small.arguments(posed, o, d)))

    look(0, 0, 1)
    with nothing_compiled():
        look(0.2, 0.3, 1.5)
        look(-0.7, 1.0, 0.9)
