"""Mitsuba 3.10 finds the plugins by their entry point, without an import of ours."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mi_nerfattack.backend import llvm
from mi_nerfattack.fields import GridField, GridLayout, save_field

ROOT = Path(__file__).parents[2]
VARIANTS = ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono"]
#: Another package, as it would be with Mitsuba 3.10: one module comes before ours.
OTHER = """\
[mitsuba]
a_films = mitransient.films
z_integrators = mitransient.integrators
"""
SCRIPT = """\
import sys
import mitsuba as mi
from helpers.mitsuba_310 import Discovery

discovery = Discovery(callbacks_first={callbacks_first})


def use(name):
    mi.set_variant(name)
    field = {{"type": "grid_field", "filename": sys.argv[1]}}
    box = {{"type": "cube", "emitter": {{"type": "field_emitter", "field": field}}}}
    film = {{"type": "hdrfilm", "width": 3, "height": 2}}
    scene = mi.load_dict({{
        "type": "scene",
        "integrator": {{"type": "field_integrator", "field": field}},
        "sensor": {{"type": "opencv_camera", "fx": 2, "film": film}},
        "box": box,
    }}, parallel=False)
    assert isinstance(scene.integrator(), mi.Integrator)
    image = mi.render(scene, spp=1)
    print("used", mi.variant(), *image.shape[:2])


{body}
"""
USE = "for name in sys.argv[2:]:\n    use(name)\n"
OTHERS = """
    other = mi.load_dict({"type": "transient_path", "max_depth": 3})
    assert type(other).__name__ == "TransientPath"
"""
CLEARED = USE.replace("use(name)", "use(name); mi.detail.clear_variant_callbacks()")


@pytest.fixture
def field(tmp_path: Path, variant: str) -> Path:
    path = tmp_path / "field.safetensors"
    save_field(path, GridField(GridLayout(1, 2, 2), [-1, -1, -1], [1, 1, 1]))
    return path


def run(
    field: Path, body: str, callbacks_first: bool = False, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a script in which only Mitsuba imports our package, if nothing else does."""
    info = field.parent / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(OTHER)
    places = map(str, (ROOT, ROOT / "tests", field.parent))
    environment |= os.environ | {"PYTHONPATH": os.pathsep.join(places)}
    environment |= {llvm.VARIABLE: str(llvm.locate().path)}
    script = SCRIPT.format(body=body, callbacks_first=callbacks_first)
    return subprocess.run(
        [sys.executable, "-c", script, str(field), *VARIANTS, VARIANTS[0]],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("callbacks_first", [False, True])
@pytest.mark.parametrize("body", [USE + OTHERS, CLEARED], ids=["others", "cleared"])
def test_plugins_are_found_in_every_variant(
    field: Path, body: str, callbacks_first: bool
) -> None:
    done = run(field, body, callbacks_first)
    assert done.returncode == 0, done.stderr
    # Mitsuba prints its warnings there too
    used = re.findall(r"used (\w+) 2 3$", done.stdout, re.MULTILINE)
    assert used == [*VARIANTS, VARIANTS[0]]
    assert "not registered" not in done.stderr


def test_without_the_search_an_import_registers_them(field: Path) -> None:
    done = run(field, "import mi_nerfattack\n" + USE, MI_DISABLE_AUTOLOAD="1")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("used") == 4


def test_without_the_search_and_an_import_they_are_unknown(field: Path) -> None:
    done = run(field, USE, MI_DISABLE_AUTOLOAD="1")
    assert done.returncode != 0 and '"grid_field" not found' in done.stderr
