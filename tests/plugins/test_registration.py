"""Registration of the plugins: imports in any order, variants, entry points."""

from __future__ import annotations

import importlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import pytest

import mi_nerfattack.plugins
from mi_nerfattack.backend import llvm
from mi_nerfattack.backend import variant as variants
from mi_nerfattack.errors import SetupError
from mi_nerfattack.fields import GridField, GridLayout, save_field

ROOT = Path(__file__).parents[2]
USE = """
import sys
def use():
    field = {"type": "grid_field", "filename": sys.argv[1]}
    lamp = {"type": "field_emitter", "field": field}
    film = {"type": "hdrfilm", "width": 3, "height": 2, "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "field_integrator", "field": field},
        "sensor": {"type": "opencv_camera", "fx": 2, "film": film},
        "box": {"type": "cube", "emitter": lamp},
    }, parallel=False)
    print(mi.variant(), mi.render(scene, spp=1).shape[2])
"""
OURS, MITSUBA = "import mi_nerfattack\n", "import mitsuba as mi\n"
SET = 'mi.set_variant("llvm_ad_rgb")\n'
THEIRS = "import mitransient\n"  # asks for a variant first
BOTH = 'assert "Transient" in str(type(mi.load_dict({"type": "transient_path"})))\n'
ORDERS = {
    "ours first": OURS + MITSUBA + SET,
    "mitsuba first": MITSUBA + OURS + SET,
    "variant first": MITSUBA + SET + OURS,
    "drjit first": "import drjit\n" + OURS + MITSUBA + SET,
    "before another package": OURS + MITSUBA + SET + THEIRS + BOTH,
    "after another package": MITSUBA + SET + THEIRS + OURS + BOTH,
    "ours again, and Mitsuba only looked for": """
import importlib.util
import mi_nerfattack
importlib.reload(mi_nerfattack)
assert importlib.util.find_spec("mitsuba").name == "mitsuba"
assert "mitsuba" not in sys.modules and "drjit" not in sys.modules
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
importlib.reload(mi_nerfattack)
""",
    "after an import that failed": """
import mi_nerfattack
class Finder:
    def find_spec(name, *_):
        if name == "drjit":
            raise ImportError("not this time")
sys.meta_path.insert(0, Finder)
try:
    import mitsuba as mi
except ImportError:
    sys.meta_path.remove(Finder)
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
""",
    "in a fork": "import os\n"
    + OURS
    + "if os.fork():\n    sys.exit(os.wait()[1])\n"
    + MITSUBA
    + SET,
    "through every variant": """
import mi_nerfattack
import mitsuba as mi
for name in ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_spectral",
             "scalar_spectral_polarized", "llvm_ad_mono_polarized", "llvm_ad_rgb"):
    mi.set_variant(name)
    if name.startswith("llvm") and not name.endswith("polarized"):
        use()
import importlib, mi_nerfattack.plugins
importlib.reload(mi_nerfattack.plugins)
""",
}
SPAWN = """
import multiprocessing
context = multiprocessing.get_context("spawn")
process = context.Process(target=exec, args=({code!r}, {{}}))
process.start()
process.join()
sys.exit(process.exitcode)
"""
ORDERS["in a process"] = OURS + SPAWN.format(code=USE + ORDERS["ours first"] + "use()")
RGB, MONO = "llvm_ad_rgb 3", "llvm_ad_mono 1"
SPECTRAL = "llvm_ad_spectral 3"
PRINTED = {"through every variant": [RGB, MONO, SPECTRAL, RGB, RGB]}
# Mitsuba 3.10 finds plugins by entry points. Of those of another package, as it would
# be with Mitsuba 3.10, one comes before ours.
ENTRY_POINTS = """\
[mitsuba]
a_films = mitransient.films
z_integrators = mitransient.integrators
"""
DISCOVERED = """
import mitsuba as mi
from support.worlds.mitsuba_310 import Discovery
Discovery(callbacks_first={first})
for name in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(name)
    use()
    {then}
"""
CLEARED = "mi.detail.clear_variant_callbacks()"
REFUSED = [
    name
    for name in mi.variants()
    if "_ad_" not in name or name.endswith("_polarized")
    if not name.startswith("cuda")
]
PLUGINS = {
    "volume": ("grid_field", "ngp_field", "brick_field", "splat_background"),
    "emitter": ("field_emitter",),
    "integrator": ("field_integrator",),
    "sensor": ("opencv_camera",),
}


