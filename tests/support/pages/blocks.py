"""Blocks of code in pages of Markdown."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent

_FENCE = re.compile(r"^( *)```([^\n`]*)\n(.*?)^\1```$", re.M | re.S)


def fenced(page: Path, *languages: str) -> list[str]:
    """Return the blocks of some languages, without fences, in the page's order.

    Args:
        page: its fences may be indented in a list.
        languages: words after the opening fence, "" for none.
    """
    matches = _FENCE.findall(page.read_text("utf-8"))
    return [dedent(block) for _, language, block in matches if language in languages]
