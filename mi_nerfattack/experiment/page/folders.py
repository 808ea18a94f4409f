"""Folders that a page is made of, told apart by the files that they hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.page.run import read_run
from mi_nerfattack.experiment.page.sweep import read_sweep
from mi_nerfattack.experiment.run_folder import SCENARIO, folder_labels
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.table import RESULTS
from mi_nerfattack.experiment.transfer.run import DOCUMENT, QUALITY
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.parts import Parts, RetrainPart, TransferPart

_KINDS = (
    "give run folders of 'mi-nerfattack attack', folders of 'sweep' and 'transfer', "
    "and NAME-retrain.json of 'retrain'"
)
_RETRAINED = {"policy", "runs", "held_out", "left_out", "table"}


def read_folders(
    paths: Sequence[Path],
    scratch: Path,
    on_run: Callable[[str], None] = lambda label: None,
) -> Parts:
    """Read finished runs, sweeps, transfers and retrainings.

    Args:
        paths: folders, and files of retrainings.
        scratch: folder for plots that are made for the page.
        on_run: told the label of each run before it is read, and its objects rendered.

    Raises:
        InputError: none or one twice, one is of another kind or not finished, or a
            file is damaged.
        SetupError: there is a sweep, and pyarrow is not installed.
    """
    if not paths or len({path.resolve() for path in paths}) < len(paths):
        raise InputError("FOLDER: at least one, each once")
    runs, sweeps, transfers, retrainings = [], [], [], []
    for path, label in zip(paths, folder_labels(paths), strict=True):
        if (path / RESULTS).is_file():
            sweeps.append(read_sweep(path, label, scratch, on_run))
        elif (path / DOCUMENT).is_file():
            transfers.append(_transfer(path, label))
        elif path.is_file():
            retrainings.append(_retraining(path))
        elif (path / SCENARIO).is_file():
            on_run(label)
            runs.append(read_run(path, label))
        elif (path / CELLS).is_dir():
            raise InputError(
                f"{path}: is of a sweep of which no cell is done, {RESULTS} is "
                "missing; the sweep's command goes on with it"
            )
        else:
            raise InputError(f"{path}: holds no results; {_KINDS}")
    return Parts(runs, sweeps, transfers, retrainings)


def _transfer(folder: Path, label: str) -> TransferPart:
    path = folder / DOCUMENT
    document = files.read_json(path)
    if not isinstance(document, dict) or document.get("schema") != 1:
        raise InputError(f"{path}: is not of 'mi-nerfattack transfer'; {_KINDS}")
    if not document["complete"]:
        raise InputError(
            f"{path}: rows are missing; the same command of 'mi-nerfattack transfer' "
            "goes on with them"
        )
    quality = folder / QUALITY
    return TransferPart(label, document, quality if quality.is_file() else None)


def _retraining(path: Path) -> RetrainPart:
    document = files.read_json(path)
    if not isinstance(document, dict) or not document.keys() >= _RETRAINED:
        raise InputError(f"{path}: is not of 'mi-nerfattack retrain'; {_KINDS}")
    return RetrainPart(path.name.removesuffix("-retrain.json"), document)
