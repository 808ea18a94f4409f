"""Modules in the folder of a user's file: who finds them, and what counts."""

from __future__ import annotations

import sys

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.named_file import NamedFile
from mi_nerfattack.scenario.user_code import helper_files, load_function

USES = """\
import json
import parts.gain
from scale import factor
from .offset import OFFSET

def control(x):
    import late

    return factor() * x * parts.gain.GAIN + OFFSET + late.LATE
"""
FILES = {
    "uses.py": USES,
    "scale.py": "from parts import number\ndef factor(): return number.NUMBER\n",
    "offset.py": "OFFSET = 100\n",
    "late.py": "LATE = 1000\n",
    "parts/__init__.py": "from . import gain\n",
    "parts/gain.py": "from .number import NUMBER\nGAIN = 10 * NUMBER\n",
    "parts/number.py": "NUMBER = 2\n",
    "json.py": "raise ValueError",  # not in place of Python's own
    "unused.py": "raise ValueError",
}


def write(folder, **changes):
    for name, text in {**FILES, **changes}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder / "uses.py"


def test_a_file_and_its_helpers_import_each_other(tmp_path):
    path, before = write(tmp_path), list(sys.path)
    control = load_function(path, "control")
    assert control(1) == 2 * 20 + 100 + 1000
    assert sys.path == before and not {"scale", "parts", "late"} & set(sys.modules)
    assert not list(tmp_path.rglob("*.pyc"))
    names = ["late", "offset", "parts", "parts.gain", "parts.number", "scale"]
    assert sorted(helper_files(path)) == names


def test_helpers_of_one_name_in_two_folders(tmp_path):
    one = load_function(write(tmp_path / "one"), "control")
    changed = {"parts/number.py": "NUMBER = 3\n", "late.py": "LATE = 5000\n"}
    two = load_function(write(tmp_path / "two", **changed), "control")
    assert (one(1), two(1)) == (2 * 20 + 1100, 3 * 30 + 5100)
    # and of a file that was changed
    write(tmp_path / "one", **changed)
    assert load_function(tmp_path / "one/uses.py", "control")(1) == two(1)


def test_every_helper_counts_and_no_other_file(tmp_path):
    named = NamedFile("uses.py:control", write(tmp_path), "control")
    first = named.content()
    for name in FILES:
        write(tmp_path, **{name: f"{FILES[name]}# changed\n"})
        is_helper = name not in ("json.py", "unused.py")
        assert (named.content() != first) == is_helper, name
        write(tmp_path)
    assert named.content() == first


def test_what_a_package_offers_to_a_star_counts(tmp_path):
    star = "from parts import *\ndef control(x): return sub.NUMBER * x\n"
    files = {"uses.py": star, "parts/__init__.py": "__all__ = ['sub']\n"}
    path = write(tmp_path, **files, **{"parts/sub.py": "NUMBER = 7\n"})
    assert load_function(path, "control")(1) == 7
    named = NamedFile("uses.py:control", path, "control")
    before = named.content()
    write(tmp_path, **files, **{"parts/sub.py": "NUMBER = 8\n"})
    assert named.content() != before


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "parts/__init__.py",
            "import importlib as i\ni.import_module('.lost', __name__)\n",
            "ModuleNotFoundError: .*lost",
        ),
        ("scale.py", "import nowhere", "ModuleNotFoundError: .*'nowhere'; install it"),
        ("scale.py", "def (", r"uses.py: raised SyntaxError: .*scale.py, line 1"),
        ("uses.py", "from ..uses import f", "uses.py: raised ImportError"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, name, text, message):
    path = write(tmp_path, **{"parts/lost.py": "", name: text})
    with pytest.raises(InputError, match=message):
        load_function(path, "control")
