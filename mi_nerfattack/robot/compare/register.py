"""What is held fixed from the first drive on: criteria, run, and drives judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.io import files, locks
from mi_nerfattack.robot.compare.compare import FORMAT
from mi_nerfattack.robot.compare.criteria import WrittenCriteria
from mi_nerfattack.robot.compare.recorded import RecordedDrive

METRICS = "metrics.json"


def read_register(folder: Path) -> dict[str, Any] | None:
    """Read what a comparison left in its folder; None where none was begun.

    Raises:
        InputError: the folder holds something else.
    """
    path = folder / METRICS
    if not path.is_file():
        if folder.is_dir():
            others = [item for item in folder.iterdir() if not locks.is_partial(item)]
            if others:
                raise InputError(
                    f"-o: {folder}; holds {others[0].name}, and no comparison; give a "
                    "new or empty folder, or that of an earlier comparison"
                )
        return None
    document = files.read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError(
            f"-o: {path}; is not of car compare (format {FORMAT!r}); choose another "
            "folder"
        )
    return document


def check_register(
    before: dict[str, Any] | None,
    folder: Path,
    written: WrittenCriteria,
    found: FoundAttack,
    environment: str,
    drives: Sequence[RecordedDrive],
) -> WrittenCriteria:
    """Hold criteria, run and drives to what the comparison was begun with.

    Args:
        before: from :func:`read_register`.
        folder: of it.
        written: the criteria as they are.
        found: the run.
        environment: of its drives.
        drives: real ones.

    Returns:
        the criteria, as written as early as the comparison knows.

    Raises:
        InputError: they were changed, or written after a drive began, or drives that
            were judged are missing, changed or in another order.
    """
    if before is not None:
        now = {
            "the criteria": (written.sha256, before["criteria"]["sha256"]),
            "the run": (found.digest, before["run"]["sha256"]),
            "the environment": (environment, before["environment"]),
        }
        for name, (given, kept) in now.items():
            if given != kept:
                raise InputError(
                    f"{folder / METRICS}: was begun with {name} {kept[:16]}, not "
                    f"{given[:16]}; what is judged by is not changed between drives: "
                    "put it back, or begin another comparison with drives of its own"
                )
        kept_s = datetime.fromisoformat(before["criteria"]["written"]).timestamp()
        written = replace(written, written=min(written.written, kept_s))
        _check_kept(folder, before, drives)
    for item in drives:
        if item.began <= written.written:
            moment = datetime.fromtimestamp(written.written).astimezone()
            began = datetime.fromtimestamp(item.began).astimezone()
            raise InputError(
                f"{written.path}: written at {moment:%Y-%m-%d %H:%M:%S}, after "
                f"{item.path} began ({began:%Y-%m-%d %H:%M:%S}); criteria come first: "
                "drive again, or keep the file's time where it was copied (cp -p)"
            )
    return written


def _check_kept(
    folder: Path, before: dict[str, Any], drives: Sequence[RecordedDrive]
) -> None:
    """Refuse to lose, change or reorder drives that were there."""
    for case in dict.fromkeys(row["case"] for row in before["drives"]):
        kept = [row for row in before["drives"] if row["case"] == case]
        given = [item for item in drives if item.drive.case == case]
        for number, row in enumerate(kept):
            if number >= len(given) or given[number].sha256 != row["sha256"]:
                shown = given[number].path if number < len(given) else "nothing"
                raise InputError(
                    f"{folder / METRICS}: drive {number} past {case} is {row['file']}, "
                    f"now {shown}; give all drives so far, unchanged and in their "
                    "order, new ones after them"
                )
