"""Where large blocks are mapped, and where glibc is left alone."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import sys

import pytest
from helpers.heap import GLIBC, OWN

from mi_nerfattack.system.heap import map_large_blocks

CHILD = """
import mi_nerfattack
from helpers.heap import is_mapped
from mi_nerfattack import cli
before = is_mapped()
cli.main(["--version"])
print(before, is_mapped())
"""


@pytest.mark.skipif(not GLIBC, reason="only glibc has the threshold")
@pytest.mark.parametrize("own, mapped", [({}, True), ({OWN[0]: "1048576"}, False)])
def test_the_command_line_maps_large_blocks_and_an_import_does_not(own, mapped):
    """A threshold of the user's stays."""
    environment = {k: v for k, v in os.environ.items() if k not in OWN}
    environment |= own | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", CHILD]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == f"False {mapped}", done.stderr


@pytest.mark.parametrize(
    "library, variables",
    [
        (("", ""), {}),  # macOS, Windows
        (("musl", "1.2.5"), {}),
        (("glibc", "2.36"), {OWN[0]: "131072"}),
        (
            ("glibc", "2.36"),
            {OWN[1]: "glibc.malloc.perturb=1:glibc.malloc.mmap_threshold=9"},
        ),
    ],
)
def test_other_libraries_and_a_users_threshold_are_left_alone(
    library, variables, monkeypatch
):
    for name in OWN:
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(platform, "libc_ver", lambda: library)
    monkeypatch.setattr(ctypes, "CDLL", None)
    assert not map_large_blocks()
