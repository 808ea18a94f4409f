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
    """Return the only file of a measurement, whatever its date and machine."""
    (path,) = (ROOT / "bench/results").glob(f"*-cores-{name}.json")
    return json.loads(path.read_text("utf-8"))
