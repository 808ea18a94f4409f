"""The run folder of an attack: what a killed run left, and what this one keeps."""

from __future__ import annotations

import base64
import html
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.metrics import validate
from mi_nerfattack.experiment.checkpoint import CheckpointFile
from mi_nerfattack.experiment.claim import CHECKPOINT, DRIVES, SCENARIO
from mi_nerfattack.experiment.effort import Effort
from mi_nerfattack.experiment.kept_drives import KeptDrives
from mi_nerfattack.io import files, locks
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM

METRICS = "metrics.json"
_WIDTH = 100  # characters of the table in a notebook


def object_path(folder: Path, name: str) -> Path:
    """Return the file of an attacked object, by its id, in a run folder."""
    return folder / "objects" / f"{name}.safetensors"


def read_finished(folder: Path) -> dict[str, Any]:
    """Read what ``metrics.json`` of a finished run holds.

    Raises:
        InputError: the folder holds no finished run, or the file is damaged.
    """
    path = folder / METRICS
    if not path.is_file():
        raise InputError(
            f"{folder}: holds no finished attack, {METRICS} is missing; give run "
            "folders of 'mi-nerfattack attack', which goes on with an unfinished one"
        )
    document = files.read_json(path)
    validate(document)
    return document


@dataclass(frozen=True)
class Run:
    """A finished attack.

    Attributes:
        folder: the run folder, with pictures, drives and the attacked fields.
        metrics: the content of its ``metrics.json``.
    """

    folder: Path
    metrics: dict[str, Any] = field(repr=False)

    @classmethod
    def read(cls, folder: str | Path) -> Run:
        """Read a run folder.

        Raises:
            InputError: the folder holds no finished run, or the file is damaged.
        """
        return cls(Path(folder), read_finished(Path(folder)))

    def _repr_html_(self) -> str:
        """Show the verdict, the table and the drives from above, in a notebook."""
        from rich.console import Console

        from mi_nerfattack.report.table import metrics_table

        console = Console(record=True, file=io.StringIO(), width=_WIDTH, markup=False)
        console.print(metrics_table(self.metrics))
        layout = '<pre style="line-height: 1.2">{code}</pre>'
        table = console.export_html(inline_styles=True, code_format=layout)
        sentences = "".join(f"<p>{html.escape(s)}</p>" for s in self.metrics["verdict"])
        overhead = self.folder / "overhead.png"  # missing where frames is None
        image = ""
        if overhead.is_file():
            data = base64.b64encode(overhead.read_bytes()).decode()
            image = f'<img width="600" src="data:image/png;base64,{data}">'
        return f"<div>{sentences}{table}{image}</div>"


def folder_labels(folders: Sequence[Path]) -> list[str]:
    """Tell folders apart by as little of their paths as does it."""
    paths = [os.path.abspath(folder) for folder in folders]
    names = [Path(path).name for path in paths]
    if len(set(names)) == len(names):
        return names
    start = os.path.commonpath(paths)
    return [os.path.relpath(path, start) for path in paths]


class RunFolder:
    """A folder that this process has claimed, see :func:`claim.claimed`.

    Its files appear in this order: ``scenario.toml``, ``drives/`` with a file a drive
    and, among them, ``checkpoint.safetensors``, results. A process may be killed
    between any two of them.

    Args:
        path: the folder.
        text: the scenario file, its paths absolute.
        identity: versions and scenario, see :meth:`Scenario.identity`.
        route: name of the route.
        seed: of the scenario.
    """

    def __init__(
        self, path: Path, text: str, identity: Mapping[str, str], route: str, seed: int
    ) -> None:
        self.path = path
        self._text = text
        self.checkpoint = CheckpointFile(path / CHECKPOINT, identity)
        self.drives = KeptDrives(path / DRIVES, identity, route, seed)
        self.effort = Effort()
        self._begun = False

    def read(self, force: bool, on_notice: Callable[[str], None]) -> None:
        """Take up what a run left; nothing is written.

        A folder that holds nothing but what a writer that was killed left is that of
        a run that came to nothing: it starts from the beginning.

        Args:
            force: ignore that the run was of another scenario or other versions: its
                attack goes on, its drives are repeated.
            on_notice: told about what is taken up and ignored.

        Raises:
            InputError: a file is damaged, or the run was of another scenario or other
                versions.
        """
        if not self._holds_run(force, on_notice):
            return
        of_attack = self.checkpoint.read(force)
        of_drives, ignored = self.drives.read(force)
        self.effort = max(of_attack, of_drives, key=lambda effort: effort.wall_s)
        if not self.checkpoint.found:
            for case in (BEST_RANDOM, ATTACK):  # they depend on it
                self.drives.drop(case)
        for line in dict.fromkeys([*self.checkpoint.ignored, *ignored]):
            on_notice(f"{self.path}: ignored, as told: {line}")

    def begin(self) -> None:
        """Make the folder ready to work in."""
        locks.remove_partial(self.path)
        self._begun = not (self.path / SCENARIO).exists()
        files.write_text(self.path / SCENARIO, self._text)
        self.drives.remove_others()

    def withdraw(self) -> None:
        """Remove what this process began, unless an iteration of the attack is done.

        To be called where a scenario is refused: corrected, it is another one.
        """
        if self._begun and not self.checkpoint.path.exists():
            self.drives.remove()
            (self.path / SCENARIO).unlink()

    def _holds_run(self, force: bool, on_notice: Callable[[str], None]) -> bool:
        """Tell a run from nothing; InputError for another run that did nothing."""
        scenario = self.path / SCENARIO
        begun = scenario.exists()
        done = self.checkpoint.path.exists() or self.drives.paths()
        if begun and not done:
            if files.read_text(scenario) != self._text:
                what = f"{scenario}: is another scenario, and nothing was done of it"
                if not force:
                    raise InputError(
                        f"{what}; choose another folder, remove the file, or replace "
                        "it (--force)"
                    )
                on_notice(f"{what}; replaced, as told")
        return begun
