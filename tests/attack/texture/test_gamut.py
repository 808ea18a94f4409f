"""Colours that a printer or monitor can show."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import ImageCms

from mi_nerfattack.attack.texture.constraints import Constraints
from mi_nerfattack.attack.texture.gamut import Gamut
from mi_nerfattack.errors import InputError

CORNERS = np.array(np.meshgrid([0.2, 0.7], [0.2, 0.7], [0.2, 0.7])).reshape(3, 8).T


def test_colours_are_drawn_into_the_hull(rng):
    gamut = Gamut(CORNERS)
    colours = rng.uniform(0, 1, (500, 3))
    found = gamut.draw(colours, gamut.centre)
    assert found.min() >= 0.2
    assert found.max() <= 0.7
    inside = ((colours >= 0.2) & (colours <= 0.7)).all(axis=1)
    assert 20 < inside.sum() < 480
    np.testing.assert_array_equal(found[inside], colours[inside])
    # what is outside ends on the border, on the way to the centre
    moved = found[~inside] - gamut.centre
    assert np.abs(moved).max(axis=1) == pytest.approx(0.25, abs=1e-3)
    assert np.cross(moved, colours[~inside] - gamut.centre) == pytest.approx(0)


def test_attacks_keep_to_the_gamut_and_to_other_constraints(variant, rng):
    from mi_nerfattack.attack.texture.colours import Colours
    from mi_nerfattack.fields import GridField, GridLayout

    field = GridField(GridLayout(1, 6, 6), -np.ones(3), np.ones(3))
    texture = rng.normal(0, 2, (field.n_vertices, 3)).astype(np.float32)
    field.set_parameter("texture", texture)  # mostly outside
    allowed = Constraints(linf=0.1, highest=0.6, gamut=Gamut(CORNERS))
    mine = Colours(field, constraints=allowed)
    found = mine.project(mine.start + rng.normal(0, 1, mine.start.shape))
    for colours in (mine.start, found):
        assert colours.min() >= 0.2
        assert colours.max() <= 0.6 + 1e-6
    change = np.abs(found - mine.start)
    assert change.max() <= 0.1 + 1e-6
    assert np.median(change) > 0.01
    with pytest.raises(InputError, match=r"highest: 0.4; the gamut's centre, \[0.45"):
        Constraints(highest=0.4, gamut=Gamut(CORNERS))


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


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"0.1 0.2\n0.3 0.4\n", "no list of colours; expected three"),
        ("a.csv", b"red\n", "red.*expected three numbers"),
        ("a.csv", b"0 0 300\n" * 5, "no list of colours"),
        ("a.csv", b"\xff\xfe", "expected three numbers"),
        ("a.csv", b"0 0 0\n0 0 1\n0 1 0\n0 1 1\n", "4 colours span no volume"),
        ("a.icc", b"not a profile", "no ICC profile of a device"),
    ],
)
def test_what_is_no_gamut_is_refused(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        Gamut.load(path)
    assert str(path) in str(caught.value)


def test_lab_profile_is_refused(tmp_path):
    path = tmp_path / "lab.icc"
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB"))
    path.write_bytes(profile.tobytes())
    with pytest.raises(InputError, match="a profile of L"):
        Gamut.load(path)
