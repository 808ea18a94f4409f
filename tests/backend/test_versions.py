"""The versions that results depend on: our own code is one."""

from __future__ import annotations

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
    places = {"": there} | {name: there / name for name in ("plugins", "scenes")}
    for name in ("plugins", "scenes"):
        shutil.copytree(PACKAGE.parent / name, there / name, dirs_exist_ok=True)
    assert versions()["source"] == digest_code(places)
    for name in ("plugins", "scenes", "rollout"):
        file = there / name / "__init__.py"
        text = file.read_text()
        file.write_text(text + "# changed\n")
        assert versions()["source"] != digest_code(places)
        file.write_text(text)
    assert versions()["source"] == digest_code(places)
    with pytest.raises(SetupError, match="has no Python files"):
        digest_code({"": tmp_path / "none"})


def test_changed_code_is_another_version(tmp_path):
    """But for what only shows results."""
    for folder in ("deploy", "report"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("control = 1\n")
    first = digest_code({"": tmp_path})
    (tmp_path / "report" / "a.py").write_text("colour = 2\n")
    assert digest_code({"": tmp_path}) == first
    file = tmp_path / "deploy" / "a.py"
    file.write_text("control = 0\n")
    assert digest_code({"": tmp_path}) != first
    file.write_text("control = 1\n")
    file.rename(file.with_name("b.py"))
    assert digest_code({"": tmp_path}) != first
