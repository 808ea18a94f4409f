"""Comparison of a field with a scene: the arguments of ``fit`` and what is printed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.shared.terminal import console
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.evaluation.field_and_scene import CompareOptions, Comparison
    from mi_nerfattack.fields import AbstractField


@dataclass(frozen=True)
class CompareArguments:
    """Comparison with the scene that the field stands for."""

    compare: Path | None = None
    """Mitsuba scene (.xml) to compare with along --routes."""
    routes: Path | None = None
    """Routes file (.json); all its routes are compared."""
    compare_size: tuple[int, int] = (200, 66)
    """Width and height of a frame, pixels."""
    compare_fov_deg: float = 90.0
    """Horizontal field of view."""
    compare_mount: tuple[float, float, float] = (1.4, 0.5, 6.0)
    """Of the camera: height (m), forward of the vehicle's reference point (m), pitch
    down (degrees)."""
    compare_every_m: float = 2.0
    """Arc length between two frames, metres."""
    compare_lateral_m: float = 0.0
    """Offset of the frames to the left of the route, metres."""
    compare_spp: int = 64
    """Samples per pixel of the path-traced frames."""

    def check(self) -> None:
        """Raise InputError if the files or numbers cannot be compared with.

        Called before a fit starts, so that a mistyped path costs no fit.
        """
        from mi_nerfattack.render.pathtrace.load import load_scene
        from mi_nerfattack.vehicle.route.route import load_routes

        if (self.compare is None) != (self.routes is None):
            raise InputError(
                f"--compare {self.compare}, --routes {self.routes}: a comparison needs "
                "both, a Mitsuba scene and a routes file"
            )
        if self.compare is None or self.routes is None:
            return
        self.options()
        load_routes(self.routes)
        load_scene(self.compare)

    def options(self) -> CompareOptions:
        """Return what `compare_with_scene` takes."""
        from mi_nerfattack.evaluation.field_and_scene import CompareOptions
        from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov

        return CompareOptions(
            from_fov(*self.compare_size, self.compare_fov_deg),
            CameraMount(*self.compare_mount),
            self.compare_every_m,
            self.compare_lateral_m,
            self.compare_spp,
        )

    def run(self, field: AbstractField, output: Path) -> Comparison | None:
        """Compare, and write the report; None if no scene is given.

        Args:
            field: the field, in the world's frame.
            output: its file; the report lies beside it, see `compare_folder`.
        """
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.evaluation.field_and_scene import compare_with_scene
        from mi_nerfattack.report.pages.compare import write_compare_report

        if self.compare is None or self.routes is None:
            return None
        with StageBars() as bars:
            show = bars.counter("comparing with the scene")
            comparison = compare_with_scene(
                field, self.compare, self.routes, self.options(), show
            )
        title = f"{output.name} against {self.compare.name}"
        write_compare_report(compare_folder(output), comparison, title)
        return comparison


def compare_file(path: Path, arguments: CompareArguments) -> Result:
    """Compare a field file, and return the figures.

    Args:
        path: the field file.
        arguments: with a scene and routes.

    Raises:
        InputError: no scene is given, or a file is wrong.
    """
    from mi_nerfattack.fields import load_field
    from mi_nerfattack.report.pages.compare import document

    if arguments.compare is None:
        raise InputError(
            f"{path}: is a field already; give --compare SCENE --routes ROUTES to "
            "compare it with a scene, or a folder of images to fit to"
        )
    comparison = arguments.run(load_field(path), path)
    assert comparison is not None
    return Result(
        {"compare": document(comparison)}, lambda: print_comparison(comparison, path)
    )


def compare_folder(output: Path) -> Path:
    """Return the folder of the comparison that belongs to a field file."""
    return output.with_suffix(".compare")


def print_comparison(comparison: Comparison, output: Path) -> None:
    """Print a table of the routes, and what it comes to."""
    from mi_nerfattack.report.pages.compare import routes_table, settings_line, verdict

    out = console()
    out.print(routes_table(comparison))
    page = compare_folder(output) / "report.html"
    for line in (settings_line(comparison), verdict(comparison), f"Wrote {page}."):
        out.print(line, soft_wrap=True, highlight=False)
