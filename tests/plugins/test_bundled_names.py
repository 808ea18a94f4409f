"""Scene files name bundled fields as commands and scenarios do."""

from __future__ import annotations

import hashlib

import mitsuba as mi
import pytest

from mi_nerfattack.scenario.named_file import NamedFile
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

SCENE = """<scene version="3.0.0">
    <integrator type="field_integrator">
        <volume type="grid_field">
            <string name="filename" value="{}"/>
        </volume>
    </integrator>
</scene>
"""


def test_a_scene_file_names_a_bundled_field(tmp_path) -> None:
    path, name = tmp_path / "scene.xml", "cube/field.safetensors"
    shown = []
    for value in (f"bundled:{name}", bundled(name)):
        path.write_text(SCENE.format(value))
        (volume,) = mi.load_file(str(path)).integrator().volumes
        shown.append(volume.to_string())
    assert shown[0] == shown[1]


def test_what_is_not_bundled_is_said(tmp_path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format("bundled:nothing.safetensors"))
    with pytest.raises(RuntimeError, match="nothing.safetensors: not a bundled file"):
        mi.load_file(str(path))


def test_the_digest_of_a_scene_file_covers_bundled_fields(tmp_path) -> None:
    path, name = tmp_path / "scene.xml", "cube/field.safetensors"
    path.write_text(SCENE.format(f"bundled:{name}"))
    expected = hashlib.sha256(path.read_bytes())
    expected.update(hashlib.sha256(bundled(name).read_bytes()).digest())
    assert NamedFile("scene.xml", path).content()["sha256"] == expected.hexdigest()
