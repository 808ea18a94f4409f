"""Do what is left of a transfer, and write its folder as it grows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.run_folder import SCENARIO
from mi_nerfattack.experiment.transfer.figures import case_figures, make_document
from mi_nerfattack.experiment.transfer.work import Batch, TransferWork
from mi_nerfattack.io import files, locks
from mi_nerfattack.report.plots.transfer import plot_quality, plot_transfer
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.system.workers import AbstractWorkers, raise_failure

DOCUMENT, PICTURE, DRIVES = "transfer.json", "transfer.png", "drives"
QUALITY = "quality.png"


def check_output(folder: Path) -> None:
    """Make the folder of a transfer; InputError if it is the one of a run."""
    if (folder / SCENARIO).exists():
        raise InputError(f"{folder}: is the folder of a run; choose another with -o")
    files.make_folder(folder)


def run_transfer(
    work: TransferWork,
    output: Path,
    workers: AbstractWorkers,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Do the drives that are not there yet, and summarise all.

    ``transfer.json`` is written anew whenever a row is whole.

    Args:
        work: all drives, those of `output`.
        output: the folder, see `check_output`.
        workers: who does them.
        progress: called with control periods done and wanted.

    Returns:
        the document that ``transfer.json`` holds.

    Raises:
        InputError: before the first drive, an environment that cannot be made, another
            process in the folder, or drives of another transfer there; later, whatever
            a drive raises.
    """
    with locks.exclusive(output):
        locks.remove_partial(output)
        return _run(work, output, workers, progress)


def _run(
    work: TransferWork,
    output: Path,
    workers: AbstractWorkers,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    figures: dict[str, dict[str, Any]] = {}
    left, done, total = [], 0, 0
    for index, batch in enumerate(work.batches):
        drives, horizon = work.read(batch), work.attacks[batch.number].horizon
        whole = [drive for drive in drives if drive is not None]
        done, total = done + horizon * len(whole), total + horizon * work.starts
        if len(whole) == work.starts:
            figures[batch.digest] = case_figures(work, batch, whole)
        else:
            left.append(index)
    _check_environments(work, [work.batches[index] for index in left])

    def on_units(units: int) -> None:
        nonlocal done
        done += units
        progress(done, total)

    def on_end(index: int, error: Exception | None) -> None:
        raise_failure(index, error)
        batch = work.batches[index]
        figures[batch.digest] = case_figures(work, batch, _whole(work, batch))
        written = make_document(work, figures)
        if len(written["rows"]) > len(document["rows"]):
            document.update(written)
            files.write_json(output / DOCUMENT, document)

    document = make_document(work, figures)
    files.write_json(output / DOCUMENT, document)
    workers.run(work, left, on_units, on_end)
    plot_transfer(output / PICTURE, document)
    known = [s for s in document["surrogates"] if s["psnr_heldout_db"] is not None]
    if len(known) > 1:
        plot_quality(output / QUALITY, document)
    return document


def _whole(work: TransferWork, batch: Batch) -> list[Drive]:
    found = []
    for start, drive in enumerate(work.read(batch)):
        if drive is None:
            raise InputError(f"{work.path(batch, start)}: missing; it was removed")
        found.append(drive)
    return found


def _check_environments(work: TransferWork, batches: list[Batch]) -> None:
    """Tell what cannot be made now, not after the hours of those before it.

    Every environment is made once in each scene under each sky, without objects.
    """
    opened, seen = work.open(), set()
    for batch in batches:
        column, found = batch.column, work.attacks[batch.number]
        scene = found.identity["scenario.scene.deployment"]
        key = scene, column.name, column.condition.sky
        if key not in seen:
            seen.add(key)
            column.open(opened.world(batch.number), [], 0).close()
    opened.close()
