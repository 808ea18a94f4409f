"""The files about the package agree, and the paper cites what its bibliography has."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

import mi_nerfattack
from mi_nerfattack.io.strict import parse_json, parse_toml

ROOT = Path(__file__).parents[2]
SPDX = "https://spdx.org/licenses/"
SECTIONS = [
    "Summary",
    "Statement of need",
    "State of the field",
    "Software design",
    "Research impact statement",
    "AI usage disclosure",
    "Acknowledgements",
    "References",
]


def read(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


def scalar(yaml: str, key: str) -> str:
    """Return the value of a top-level key of YAML, which is on the line of the key."""
    (value,) = re.findall(rf"^{key}: (.+)$", yaml, re.M)
    return value.strip('"')


def items(yaml: str, key: str) -> list[str]:
    """Return the list of a top-level key of YAML, without the names `name: `."""
    (block,) = re.findall(rf"^{key}:\n((?:  .*\n)+)", yaml, re.M)
    return re.findall(r"^  - (?:name: )?(.+)$", block, re.M)


def bibtex(entry: str, key: str) -> str:
    (value,) = re.findall(rf"^\s*{key} = \{{+(.+?)\}}+,$", entry, re.M)
    return value


PROJECT = parse_toml("pyproject.toml", read("pyproject.toml"))["project"]
CITATION = read("CITATION.cff")
PREFERRED = re.sub(
    "^  ", "", CITATION.partition("\npreferred-citation:\n")[2], flags=re.M
)
CODEMETA = parse_json("codemeta.json", read("codemeta.json"))
ZENODO = parse_json(".zenodo.json", read(".zenodo.json"))
(ENTRY,) = re.findall(r"^@software\{.+?^\}", read("README.md"), re.M | re.S)
_, HEAD, TEXT = read("paper/paper.md").split("---\n", 2)
KEYS = re.findall(r"^@\w+\{([^,\s]+),$", read("paper/paper.bib"), re.M)

PACKAGE: dict[str, Any] = {
    "version": PROJECT["version"],
    "license": PROJECT["license"],
    "keywords": PROJECT["keywords"],
    "description": PROJECT["description"],
    "title": scalar(CITATION, "title"),
    "authors": items(CITATION, "authors"),
    "released": scalar(CITATION, "date-released"),
}
FILES: dict[str, dict[str, Any]] = {
    "mi_nerfattack": {"version": mi_nerfattack.__version__},
    "CITATION.cff": {
        "version": scalar(CITATION, "version"),
        "license": scalar(CITATION, "license"),
        "keywords": items(CITATION, "keywords"),
    },
    "CITATION.cff, preferred citation": {
        "version": scalar(PREFERRED, "version"),
        "license": scalar(PREFERRED, "license"),
        "title": scalar(PREFERRED, "title"),
        "released": scalar(PREFERRED, "date-released"),
    },
    "codemeta.json": {
        "version": CODEMETA["version"],
        "license": CODEMETA["license"].removeprefix(SPDX),
        "keywords": CODEMETA["keywords"],
        "description": CODEMETA["description"],
        "title": CODEMETA["name"],
        "authors": [author["name"] for author in CODEMETA["author"]],
        "released": CODEMETA["datePublished"],
    },
    ".zenodo.json": {
        "version": ZENODO["version"],
        "license": ZENODO["license"],
        "keywords": ZENODO["keywords"],
        "description": ZENODO["description"],
        "title": ZENODO["title"],
        "authors": [author["name"] for author in ZENODO["creators"]],
    },
    "README.md": {
        "version": bibtex(ENTRY, "version"),
        "title": bibtex(ENTRY, "title"),
        "authors": [bibtex(ENTRY, "author")],
    },
    "paper.md": {
        "keywords": items(HEAD, "tags"),
        "title": scalar(HEAD, "title"),
        "authors": items(HEAD, "authors"),
    },
}


@pytest.mark.parametrize("name", FILES)
def test_files_agree_with_the_project(name):
    assert FILES[name] == {key: PACKAGE[key] for key in FILES[name]}


def test_the_title_begins_with_the_name_of_the_distribution():
    assert PACKAGE["title"].startswith(f"{PROJECT['name']}: ")
    assert CODEMETA["identifier"] == PROJECT["name"]


def test_the_paper_is_in_the_form_of_the_journal():
    assert re.findall(r"^# (.+)$", TEXT, re.M) == SECTIONS
    assert re.fullmatch(r"[1-9]\d? [A-Z][a-z]+ 20\d\d", scalar(HEAD, "date"))
    assert (ROOT / "paper" / scalar(HEAD, "bibliography")).exists()
    assert 900 <= len(TEXT.split()) <= 1500


def test_the_paper_cites_each_reference_and_no_other():
    cited = set(re.findall(r"(?<![\w.])@([\w:-]+)", TEXT))
    assert cited == set(KEYS)
    assert Counter(KEYS).most_common(1)[0][1] == 1


@pytest.mark.parametrize("field", ["title", "author", "year"])
def test_each_reference_is_complete(field):
    entries = re.findall(r"^@.+?^\}", read("paper/paper.bib"), re.M | re.S)
    assert len(entries) == len(KEYS)
    assert all(bibtex(entry, field) for entry in entries)


@pytest.mark.parametrize("kind", ["affiliation", "index"])
def test_affiliations_are_those_of_the_authors(kind):
    assert re.findall(rf"^\s+(?:- )?{kind}: (\d+)$", HEAD, re.M) == ["1"]
