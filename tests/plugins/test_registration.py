"""Registration of the plugins: order of imports, changes of variant."""

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

USE = """
import sys
def use():
    for kind in ("volume", "emitter", "integrator"):
        inner = {"type": "grid_field", "filename": sys.argv[1]}
        outer = {
            "volume": inner,
            "emitter": {"type": "sphere", "e": {"type": "field_emitter", "a": inner}},
            "integrator": {"type": "field_integrator", "a": inner},
        }[kind]
        mi.load_dict(outer, parallel=False)
    image = mi.render(mi.load_dict({
        "type": "scene", "i": outer,
        "s": {"type": "perspective", "f": {
            "type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}}},
    }, parallel=False), spp=1)
    print(mi.variant(), image.shape[2])
"""
ORDERS = {
    "ours first": """
import mi_nerfattack
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
use()
""",
    "mitsuba first": """
import mitsuba as mi
import mi_nerfattack
mi.set_variant("llvm_ad_rgb")
use()
""",
    "variant first": """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mi_nerfattack
use()
""",
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
use()
""",
}
RGB, MONO = "llvm_ad_rgb 3", "llvm_ad_mono 1"
SPECTRAL = "llvm_ad_spectral 3"
PRINTED = {"through every variant": [RGB, MONO, SPECTRAL, RGB, RGB]}
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


@pytest.fixture
def field(tmp_path: Path, variant: str) -> Path:
    path = tmp_path / "field.safetensors"
    save_field(path, GridField(GridLayout(1, 2, 2), [-1, -1, -1], [1, 1, 1]))
    return path


@pytest.mark.parametrize("order", ORDERS)
def test_plugins_are_there_in_any_order(field: Path, order: str) -> None:
    library = llvm.locate().path
    environment = dict(os.environ)
    if library is not None:
        environment[llvm.VARIABLE] = str(library)
    done = subprocess.run(
        [sys.executable, "-c", USE + ORDERS[order], str(field)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    # Mitsuba prints its warnings there too: the film changes its pixel format.
    printed = re.findall(r"llvm_ad_\w+ \d+$", done.stdout, re.MULTILINE)
    assert printed == PRINTED.get(order, [RGB])
    assert "not registered" not in done.stderr


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
