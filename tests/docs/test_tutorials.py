"""Tutorials are followed literally, and what follows them tells of mistakes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [p for p in sorted((DOCS / "tutorials").glob("*.md")) if p.stem != "index"]


def follow(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, DOCS / "follow.py", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tutorial_works_as_it_stands(page):
    done = follow(page)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    assert ": ran " in done.stdout


PAGE = """\
```toml
# sizes.toml
width = 3
```

```python
# mine.py
WIDTH = 3
```

```bash
cat sizes.toml
```

```text
...
width = 3
```

<!-- long: hours -->
```bash
touch long
```

<!-- skip: takes a car -->
```bash
touch skipped
```

```python
import mine

print(mine.WIDTH, "m")
```

```text
3 m
```
"""


def test_blocks_are_saved_run_and_left_out(tmp_path):
    (tmp_path / "page.md").write_text(PAGE)
    done = follow(tmp_path / "page.md", "--keep", tmp_path / "kept")
    assert done.returncode == 0, done.stdout + done.stderr
    told = [line.split(": ", 1)[1] for line in done.stdout.splitlines()]
    assert [words.split(",")[0] for words in told] == [
        "saved sizes.toml",
        "saved mine.py",
        "ran bash",
        "as printed",
        "long: hours",
        "skip: takes a car",
        "ran python",
        "as printed",
    ]
    left = {path.name for path in (tmp_path / "kept/page").iterdir()}
    assert left - {"__pycache__"} == {"sizes.toml", "mine.py"}
    follow(tmp_path / "page.md", "--long", "--keep", tmp_path / "all")
    assert (tmp_path / "all/page/long").exists()
    assert not (tmp_path / "all/page/skipped").exists()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("3 m\n", "4 m\n", ":36: printed\n3 m\n\nin place of\n4 m\n"),
        ("cat sizes", "cat others", "others.toml"),
        ("import mine", "import yours", "No module named 'yours'"),
    ],
)
def test_mistakes_are_told(tmp_path, old, new, told):
    (tmp_path / "page.md").write_text(PAGE.replace(old, new))
    done = follow(tmp_path / "page.md")
    assert done.returncode == 1 and told in done.stdout
