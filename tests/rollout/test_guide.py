"""The examples in docs/loop.md run as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs/loop.md"


@pytest.mark.slow
def test_examples_run(tmp_path):
    text = GUIDE.read_text("utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 2
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