def run(folder: Path, code: str, **variables: str) -> tuple[list[str], str]:
    """Run a script that can use a field; return what it printed, and its errors."""
    path = folder / "field.safetensors"
    save_field(path, GridField(GridLayout(1, 2, 2), [-1, -1, -1], [1, 1, 1]))
    environment = {**os.environ, llvm.VARIABLE: str(llvm.locate().path), **variables}
    done = subprocess.run(
        [sys.executable, "-c", USE + code, str(path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    # Mitsuba prints its warnings there too: the film changes its pixel format.
    printed = re.findall(r"llvm_ad_\w+ \d+$", done.stdout, re.MULTILINE)
    assert "not registered" not in done.stderr
    return printed, done.stderr if done.returncode else ""


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("order", ORDERS)
def test_plugins_are_there_in_any_order(tmp_path: Path, order: str) -> None:
    printed, error = run(tmp_path, ORDERS[order] + "use()")
    assert not error and printed == PRINTED.get(order, [RGB])


def discover(folder: Path, code: str, **variables: str) -> tuple[list[str], str]:
    """Run a script in which only Mitsuba imports our package, if nothing else does."""
    info = folder / "other-1.0.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    places = map(str, (ROOT, ROOT / "tests", folder))
    return run(folder, code, PYTHONPATH=os.pathsep.join(places), **variables)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("then", [BOTH, CLEARED], ids=["others", "cleared"])
def test_entry_points_are_found_in_every_variant(tmp_path, first, then: str) -> None:
    printed, error = discover(tmp_path, DISCOVERED.format(first=first, then=then))
    assert not error and printed == [RGB, SPECTRAL, MONO, RGB]


@pytest.mark.usefixtures("variant")
def test_without_the_search_an_import_registers_the_plugins(tmp_path: Path) -> None:
    code = DISCOVERED.format(first=False, then="")
    printed, error = discover(tmp_path, OURS + code, MI_DISABLE_AUTOLOAD="1")
    assert not error and len(printed) == 4
    _, error = discover(tmp_path, code, MI_DISABLE_AUTOLOAD="1")
    assert '" not found' in error


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.usefixtures("no_variant_left")
def test_other_variants_say_which_to_use(name: str) -> None:
    mi.set_variant(name)
    for kind, plugins in PLUGINS.items():
        if name == "scalar_rgb" and kind == "volume":
            continue  # cannot be registered there
        for plugin in plugins:
            message = f"{plugin}: variant {name} .* llvm_ad_rgb, .*llvm_ad_spectral"
            text = f'<{kind} version="3.0.0" type="{plugin}"/>'
            with pytest.raises(RuntimeError, match=message):
                mi.load_string(text, parallel=False)
            with pytest.raises(RuntimeError, match=message):
                mi.load_dict({"type": plugin}, parallel=False)


def test_metal_is_refused_with_its_reason(monkeypatch):
    made = {}
    for kind in ("texture", "emitter", "integrator", "sensor"):
        monkeypatch.setattr(mi, f"register_{kind}", made.__setitem__)
    monkeypatch.setattr(mi, "variant", lambda: "metal_ad_rgb")
    importlib.reload(mi_nerfattack.plugins)
    assert set(made) == {name for names in PLUGINS.values() for name in names}
    for name, make in made.items():
        message = f"{name}: variant metal_ad_rgb is untried.* llvm_ad_rgb"
        with pytest.raises(SetupError, match=message):
            make(None)


def test_an_interrupt_waits_until_the_plugins_are_registered(monkeypatch):
    reached = []

    def set_variant(name: str) -> None:
        signal.raise_signal(signal.SIGINT)
        reached.append(name)

    monkeypatch.setattr(mi, "variant", lambda: None)
    monkeypatch.setattr(mi, "set_variant", set_variant)
    monkeypatch.delenv(variants.VARIABLE, raising=False)
    with pytest.raises(KeyboardInterrupt):
        variants.ensure()
    assert reached == ["llvm_ad_rgb"]
