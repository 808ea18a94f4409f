"""Optional packages: what declares them, what imports them, what refuses without."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mi_nerfattack.cli import main
from mi_nerfattack.commands import COMMANDS, PACKAGES, Command, Demo, each
from mi_nerfattack.extras import OPTIONAL, install_hint
from mi_nerfattack.io import files
from mi_nerfattack.system.doctor import DEVELOPER_EXTRAS
from tests.faults.jobs import JOBS, WRITERS
from tests.test_imports import PACKAGE, ROOT, SOURCES, part

PROJECT = files.read_toml(ROOT / "pyproject.toml")["project"]
EXTRAS = {
    name: [Requirement(line) for line in lines]
    for name, lines in PROJECT["optional-dependencies"].items()
}
CORE = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}
#: Names that Python imports, and what installs them where that has another name.
OTHER_NAMES = {
    "PIL": "pillow",
    "markupsafe": "jinja2",
    "pydantic_core": "pydantic",
    "serial": "pyserial",
    "typing_extensions": "pydantic",
}
WORDS = {kind: words for words, kind in each(COMMANDS)}
STARTS = (*WRITERS, *(job.words for job in JOBS.values()))
MONITOR = "car monitor absent --tracker vicon:127.0.0.1 --body car"
ROWS = [(kind, module) for kind, modules in PACKAGES.items() for module in modules]


def expanded(extra: str) -> Iterator[Requirement]:
    """Yield the requirements of an extra, those of the extras that it names too."""
    for item in EXTRAS[extra]:
        if item.name == PROJECT["name"]:
            for name in item.extras:
                yield from expanded(name)
        else:
            yield item


def names(requirements) -> set[str]:
    return {canonicalize_name(item.name) for item in requirements}


def distributions(modules) -> set[str]:
    return {canonicalize_name(OPTIONAL[name].distribution) for name in modules}


def test_extras_and_table_agree():
    combined = {"all", "demo", *DEVELOPER_EXTRAS}
    for extra in EXTRAS.keys() - combined:
        listed = [m for m, item in OPTIONAL.items() if item.extra == extra]
        own = [item for item in EXTRAS[extra] if item.name != PROJECT["name"]]
        assert names(own) == distributions(listed), extra
        assert not names(own) & CORE, extra
    assert {item.extra for item in OPTIONAL.values()} == EXTRAS.keys() - combined


def test_combined_extras_are_complete():
    assert names(expanded("all")) == distributions(OPTIONAL)
    assert distributions(PACKAGES[Demo]) <= names(expanded("demo"))
    # clusters and simulators that tests reach by their own doubles
    assert distributions(OPTIONAL) - names(expanded("test")) == {"carla", "ray"}


def roots(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """Yield the outermost name of each import, and whether `missing` guards it."""
    if isinstance(tree, ast.If) and ast.unparse(tree.test) == "TYPE_CHECKING":
        return
    guards = isinstance(tree, ast.Try) and any(
        "missing(" in ast.unparse(handler) for handler in tree.handlers
    )
    for child in ast.walk(tree) if guards else [tree]:
        if isinstance(child, ast.Import):
            yield from ((alias.name.split(".")[0], guards) for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and not child.level:
            yield (child.module or "").split(".")[0], guards
    for child in [] if guards else ast.iter_child_nodes(tree):
        yield from roots(child)


def required(name: str) -> set[str]:
    """Return the packages that a module's own package, or one around it, requires."""
    packages: set[str] = set()
    while name := name.rpartition(".")[0]:
        if name in SOURCES:
            text = SOURCES[name].read_text("utf-8")
            for words in re.findall(r"(?m)^require\((.*)\)$", text):
                packages |= set(re.findall(r'"(\w+)"', words))
    return packages


def test_each_import_is_declared_and_optional_ones_are_guarded():
    declared, optional = {*sys.stdlib_module_names, PACKAGE, "setuptools"}, 0
    for name, path in SOURCES.items():
        if part(name) == "bench":
            continue
        for root, is_guarded in roots(ast.parse(path.read_text("utf-8"))):
            if root in OPTIONAL:
                optional += 1
                assert is_guarded or root in required(name), f"{name}: {root}"
            elif root not in declared:
                distribution = canonicalize_name(OTHER_NAMES.get(root, root))
                assert distribution in CORE, f"{name}: {root}"
    assert optional > 50


def arguments(kind: type[Command]) -> list[str]:
    """Return words that start a command, up to the check of its packages."""
    words = WORDS[kind]
    for start in (*STARTS, MONITOR):
        start_words = start.format(scenes=ROOT / "scenes").split()
        if tuple(start_words[: len(words)]) == words:
            job = next((j for j in JOBS.values() if j.words == start), None)
            return [*start_words, *(job.options.split() if job else ())]
    raise AssertionError(words)


