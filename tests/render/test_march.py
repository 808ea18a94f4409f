"""The march against closed forms and a float64 reference."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import small_fields as small
from helpers.kernels import nothing_compiled
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerfattack.fields import GridField, GridLayout, Occupancy
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays

pytestmark = pytest.mark.usefixtures("variant")

SIGMA = 0.7
quick = settings(max_examples=20)


def along_x(
    field, pose: Pose | None = None, x: float = -3.0, stop: float = 0.0, **kwargs
) -> March:
    """March one ray from (x, 0.1, 0.2) along +x."""
    origin, direction = mi.Point3f(x, 0.1, 0.2), mi.Vector3f(1, 0, 0)
    dr.make_opaque(origin, direction)
    posed = PosedField(field, pose)
    return march(*small.arguments(posed, origin, direction, **kwargs), stop)


def slab(near: float, length: float, sigma: float = SIGMA) -> tuple[float, float]:
    """Return opacity and expected depth of a homogeneous slab, from its integral."""
    passed = np.exp(-sigma * length)
    opacity = 1 - passed
    return opacity, near + 1 / sigma - length * passed / opacity


def rotation(angles: np.ndarray) -> np.ndarray:
    """Return a rotation about z, then y, then x."""
    (ca, cb, cc), (sa, sb, sc) = np.cos(angles), np.sin(angles)
    z = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]])
    y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    x = np.array([[1, 0, 0], [0, cc, -sc], [0, sc, cc]])
    return x @ y @ z


# Closed forms


@pytest.mark.parametrize(
    ("start", "t_max", "near", "length"),
    [
        pytest.param(-3, 10, 2, 2, id="from outside"),
        pytest.param(-0.25, 10, 0, 1.25, id="from inside"),
        pytest.param(-3, 2.5, 2, 0.5, id="cut by t_max"),
        pytest.param(-0.25, 0.5, 0, 0.5, id="inside, cut by t_max"),
        pytest.param(-1, 10, 0, 2, id="from the face"),
    ],
)
@pytest.mark.parametrize("jitter", [0.0, 0.5, 0.999])
def test_slab(start, t_max, near, length, jitter) -> None:
    seen = along_x(small.homogeneous(SIGMA), x=start, t_max=t_max, jitter=jitter)
    opacity, depth = slab(near, length)
    colour = small.sigmoid_to_linear(np.array(0.3))
    assert seen.opacity[0] == pytest.approx(opacity, rel=1e-4)
    np.testing.assert_allclose(seen.radiance.numpy(), opacity * colour, rtol=2e-4)
    # A sample stands at jitter, the mean of its short interval near the middle.
    offset = (jitter - 0.5) * 0.01
    assert seen.depth[0] == pytest.approx(depth + offset, abs=2e-4)


@pytest.mark.parametrize(
    "kwargs",
    [
        pytest.param({"x": 1.5}, id="box behind"),
        pytest.param({"t_max": 1.9}, id="ends before the box"),
        pytest.param({"t_max": 0.0}, id="empty ray"),
        pytest.param({"pose": Pose.upright((0, 5, 0), 0.0)}, id="beside"),
    ],
)
def test_rays_that_miss_are_empty_and_infinitely_far(kwargs) -> None:
    seen = along_x(small.homogeneous(), **kwargs)
    assert seen.opacity[0] == 0 and seen.depth[0] == np.inf
    assert (seen.radiance.numpy() == 0).all() and seen.moment[0] == 0


def test_masked_rays_are_empty() -> None:
    origin = mi.Point3f([-3, -3], 0, 0)
    rays = Rays(origin, mi.Vector3f(1, 0, 0), active=mi.Bool([True, False]))
    seen = march(PosedField(small.homogeneous()), rays)
    assert seen.opacity[0] > 0.7 and seen.opacity[1] == 0


def test_empty_march_has_the_asked_width() -> None:
    empty = March.zeros(3)
    assert dr.width(empty.radiance) == dr.width(empty.depth) == 3
    assert (empty.depth.numpy() == np.inf).all()


def test_opaque_box_shows_its_face() -> None:
    seen = along_x(small.homogeneous(5000.0))
    colour = small.sigmoid_to_linear(np.array(0.3))
    assert seen.opacity[0] == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(seen.radiance.numpy(), colour, rtol=1e-4)
    assert seen.depth[0] == pytest.approx(2, abs=0.01)


@quick
@given(
    scale=st.floats(0.3, 3),
    angles=st.tuples(*[st.floats(-3, 3)] * 3),
    seed=st.integers(0, 9),
)
def test_any_pose_against_the_float64_reference(scale, angles, seed) -> None:
    rng = np.random.default_rng(seed)
    field = small.blob(rng)
    pose = Pose(rotation(np.array(angles)), np.array([0.2, 0.1, -0.1]), scale)
    o, d, origin, direction = small.fan(rng, 2)
    seen = march(*small.arguments(PosedField(field, pose), o, d), 0.0)
    for k in range(2):
        colour, opacity, moment = small.reference_march(
            field, pose, origin[k], direction[k], 10.0, 2000
        )
        # The midpoint rule errs by (step / blob)^2.
        assert seen.opacity[k] == pytest.approx(opacity, rel=5e-3, abs=1e-4)
        assert seen.moment[k] == pytest.approx(moment, rel=5e-3, abs=1e-3)
        found = seen.radiance.numpy()[:, k]
        np.testing.assert_allclose(found, colour, rtol=1e-2, atol=1e-4)


def test_small_steps_far_away_are_not_cut_off() -> None:
    field = small.homogeneous(SIGMA)
    field.step_m = 1e-4
    seen = along_x(field, x=-51, t_max=100)
    assert seen.opacity[0] == pytest.approx(slab(50, 2)[0], rel=1e-3)


# Lattice and poses


@quick
@given(
    cone=st.sampled_from([0.0, 1 / 256, 1 / 64, 0.1]),
    step=st.floats(1e-3, 0.5),
    scale=st.floats(0.1, 10),
)
def test_lattice_and_its_inverse(cone, step, scale) -> None:
    field = small.small_ngp(cone=cone)
    field.step_m = step
    posed = PosedField(field, Pose.upright((0, 0, 0), 0, scale))
    index = mi.Float([0.0, 1.0, 2.5, 10.0, 40.0, 100.0])
    t = posed.lattice(index)
    np.testing.assert_allclose(posed.lattice_index(t), index, rtol=2e-4, atol=1e-3)
    assert (np.diff(t.numpy()) > 0).all() and t[0] == 0


def test_lattice_grows_with_the_cone() -> None:
    field = small.small_ngp(cone=0.1)
    posed = PosedField(field)
    # uniform up to step / cone = 0.8 m after 10 steps, then times exp(0.1) a step
    t = posed.lattice(mi.Float([0, 5, 10, 11, 20])).numpy()
    expected = [0, 0.4, 0.8, 0.8 * np.exp(0.1), 0.8 * np.e]
    np.testing.assert_allclose(t, expected, rtol=1e-5)


def test_cone_takes_coarser_steps_but_sees_the_same_slab() -> None:
    field = small.homogeneous(SIGMA)
    field.cone = 1 / 32
    seen = along_x(field, x=-10, t_max=30)
    opacity, depth = slab(9, 2)
    assert seen.opacity[0] == pytest.approx(opacity, rel=1e-4)
    assert seen.depth[0] == pytest.approx(depth, abs=0.02)


def test_pose_from_matrix() -> None:
    turn = rotation(np.array([0.3, -0.7, 1.1]))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * turn, [1, 2, 3]
    pose = Pose.from_matrix(matrix)
    assert pose.scale == pytest.approx(2.5)
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-12)
    np.testing.assert_array_equal(pose.translation, [1, 2, 3])


@pytest.mark.parametrize(
    ("block", "message"),
    [
        (np.diag([1.0, 1, 2]), "expected a 3x3 rotation"),
        (np.diag([1.0, 1, -1]), "expected a 3x3 rotation"),
        (np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "expected a 3x3 rotation"),
        (np.zeros((3, 3)), "is singular"),
        (np.full((3, 3), np.nan), "is singular"),
    ],
)
def test_pose_refuses_other_matrices(block: np.ndarray, message: str) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = block
    with pytest.raises(ValueError, match=message):
        Pose.from_matrix(matrix)


def test_pose_refuses_a_transposed_matrix() -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = [1, 2, 3]
    with pytest.raises(ValueError, match=r"last row \[1.0, 2.0, 3.0, 1.0\]; must be"):
        Pose.from_matrix(matrix.T)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf, np.nan])
def test_pose_refuses_other_scales(scale: float) -> None:
    with pytest.raises(ValueError, match="scale: .*must be positive and finite"):
        Pose(np.eye(3), np.zeros(3), scale)


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


def test_empty_occupancy_hides_the_field() -> None:
    field = small.homogeneous()
    field.occupy(Occupancy(np.zeros((4, 4, 4), bool)))
    assert along_x(field).opacity[0] == 0


def test_density_falls_to_zero_in_empty_cells() -> None:
    field = small.homogeneous(SIGMA)
    cells = np.zeros((4, 4, 4), bool)
    cells[2] = True  # 0 <= x < 0.5
    field.occupy(Occupancy(cells))
    # The factor, t^4 over a 16th of the cell on either side, takes a tenth away.
    opacity, depth = slab(3.025, 0.45)
    seen = along_x(field)
    assert seen.opacity[0] == pytest.approx(opacity, abs=SIGMA * 0.01)
    assert seen.depth[0] == pytest.approx(depth, abs=0.01)


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


def test_the_sky_turns_with_its_field() -> None:
    field = small.small_ngp()
    turned = PosedField(field, Pose.upright((5, 1, 0), np.pi / 2, 2.0))
    # A quarter turn to the left brings what lay at +x to +y.
    found = turned.background(mi.Vector3f(0, 0.8, 0.6)).numpy()
    expected = field.background(mi.Vector3f(0.8, 0, 0.6)).numpy()
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(found, expected, rtol=1e-4)
