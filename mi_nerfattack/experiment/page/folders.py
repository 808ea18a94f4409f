"""Folders that a page is made of, told apart by the files that they hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.run_folder import SCENARIO, folder_labels
from mi_nerfattack.report.pages.results import RunPart


def read_folders(paths: Sequence[Path]) -> list[RunPart]:
    """Read finished run folders.

    Raises:
        InputError: none or one twice, a folder holds something else or no finished
            run, or a file is damaged.
    """
    if not paths or len({path.resolve() for path in paths}) < len(paths):
        raise InputError("FOLDER: at least one, each once")
    for path in paths:
        if not (path / SCENARIO).is_file():
            raise InputError(
                f"{path}: holds no {SCENARIO}; give run folders of "
                "'mi-nerfattack attack'"
            )
    labels = folder_labels(paths)
    return [read_run(*pair) for pair in zip(paths, labels, strict=True)]
