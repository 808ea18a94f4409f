"""The versions that results depend on: our own code is one."""

from __future__ import annotations

from pathlib import Path

import pytest

import mi_nerfattack
from mi_nerfattack.backend.versions import digest_code, versions

PACKAGE = Path(mi_nerfattack.__file__).parent


@pytest.mark.usefixtures("variant")
def test_our_own_code_is_a_version():
    plugins = PACKAGE.parent / "plugins"
    assert versions()["mi_nerfattack"] == mi_nerfattack.__version__
    assert versions()["source"] == digest_code([PACKAGE, plugins])
    assert versions()["source"] != digest_code([PACKAGE])


def test_changed_code_is_another_version(tmp_path):
    """But for what only shows results."""
    for folder in ("deploy", "report"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("control = 1\n")
    first = digest_code([tmp_path])
    (tmp_path / "report" / "a.py").write_text("colour = 2\n")
    assert digest_code([tmp_path]) == first
    (tmp_path / "deploy" / "a.py").write_text("control = 0\n")
    assert digest_code([tmp_path]) != first
    (tmp_path / "deploy" / "a.py").write_text("control = 1\n")
    (tmp_path / "deploy" / "a.py").rename(tmp_path / "deploy" / "b.py")
    assert digest_code([tmp_path]) != first
