"""The contents list every page, and the API reference every package."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_page_is_in_the_contents():
    docs = ROOT / "docs"
    contents = [docs / "index.md", docs / "tutorials/index.md"]
    listed = {
        (page.parent / name).resolve()
        for page in contents
        for name in re.findall(
            r"^- \[[^]]*\]\(([\w/.]+)\)", page.read_text("utf-8"), re.M
        )
    }
    pages = {*docs.glob("**/*.md"), docs / "api/index.rst"}
    assert pages - {docs / "index.md", docs / "pictures/README.md"} == listed


def test_every_package_with_public_names_is_in_the_reference():
    pages = (ROOT / "docs/api").glob("*.rst")
    text = "".join(page.read_text("utf-8") for page in pages)
    documented = set(re.findall(r"automodule:: (\S+)", text))
    stubs = (ROOT / "mi_nerfattack").glob("**/__init__.pyi")
    names = {".".join(stub.parent.relative_to(ROOT).parts) for stub in stubs}
    assert documented == names | {"mi_nerfattack"}