@pytest.mark.parametrize(
    ("kind", "module"), ROWS, ids=[f"{kind.__name__}-{name}" for kind, name in ROWS]
)
def test_a_command_refuses_without_its_package(
    kind, module, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for other in PACKAGES[kind]:  # which this machine need not have
        monkeypatch.setitem(sys.modules, other, sys)
    monkeypatch.setitem(sys.modules, module, None)
    assert main(arguments(kind)) == 2
    error = capsys.readouterr().err
    assert (
        f"{' '.join(WORDS[kind])} needs {module}, which cannot be imported; " in error
    )
    assert error.strip().endswith(install_hint(OPTIONAL[module].extra))
    assert list(tmp_path.iterdir()) == []


#: What else needs a package: code that refuses without it, from an empty folder.
USES = {
    "DracoPy": "load_extra('DracoPy', 'a mesh')",
    "av": "from mi_nerfattack.io.video import open_video; open_video(b'')",
    "carla": "from mi_nerfattack.deploy.carla.session import load_client; "
    "load_client()",
    "cv2": "from mi_nerfattack.capture.photographs.markers import detect_markers; "
    "detect_markers(None, '4x4_50')",
    "gymnasium": "import mi_nerfattack.deploy.gym",
    "lz4": "from mi_nerfattack.deploy.replay.ros2 import _unlz4; _unlz4(b'', 1)",
    "matplotlib": "import mi_nerfattack.report",
    "mcap": "from mi_nerfattack.deploy.replay.ros2 import _messages; "
    "next(_messages('a', b''))",
    "mcap_ros2": "from mi_nerfattack.deploy.replay.ros2 import decoder; decoder('b')",
    "motioncapture": "from mi_nerfattack.car import MotionCaptureTracker; "
    "MotionCaptureTracker('vicon', 'live')",
    "mujoco": "import mi_nerfattack.deploy.mujoco.vehicle",
    "onnx": "from mi_nerfattack.policy.onnx.network import load_onnx; load_onnx('a')",
    "optuna": "from types import SimpleNamespace; "
    "from mi_nerfattack.attack.black_box import BayesianSearch; "
    "BayesianSearch(SimpleNamespace(count=1))",
    "pandas": "import mi_nerfattack.drives",
    "pillow_heif": "from mi_nerfattack.io.files import image_formats; "
    "image_formats('a', b'    ftypheic')",
    "pycolmap": "from mi_nerfattack.capture.colmap import process; "
    "process._say = lambda missing: refuse(missing); process.run({})",
    "ray": "from mi_nerfattack.system.ray_tasks import RayTasks; "
    "RayTasks('local')._connect()",
    "skimage": "import numpy as np; from mi_nerfattack.fit.scores import compare; "
    "compare(np.zeros((9, 9, 3)), np.zeros((9, 9, 3)))",
    "submitit": "from pathlib import Path; from mi_nerfattack.system.slurm import "
    "SlurmJobs; SlurmJobs(Path(), None)._executor()",
    "trimesh": "from mi_nerfattack.capture.mesh.read import load_mesh; "
    "load_mesh('a.glb')",
    "viser": "from mi_nerfattack.experiment.view.page import serving; "
    "serving('127.0.0.1', 0).__enter__()",
    "zstandard": "from mi_nerfattack.deploy.replay.ros2 import _unzstd; "
    "_unzstd(b'', 1)",
}
BLOCKED = """
import json, sys
blocked, uses = json.loads(sys.argv[1]), json.loads(sys.argv[2])
for name in blocked:
    sys.modules[name] = None
import mi_nerfattack
import mitsuba as mi
from mi_nerfattack.cli import main
from mi_nerfattack.errors import SetupError
from mi_nerfattack.extras import load_extra

def refuse(message):
    raise SetupError(message)

mi.set_variant("llvm_ad_rgb")
assert main(["--help"]) == 0
size = "--size", "12", "8", "--spp", "1"
scene = "bundled:intersection/field.xml"
assert main(["render", "frame", scene, "-o", "a.png", *size]) == 0
errors = {}
for name, code in uses.items():
    if name == "viser":  # what leads to it needs these first
        del sys.modules["pandas"], sys.modules["matplotlib"]
    try:
        exec(code)
    except SetupError as error:
        errors[name] = str(error)
print(json.dumps(errors))
"""


def test_the_core_renders_without_any_and_each_use_refuses(tmp_path):
    assert USES.keys() == OPTIONAL.keys()
    later = dict(sorted(USES.items(), key=lambda item: item[0] == "viser"))
    words = json.dumps(list(OPTIONAL)), json.dumps(later)
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "usage: mi-nerfattack COMMAND" in done.stdout
    image = files.read_image(tmp_path / "a.png")  # of a street and a hydrant
    assert image.shape == (8, 12, 3) and len(np.unique(image)) > 100
    errors = json.loads(done.stdout.splitlines()[-1])
    assert errors.keys() == OPTIONAL.keys(), done.stdout
    for name, message in errors.items():
        assert f" needs {name}, " in message
        assert install_hint(OPTIONAL[name].extra) in message
