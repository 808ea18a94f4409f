"""The examples in docs/loop.md run as they stand, and the script beside it."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.fields import load_grid
from mi_nerfattack.io.files import read_image
from mi_nerfattack.render.surroundings import nearest_surface
from mi_nerfattack.scenes import bundled

GUIDE = Path(__file__).parents[2] / "docs/loop.md"

pytestmark = pytest.mark.slow


def test_examples_run(tmp_path):
    text = GUIDE.read_text("utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    script = tmp_path / "guide.py"
    script.write_text("\n".join(blocks), "utf-8")
    result = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    first, second = result.stdout.splitlines()
    shape = r"\d+, 3"
    assert re.fullmatch(rf"\[-0\.\d+\] \({shape}\)", first), first
    assert re.fullmatch(rf"torch.Size\(\[{shape}\]\)", second), second


@pytest.mark.usefixtures("variant")
def test_scene_is_attacked_from_xml(monkeypatch, capsys):
    """Both textures move, and the script says whether the failure transfers."""
    monkeypatch.setattr(sys, "argv", ["attack_from_xml.py", "3", "1"])
    names = runpy.run_path(str(GUIDE.parent / "examples/attack_from_xml.py"))
    before = load_grid(bundled("hydrant/field.safetensors")).texture.numpy()
    near, far = (texture.numpy() for texture in names["sensor"].textures())
    assert (near != before).any() and (far != before).any() and (near != far).any()
    _, ray, _ = names["sensor"].camera.rays(names["loop"].initial(names["start"]), 1, 0)
    wall = nearest_surface(names["scene"], ray, mi.Bool(True)).numpy()
    assert 0 < (wall < 30).sum() < wall.size / 10
    *rows, traced, last = capsys.readouterr().out.splitlines()
    assert len(rows) == 2 and traced.startswith("path-traced: mean error 0.")
    assert last in ("the failure transfers", "the failure does not transfer")


@pytest.mark.usefixtures("variant")
def test_a_bitmap_is_attacked_through_prb(monkeypatch, capsys, tmp_path):
    """The policy sees the board: its colours change, and are written."""
    monkeypatch.setattr(sys, "argv", ["attack_billboard.py", "3", "1"])
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(GUIDE.parent / "examples/attack_billboard.py"))
    rows = capsys.readouterr().out.splitlines()
    assert [row[:22] for row in rows] == [f"step {k}: mean error 0.0" for k in (0, 1)]
    scene, key = mi.load_file(str(names["file"]), parallel=False), names["key"]
    before, after = (mi.traverse(s)[key].numpy() for s in (scene, names["scene"]))
    changed = np.abs(after - before).max(-1) > 0.05
    assert changed.mean() > 0.01
    assert read_image(tmp_path / "billboard.png").shape[:2] == after.shape[:2]
