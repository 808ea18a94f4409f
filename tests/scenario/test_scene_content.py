"""The digest of a Mitsuba scene changes with every file that the scene shows."""

from __future__ import annotations

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.named_file import NamedFile

pytestmark = pytest.mark.usefixtures("variant")

BITMAP = '<texture type="bitmap" id="t"><string name="filename" {}/></texture>'
WAYS = {
    "single quotes": ("t.png", BITMAP.format("value='t.png'")),
    "spaces": ("t.png", BITMAP.format('value  = "t.png"')),
    "line break": ("t.png", BITMAP.format('value=\n"t.png"')),
    "parameter": (
        "t.png",
        '<default name="what" value="t"/>' + BITMAP.format('value="$what.png"'),
    ),
    "entity": ("a&b.png", BITMAP.format('value="a&amp;b.png"')),
    "search path": ("in/t.png", '<path value="in"/>' + BITMAP.format('value="t.png"')),
    "included": ("t.png", '<include filename="inner.xml"/>'),
    "spectrum of a default of defaults": (
        "s.spd",
        '<default value="s" name="d"/><default value="$d.spd" name="s"/>'
        '<bsdf type="conductor" id="c"><spectrum name="eta" filename="$s"/></bsdf>',
    ),
    "spectrum with an entity": (
        "a&b.spd",
        '<bsdf type="conductor" id="c"><spectrum name="eta" filename="a&amp;b.spd"/>'
        "</bsdf>",
    ),
    "spectrum": (
        "s.spd",
        '<default name="s" value="s.spd"/><bsdf type="conductor" id="c">'
        '<spectrum name="eta" filename="$s"/></bsdf>',
    ),
    "comment that XML forbids": (
        "t.png",
        f"<!-- a -- b -->{BITMAP}".format("value='t.png'"),
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_changed_file_is_noticed(tmp_path, way):
    name, body = WAYS[way]
    named, scene = tmp_path / name, tmp_path / "scene.xml"
    named.parent.mkdir(exist_ok=True)
    inner = BITMAP.format("value='t.png'")
    (tmp_path / "inner.xml").write_text(f'<scene version="3.0.0">{inner}</scene>')
    scene.write_text(f"<scene version='3.0.0'>{body}</scene>")
    found = []
    for value in ("400 1\n700 1\n", "400 1\n700 2\n"):
        named.write_text(value)
        found.append(NamedFile("scene.xml", scene).content()["sha256"])
    assert found[0] != found[1]


def test_a_scene_that_cannot_be_read_is_refused(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text(
        "<scene version='3.0.0'><string name='filename' value='$t'/></scene>"
    )
    with pytest.raises(InputError, match=r"undefined parameter.*\$t.*<default>"):
        NamedFile("scene.xml", scene).content()
