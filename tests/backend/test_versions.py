"""The versions that results depend on: our own code is one."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

import mi_nerfattack
from mi_nerfattack.backend.versions import digest_code, versions
from mi_nerfattack.errors import SetupError

PACKAGE = Path(mi_nerfattack.__file__).parent


@pytest.mark.usefixtures("variant")
def test_our_own_code_is_a_version(tmp_path):
    """The same in a checkout and where it is installed, with two folders inside."""
    assert versions()["mi_nerfattack"] == mi_nerfattack.__version__
    there = tmp_path / "mi_nerfattack"
    shutil.copytree(PACKAGE, there, ignore=shutil.ignore_patterns("__pycache__"))
    places = {"": there}
    for name in ("plugins", "scenes"):
        places[name] = there / name
        shutil.copytree(PACKAGE.parent / name, there / name, dirs_exist_ok=True)
    assert versions()["source"] == digest_code(places)
    for name in ("plugins", "scenes", "rollout"):
        with (there / name / "__init__.py").open("a") as file:
            file.write("# changed\n")
        assert versions()["source"] != digest_code(places)
        shutil.copy(Path(find(name)), there / name / "__init__.py")
    assert versions()["source"] == digest_code(places)
    with pytest.raises(SetupError, match="has no Python files"):
        digest_code({"": tmp_path / "none"})


def find(name):
    spec = importlib.util.find_spec(f"mi_nerfattack.{name}")
    assert spec is not None and spec.origin is not None
    return spec.origin


def test_changed_code_is_another_version(tmp_path):
    """But for what only shows results."""
    for folder in ("deploy", "report"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("control = 1\n")
    first = digest_code({"": tmp_path})
    (tmp_path / "report" / "a.py").write_text("colour = 2\n")
    assert digest_code({"": tmp_path}) == first
    (tmp_path / "deploy" / "a.py").write_text("control = 0\n")
    assert digest_code({"": tmp_path}) != first
    (tmp_path / "deploy" / "a.py").write_text("control = 1\n")
    (tmp_path / "deploy" / "a.py").rename(tmp_path / "deploy" / "b.py")
    assert digest_code({"": tmp_path}) != first
