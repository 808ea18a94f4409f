"""Write the JSON schemas of scenarios and grids, which editors check files by.

    python docs/schema.py

tests/docs/test_schema.py compares them with the models.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mi_nerfattack.experiment.sweep.grid import Grid
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.section import Section

DOCS = Path(__file__).resolve().parent
MODELS: dict[str, type[Section]] = {"scenario": Scenario, "grid": Grid}


def schemas() -> dict[Path, str]:
    """Return the text that each of the files should have."""
    return {
        DOCS / f"{name}.schema.json": json.dumps(schema(model), indent=1) + "\n"
        for name, model in MODELS.items()
    }


def schema(model: type[Section]) -> dict[str, Any]:
    """Return the schema of a file, without names that repeat its keys."""
    document = model.model_json_schema()
    if policy := document["properties"].get("policy"):
        for choice in policy["anyOf"]:  # whose kind the suffix of the file tells
            kind = document["$defs"][choice["$ref"].rpartition("/")[2]]
            kind["required"] = [key for key in kind["required"] if key != "kind"]
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return head | _untitled(document)


def _untitled(value: Any) -> Any:
    if isinstance(value, list):
        return [_untitled(item) for item in value]
    if not isinstance(value, dict):
        return value
    titled = "title" if isinstance(value.get("title"), str) else None
    return {key: _untitled(item) for key, item in value.items() if key != titled}


if __name__ == "__main__":
    for path, text in schemas().items():
        path.write_text(text, "utf-8")
