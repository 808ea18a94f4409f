"""What a page says, without the bytes of its pictures."""

from __future__ import annotations

import re
from pathlib import Path


def page_text(path: Path) -> str:
    """Read a page; each `data:` URI is cut out, for it may spell any word."""
    return re.sub(r'(?<=")data:[^"]*', "data:", path.read_text("utf-8"))
