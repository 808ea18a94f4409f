"""Which files below this package are bundled data."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parent
MANIFEST = "manifest.json"
_NOT_DATA = {".py", ".pyc", ".md", ".tmp"}


def data_files(root: Path = ROOT) -> list[str]:
    """Return the names of all data files below root, with forward slashes."""
    return sorted(
        path.relative_to(root).as_posix()
        for path in root.rglob("*")
        if path.is_file() and path.suffix not in _NOT_DATA and path.name != MANIFEST
    )
