"""Pages of results, and the files of `bench` that they quote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]


def page(name: str) -> str:
    """Return the text of a page of results."""
    return (ROOT / f"docs/results/{name}.md").read_text("utf-8")


def results(name: str) -> dict[str, Any]:
    """Return the newest file of a measurement on a machine without a GPU."""
    paths = sorted((ROOT / "bench/results").glob(f"*-cores-{name}.json"))
    assert paths, f"bench/results: no file of {name}"
    return json.loads(paths[-1].read_text("utf-8"))
