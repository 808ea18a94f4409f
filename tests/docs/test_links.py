"""What `make docs` does not check, or only where its extra is installed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OUTSIDE = [*ROOT.glob("*.md"), *(ROOT / "scenes").glob("**/*.md")]


def anchors(page: Path) -> set[str]:
    """The names that GitHub and the site give to a page's headings."""
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    words = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {word.strip().replace(" ", "-") for word in words}


@pytest.mark.parametrize("page", OUTSIDE, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if "://" in link:
            continue
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {link}"
        if heading:
            assert heading in anchors(target), f"{page.name}: {link}"


def test_every_page_is_in_the_contents():
    contents = (ROOT / "docs/index.md").read_text("utf-8")
    listed = set(re.findall(r"^([\w/]+)$", contents, re.MULTILINE))
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*.rst")]
    assert {page.stem for page in pages} - {"index"} <= listed


def test_every_package_with_public_names_is_in_the_reference():
    pages = (ROOT / "docs/api").glob("*.rst")
    text = "".join(page.read_text("utf-8") for page in pages)
    documented = set(re.findall(r"automodule:: (\S+)", text))
    stubs = (ROOT / "mi_nerfattack").glob("**/__init__.pyi")
    names = {".".join(stub.parent.relative_to(ROOT).parts) for stub in stubs}
    assert documented == names | {"mi_nerfattack"}
