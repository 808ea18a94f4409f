"""Checksums and origin of the bundled data files.

``python -m mi_nerfattack.scenes.manifest check`` compares the files with
``manifest.json``; ``... record FILE... --command '...' [--seed N] [--note '...']``
adds or updates entries.
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import sys
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError, NerfAttackError
from mi_nerfattack.io.files import read_json, write_json

from .listing import MANIFEST, ROOT, data_files

#: Of the wheel, million bytes, before compression. Files of no line share the last.
BUDGET_MB = {
    "intersection/field.safetensors": 5.5,
    "room/field.safetensors": 3.5,
    "country/field.safetensors": 5.5,
    "country/two_cameras.safetensors": 1.7,
    "car/field.safetensors": 10,
    "policy/pilotnet.safetensors": 6.5,
    "room/policy.safetensors": 6.5,
    "hydrant/field.safetensors": 2.5,
    "cube/field.safetensors": 4,
    "other data": 3.2,
    "code": 3.6,
}
_KEYS = {"command", "seed", "sha256", "bytes", "machine", "note"}


def digest(path: Path) -> str:
    """Return the SHA-256 of a file as hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load(root: Path = ROOT) -> dict[str, dict[str, Any]]:
    """Return the entries of the manifest by file name; none if there is no manifest.

    Raises:
        InputError: the manifest lacks ``files`` or an entry lacks a key.
    """
    path = root / MANIFEST
    if not path.exists():
        return {}
    entries = read_json(path).get("files")
    if not isinstance(entries, dict):
        raise InputError(f"{path}: 'files' is missing; record the files anew")
    for name, entry in entries.items():
        if set(entry) != _KEYS:
            raise InputError(
                f"{path}: entry {name!r} has the keys {sorted(entry)}; "
                f"it needs {sorted(_KEYS)}"
            )
    return entries


def problems(root: Path = ROOT) -> list[str]:
    """Return one line for each file that is missing, changed, unlisted or too large."""
    entries = load(root)
    present = set(data_files(root))
    lines = [f"{name}: missing" for name in sorted(set(entries) - present)]
    lines += [f"{name}: not listed" for name in sorted(present - set(entries))]
    for name in sorted(present & set(entries)):
        size, expected = (root / name).stat().st_size, entries[name]["bytes"]
        if size != expected:
            lines.append(f"{name}: {size} bytes; the manifest says {expected}")
        elif digest(root / name) != entries[name]["sha256"]:
            lines.append(f"{name}: SHA-256 differs from the manifest's")
    return lines + over_budget({name: (root / name).stat().st_size for name in present})


def over_budget(sizes: dict[str, int]) -> list[str]:
    """Return one line for each part of `BUDGET_MB` that files of these bytes exceed."""
    totals = dict.fromkeys(BUDGET_MB, 0)
    for name, size in sizes.items():
        totals[name if name in totals else "other data"] += size
    return [
        f"{name}: {size} bytes; the budget is {BUDGET_MB[name]} million"
        for name, size in totals.items()
        if size > 1e6 * BUDGET_MB[name]
    ]


def record(
    paths: list[Path], command: str, seed: int | None, note: str, root: Path = ROOT
) -> None:
    """Add or update the entries of files below root.

    Args:
        paths: the files.
        command: that wrote them, as typed in the repository's root.
        seed: of the command; None if it draws no random numbers.
        note: what the files are and their licence.
        root: folder of the manifest.

    Raises:
        InputError: a path does not exist or lies outside root.
    """
    entries = load(root)
    for path in paths:
        path = path.resolve()
        if not path.is_file() or not path.is_relative_to(root.resolve()):
            raise InputError(f"{path}: not a file below {root}; name a bundled file")
        entries[path.relative_to(root.resolve()).as_posix()] = {
            "command": command,
            "seed": seed,
            "sha256": digest(path),
            "bytes": path.stat().st_size,
            "machine": f"{platform.system()} {platform.machine()}",
            "note": note,
        }
    write_json(root / MANIFEST, {"files": dict(sorted(entries.items()))})


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    actions = parser.add_subparsers(dest="action", required=True)
    actions.add_parser("check")
    recorder = actions.add_parser("record")
    recorder.add_argument("files", type=Path, nargs="+")
    recorder.add_argument("--command", required=True)
    recorder.add_argument("--seed", type=int)
    recorder.add_argument("--note", default="")
    options = parser.parse_args(arguments)
    try:
        if options.action == "record":
            record(options.files, options.command, options.seed, options.note)
            return 0
        lines = problems()
    except NerfAttackError as error:
        print(error, file=sys.stderr)
        return 2
    print("\n".join(lines) if lines else f"{len(load())} files match the manifest")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
