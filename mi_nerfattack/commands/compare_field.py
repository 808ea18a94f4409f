"""``mi-nerfattack render compare``: a field and the scene that it shows, compared."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mi_nerfattack.commands.shared.terminal import Result, console

if TYPE_CHECKING:
    from mi_nerfattack.evaluation.field_and_scene import CompareOptions


@dataclass(frozen=True, kw_only=True)
class CompareField:
    """Compare a field with the Mitsuba scene that it shows, along routes."""

    field: tyro.conf.Positional[Path]
    """Field file (.safetensors), in the scene's frame of the world."""
    scene: tyro.conf.Positional[Path]
    """Mitsuba scene (.xml)."""
    routes_file: Path
    """Routes file (.json); all its routes are compared."""
    output: Path | None = None
    """Folder of the report; FIELD.compare by default."""
    size: tuple[int, int] = (200, 66)
    """Width and height of a frame, pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    mount: tuple[float, float, float] = (1.4, 0.5, 6.0)
    """Camera's height and place ahead (metres), pitch down (degrees)."""
    every_m: float = 2.0
    """Arc length between two frames, metres."""
    lateral_m: float = 0.0
    """Offset of the frames to the left of the route, metres."""
    spp: int = 64
    """Samples per pixel of the path-traced frames."""
    json: bool = False
    """End with one line of JSON instead of the table."""

    def run(self) -> Result:
        """Render both, compare and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.evaluation.field_and_scene import compare_with_scene
        from mi_nerfattack.fields import load_field
        from mi_nerfattack.io import files
        from mi_nerfattack.report.pages import compare
        from mi_nerfattack.report.pages.verdict import verdict

        output = self.output or self.field.with_suffix(".compare")
        files.check_folder(output)
        variant.ensure()
        options = self._options()
        with StageBars() as bars:
            comparison = compare_with_scene(
                load_field(self.field),
                self.scene,
                self.routes_file,
                options=options,
                progress=bars.counter("comparing with the scene"),
            )
        title = f"{self.field.name} against {self.scene.name}"
        compare.write_compare_report(output, comparison, title)

        def show() -> None:
            out = console()
            out.print(compare.routes_table(comparison))
            text = verdict(compare.judge_routes(comparison))
            lines = compare.settings_line(comparison), text
            for line in (*lines, f"Wrote {output / 'report.html'}."):
                out.print(line, soft_wrap=True, highlight=False)

        return Result(compare.document(comparison), show)

    def _options(self) -> CompareOptions:
        from mi_nerfattack.evaluation.field_and_scene import CompareOptions
        from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov

        return CompareOptions(
            from_fov(*self.size, self.fov_deg),
            CameraMount(*self.mount),
            self.every_m,
            lateral_m=self.lateral_m,
            spp=self.spp,
        )
