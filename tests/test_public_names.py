"""What packages offer, and what stays unloaded until somebody asks for it."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import mi_nerfattack as nf

ROOT = Path(__file__).parents[1]
PACKAGES = sorted(
    path.parent.name
    for path in (ROOT / "mi_nerfattack").glob("*/__init__.py")
    if path.parent.name != "commands"
)
IMPORTING = """
import sys, mitsuba
known = {*sys.modules, *sys.stdlib_module_names}

def roots():
    found = {name.split(".")[0] for name in set(sys.modules) - known}
    return sorted(found - {"mitsuba", "drjit"} - sys.stdlib_module_names)

import mi_nerfattack
print(*roots())
mitsuba.set_variant("llvm_ad_rgb")
print(*roots())
"""
RENDERING = """
import sys
import mi_nerfattack.deploy
import mi_nerfattack.render
import mi_nerfattack.vehicle
import mi_nerfattack.backend
mi_nerfattack.backend.ensure()
import mitsuba as mi
import numpy as np
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.render import from_fov

field = GridField(GridLayout(2, 4, 8), -np.ones(3), np.ones(3), step_m=0.1)
field.set_parameter("density", np.full(field.n_vertices, 3.0, np.float32))
save_field(sys.argv[1], field)
grid = {"type": "grid_field", "filename": sys.argv[1]}
film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "rgba"}
pose = mi.ScalarTransform4f().look_at([-4, 0, 0], [0, 0, 0], [0, 0, 1])
scene = {
    "type": "scene",
    "integrator": {"type": "field_integrator", "object": grid},
    "sensor": {"type": "perspective", "fov": 10, "film": film, "to_world": pose},
}
image = np.array(mi.render(mi.load_dict(scene, parallel=False), spp=1))
assert image[2, 2, 3] > 0.9, image
assert from_fov(4, 4, 90.0).width == 4
print(*sys.modules)
"""


@pytest.mark.parametrize("part", PACKAGES)
def test_all_public_names_resolve(part):
    package = import_module(f"mi_nerfattack.{part}")
    folder = Path(package.__file__ or "").parent
    assert package.__all__ and set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        assert getattr(package, name) is not None
        # a module of that name would hide it as soon as it is loaded
        assert not (folder / f"{name}.py").exists() and not (folder / name).exists()
    with pytest.raises(AttributeError, match="nothing"):
        _ = package.nothing


def test_names_of_the_whole_package_resolve():
    for name in nf.__all__:
        assert getattr(nf, name) is not None
        # a part of that name would hide it as soon as it is loaded
        assert name not in (*PACKAGES, "cli", "errors", "notebook", "ranges")
    script = {"ClosedLoop", "Rollout", "NoGoal", "bundled", "progress", "Run"}
    assert script | {"attack_policy", "evaluate_policy"} <= set(nf.__all__)
    assert import_module("mi_nerfattack.attack") is nf.attack  # a package
    with pytest.raises(AttributeError, match="nothing"):
        _ = nf.nothing


def test_rendering_loads_neither_policies_nor_other_worlds(tmp_path):
    command = [sys.executable, "-c", RENDERING, str(tmp_path / "a.safetensors")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert "mi_nerfattack.render.camera.intrinsics" in loaded
    assert not loaded & {"torch", "mujoco", "gymnasium", "pydantic", "matplotlib"}


def test_an_import_adds_little_to_that_of_mitsuba():
    """Installed are packages that Mitsuba brings, and three small ones."""
    command = [sys.executable, "-c", IMPORTING]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    alone, with_variant = (set(line.split()) for line in done.stdout.splitlines())
    assert alone == {"lazy_loader", "mi_nerfattack"}
    small = {"PIL", "threadpoolctl", "tomli"}  # the last before Python 3.11
    assert {"mi_nerfattack", "numpy"} <= with_variant <= alone | small | {"numpy"}


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs").rglob("*.md")), ids=lambda path: path.stem
)
def test_what_the_documentation_imports_is_there(path):
    imports = r"^from mi_nerfattack\S* import (?:\([^)]*\)|.+)$"
    for line in re.findall(imports, path.read_text("utf-8"), re.MULTILINE):
        exec(line, {})
