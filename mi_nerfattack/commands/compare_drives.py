"""``mi-nerfattack car compare``: real drives beside those of a run, and a test."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    from mi_nerfattack.experiment.transfer.found import FoundAttack
    from mi_nerfattack.robot.compare.compare import Compared
    from mi_nerfattack.robot.compare.course import Course

Recordings = tuple[Path, ...]


@dataclass(frozen=True)
class CompareDrives:
    """Judge real drives by criteria that were written before, beside those of a run.

    Drives are aligned by their place on the route. Call it before the first drive, and
    after each with all so far: the folder keeps the criteria and what was judged, and
    refuses other ones. A sequential test says after each drive whether to go on.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder of a finished run of attack."""
    criteria: tyro.conf.Positional[Path]
    """TOML: case, metric, at_least or at_most, and [test] with p0, p1, alpha, beta."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for metrics.json, summary.txt and plots; one of an earlier call goes
    on."""
    no_object: Recordings = ()
    """Recordings of real drives without the object, in the order of driving: videos
    with poses, folders or .mcap logs, as for replays."""
    own: Recordings = ()
    """Likewise past the object as it is."""
    random: Recordings = ()
    """Likewise past random textures."""
    attack: Recordings = ()
    """Likewise past the attack."""
    environment: str = "surrogate"
    """The run's environment whose drives are compared with."""
    json: bool = False
    """Print metrics.json in place of sentences."""

    def run(self) -> Result:
        """Read, align, judge, print and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.io import files, locks
        from mi_nerfattack.robot.compare.compare import compare, read_all
        from mi_nerfattack.robot.compare.course import read_run
        from mi_nerfattack.robot.compare.criteria import read_criteria
        from mi_nerfattack.robot.compare.register import (
            METRICS,
            check_register,
            read_register,
        )
        from mi_nerfattack.robot.compare.summary import sentences

        files.check_folder(self.output)
        variant.ensure()
        written = read_criteria(self.criteria)
        read_register(self.output)
        found, course = read_run(self.run_folder)
        cases = ("no_object", "own", "random", "attack")
        drives = read_all({case: getattr(self, case) for case in cases}, course)
        with locks.exclusive(files.make_folder(self.output)):
            locks.remove_partial(self.output)
            before = read_register(self.output)
            about = found, self.environment, drives
            written = check_register(before, self.output, written, *about)
            compared = compare(found, course, self.environment, written, drives)
            told = list(sentences(compared.document, written.criteria))
            files.write_json(self.output / METRICS, compared.document)
            files.write_text(self.output / "summary.txt", "\n".join([*told, ""]))
            self._draw(found, course, compared)
        told.append(f"Written: {self.output.resolve()}")
        return Result(compared.document, lambda: print(*told, sep="\n"))

    def _draw(self, found: FoundAttack, course: Course, compared: Compared) -> None:
        """Write the pictures, once there is a real drive."""
        from mi_nerfattack.report.plots.drives import overhead
        from mi_nerfattack.robot.compare.course import footprints
        from mi_nerfattack.robot.compare.plot import plot_aligned
        from mi_nerfattack.robot.compare.views import draw_views

        if not compared.aligned:
            return
        given = compared.aligned, compared.run, found.folder / "frames", course
        draw_views(self.output / "views.png", *given)
        path = self.output / "comparison.png"
        plot_aligned(path, compared.aligned, course, self.environment)
        overhead(
            self.output / "overhead.png",
            [*compared.run, *(item.recorded.drive for item in compared.aligned)],
            course.route.points,
            course.route.lane_width_m,
            footprints(found),
            course.lane.wheel_m,
        )
