"""What colours an attack may find, and a printer or monitor can show."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from PIL import ImageCms
from support.faults.refusals import refusals

from mi_nerfattack.attack.texture.colours import Colours
from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.attack.texture.gamut import Gamut
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.fields.occupancy import Occupancy

CORNERS = np.array(np.meshgrid([0.2, 0.7], [0.2, 0.7], [0.2, 0.7])).reshape(3, 8).T

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def field(rng):
    cells = np.zeros((4, 4, 4), bool)
    cells[1:3] = True  # the middle half along x
    layout = GridLayout(2, 4, 9)
    occupancy = Occupancy(cells)
    result = GridField(layout, -np.ones(3), np.ones(3), occupancy=occupancy)
    texture = rng.normal(0, 1, (result.n_vertices, 3)).astype(np.float32)
    result.set_parameter("texture", texture)
    return result


def colours(field, **constraints):
    return Colours(field, smoothing=0, constraints=Constraints(**constraints))


def far_off(mine, rng):
    return mine.start + rng.normal(0, 1, mine.start.shape).astype(np.float32)


def test_boxes_bound_every_value(field, rng):
    mine = colours(field, linf=0.1, lowest=0.2, highest=0.7)
    projected = mine.project(far_off(mine, rng))
    assert np.abs(projected - mine.start).max() <= 0.1 + 1e-6
    assert projected.min() >= 0.2 - 1e-6
    assert projected.max() <= 0.7 + 1e-6
    # the original is drawn into the range, and the picture shows it
    field.set_parameter("texture", mine.texture(mine.start))
    assert colours(field).start.min() >= 0.2 - 1e-4


def test_ball_bounds_the_mean_square_over_occupied_cells(field, rng):
    mine = colours(field, l2=0.05)
    projected = mine.project(far_off(mine, rng))
    n = mine.level.resolution
    change = (projected - mine.start).reshape(n, n, n, 3)[:, :, 2:7]  # z, y, x
    assert np.sqrt((change.astype(float) ** 2).mean()) == pytest.approx(0.05, rel=1e-4)
    near = mine.start + np.float32(0.001) * (mine.start < 0.5)
    np.testing.assert_array_equal(mine.project(near), near)


def test_fixed_regions_stay(field, rng):
    mine = colours(field, fixed=(((-1, -1, -1), (1, 1, 0.1)),))
    projected = mine.project(far_off(mine, rng)).clip(0.01, 0.99)
    n = mine.level.resolution
    changed = (projected != mine.start).reshape(n, n, n, 3).any(axis=(1, 2, 3))
    assert changed.tolist() == [False] * 6 + [True] * 3  # by z
    points = mi.Point3f(rng.uniform(-1, 0.1, (3, 200)).tolist())
    shown = []
    for value in (mine.start, projected):
        field.set_parameter("texture", mine.texture(value))
        looked = field.eval_everywhere(points, mi.Vector3f(0, 0, 1), mi.Bool(True))
        shown.append(np.array(looked[1]))
    np.testing.assert_array_equal(*shown)
    with pytest.raises(InputError, match=r"fixed: \(3, 3, 3\) to .*the object lies in"):
        colours(field, fixed=(((3, 3, 3), (4, 4, 4)),))


def test_penalty_is_the_variation_and_its_gradient_that_of_it(field, rng):
    mine = colours(field, total_variation=3.0)
    value = rng.uniform(0.2, 0.8, mine.start.shape)
    n = mine.level.resolution
    cube = value.reshape(n, n, n, 3)[:, :, 2:7]
    pairs = [np.abs(np.diff(cube, axis=axis)).ravel() for axis in range(3)]
    assert mine.penalty(value) == pytest.approx(3 * np.concatenate(pairs).mean(), 0.01)
    change = 1e-4 * rng.normal(size=value.shape)
    expected = (mine.penalty(value + change) - mine.penalty(value - change)) / 2
    nothing = np.zeros((field.n_vertices, 3))
    derivative = (mine.gradient(value, nothing) * change).sum()
    assert derivative == pytest.approx(expected, rel=1e-3)


test_what_allows_nothing_is_refused = refusals(
    (lambda: Constraints(lowest=0.6, highest=0.5), "lowest: 0.6, highest: 0.5"),
    (lambda: Constraints(lowest=0.5, highest=0.5), "expected lowest < highest"),
    (lambda: Constraints(lowest=0.995), r"0\.01"),
    (lambda: Constraints(highest=0.005), r"0\.01"),
    (lambda: Constraints(fixed=(((0, 0, 0), (1, 0, 1)),)), "fixed: "),
    (lambda: Constraints(linf=-0.1), r"constraints\.linf: -0\.1"),
    (lambda: Constraints(highest=0.4, gamut=Gamut(CORNERS)), r"0.4; .*\[0.45"),
)


def test_colours_are_drawn_into_the_hull(rng):
    gamut = Gamut(CORNERS)
    colours = rng.uniform(0, 1, (500, 3))
    drawn = gamut.draw(colours, gamut.centre)
    assert drawn.min() >= 0.2
    assert drawn.max() <= 0.7
    inside = ((colours >= 0.2) & (colours <= 0.7)).all(axis=1)
    assert 20 < inside.sum() < 480
    np.testing.assert_array_equal(drawn[inside], colours[inside])
    # what is outside ends on the border, on the way to the centre
    moved = drawn[~inside] - gamut.centre
    assert np.abs(moved).max(axis=1) == pytest.approx(0.25, abs=1e-3)
    assert np.cross(moved, colours[~inside] - gamut.centre) == pytest.approx(0)


def test_attacks_keep_to_the_gamut_and_to_other_constraints(variant, rng):
    field = GridField(GridLayout(1, 6, 6), -np.ones(3), np.ones(3))
    texture = rng.normal(0, 2, (field.n_vertices, 3)).astype(np.float32)
    field.set_parameter("texture", texture)  # mostly outside
    allowed = Constraints(linf=0.1, highest=0.6, gamut=Gamut(CORNERS))
    mine = Colours(field, constraints=allowed)
    projected = mine.project(mine.start + rng.normal(0, 1, mine.start.shape))
    for colours in (mine.start, projected):
        assert colours.min() >= 0.2
        assert colours.max() <= 0.6 + 1e-6
    change = np.abs(projected - mine.start)
    assert change.max() <= 0.1 + 1e-6
    assert np.median(change) > 0.01


def test_lists_of_colours_are_read_in_both_units(tmp_path):
    path = tmp_path / "patches.csv"
    for scale, form in ((1, "%.3f"), (255, "%.1f")):
        np.savetxt(path, scale * CORNERS, form, delimiter=",")
        assert Gamut.load(path).centre == pytest.approx(0.45, abs=1e-6)


def test_profile_of_srgb_holds_all_colours(tmp_path, rng):
    path = tmp_path / "monitor.icc"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    path.write_bytes(profile.tobytes())
    colours = rng.uniform(0.02, 0.98, (200, 3))
    gamut = Gamut.load(path)
    assert gamut.draw(colours, gamut.centre) == pytest.approx(colours)


LAB = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


@pytest.mark.parametrize(
    ("name", "content", "allowed"),
    [
        ("a.csv", b"0.1 0.2\n0.3 0.4\n", "three"),
        ("a.csv", b"red\n", "three numbers"),
        ("a.csv", b"0 0 300\n" * 5, "255"),
        ("a.csv", b"\xff\xfe", "three numbers"),
        ("a.csv", b"0 0 0\n0 0 1\n0 1 0\n0 1 1\n", "4 colours"),
        ("a.icc", b"not a profile", "ICC"),
        ("a.icc", LAB, "RGB"),
    ],
)
def test_what_is_no_gamut_is_refused(tmp_path, name, content, allowed):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=allowed) as refused:
        Gamut.load(tmp_path / name)
    assert refused.value.where == str(tmp_path / name)
