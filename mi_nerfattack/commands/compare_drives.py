"""``mi-nerfattack car compare``: real drives among those of a run, and a test."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from mi_nerfattack.commands.shared.terminal import Result, console
from mi_nerfattack.errors import InputError

Recordings = tuple[Path, ...]


@dataclass(frozen=True)
class CompareDrives:
    """Summarise real drives as one more environment of a run.

    With criteria, a sequential test says after each drive whether to go on.
    """

    run_folder: tyro.conf.Positional[Path]
    output: Path
    """Folder for metrics.json, steps.csv and overhead.png."""
    criteria: Path | None = None
    """TOML: case, metric, at_least or at_most, and [test] with p0, p1, alpha, beta."""
    no_object: Recordings = ()
    """Recordings of real drives without the object, in the order of driving: videos
    with poses, folders or .mcap logs, as for replays."""
    own: Recordings = ()
    """Recordings of drives past the object with its original texture."""
    random: Recordings = ()
    """Recordings of drives past the object with random textures."""
    attack: Recordings = ()
    """Recordings of drives past the object with the attack."""
    topics: tuple[str, ...] = ()
    """Topics of the logs, as of car overlay."""
    json: bool = False
    """Print metrics.json instead of the table."""

    def run(self) -> Result:
        """Read, judge, write and print."""
        from mi_nerfattack import variant
        from mi_nerfattack.deploy.replay.mcap import McapTopics
        from mi_nerfattack.drives.store import read_drives
        from mi_nerfattack.drives.table import write_steps
        from mi_nerfattack.evaluation.sequential import read_criteria, sentences
        from mi_nerfattack.experiment.real import Course, read_all, real_document
        from mi_nerfattack.experiment.run_folder import DRIVES, read_finished
        from mi_nerfattack.experiment.transfer.found import read_found
        from mi_nerfattack.io import files
        from mi_nerfattack.report.plots.map import overhead
        from mi_nerfattack.report.table import metrics_table

        files.check_folder(self.output)
        before = self.output / "metrics.json"
        if before.is_file() and "real" not in files.read_json(before):
            raise InputError(f"-o: {self.output}; holds a run, give another folder")
        variant.ensure()
        criteria = None if self.criteria is None else read_criteria(self.criteria)
        (attack,) = read_found([self.run_folder])
        course = Course.of(attack)
        cases = ("no_object", "own", "random", "attack")
        recordings = {case: getattr(self, case) for case in cases}
        drives = read_all(recordings, course, McapTopics.parse(self.topics))
        routes = read_finished(attack.folder)["routes"].values()
        closed = {name for environments in routes for name in environments}
        of_run = [  # an open loop has no distances from the lane centre
            drive
            for drive in read_drives(attack.folder / DRIVES)
            if drive.environment in closed
        ]
        document = real_document(
            attack, course, of_run, drives=drives, criteria=criteria
        )
        real = [item.drive for item in drives]
        files.make_folder(self.output)
        files.write_json(self.output / "metrics.json", document)
        drawn, lane = [*of_run, *real], course.lane
        write_steps(self.output / "steps.csv", drawn, {course.route.name: lane})
        if real:
            path = self.output / "overhead.png"
            overhead(
                path, drawn, course.route, object_footprints=[], limit=lane.wheel_m
            )
        lines = [] if criteria is None else [*sentences(criteria, document["test"])]
        lines.append(f"Written: {self.output.resolve()}")

        def show() -> None:
            console().print(metrics_table(document))
            print(*lines, sep="\n")

        return Result(document, show)
