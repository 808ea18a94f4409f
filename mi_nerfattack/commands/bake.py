"""``mi-nerfattack bake``: a scene's field as bricks, which are faster to march."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class Bake:
    """Bake a scene's field along its routes, for faster attacks and drives.

    The file takes the field's place in a scenario. It shows nearly what the field
    shows; FILE.report beside it says how nearly.
    """

    field: tyro.conf.Positional[Path]
    """Field file of the scene, as fit writes it."""
    routes: Path
    """Routes file (.json), in the field's frame; all its routes are used."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Field file to write (.safetensors)."""
    cone: float = 1 / 64
    """Edge of a brick's parts over the distance to the nearest route; half takes up to
    six times the memory."""
    passes: int = 4
    """Passes of the refinement."""
    views: int = 100
    """Views of a pass."""
    width: int = 200
    """Of a view, pixels."""
    height: int = 66
    """Of a view, pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    seed: int = 0
    """Of poses and samples."""
    json: bool = False
    """End with one line of JSON."""

    def run(self) -> Result:
        """Bake, score and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import report_folder
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.fields import NGPField, load_field, save_field
        from mi_nerfattack.fit.bake.bake import BakeOptions, bake, plan_bricks
        from mi_nerfattack.fit.bake.scores import score_bake
        from mi_nerfattack.render.camera.intrinsics import from_fov
        from mi_nerfattack.report.pages.bake import (
            bake_summary,
            bake_verdict,
            write_bake_report,
        )
        from mi_nerfattack.report.pages.fit import finite
        from mi_nerfattack.vehicle.route.route import load_routes

        self._check()
        options = BakeOptions(self.cone, self.passes, self.views, self.seed)
        camera = from_fov(self.width, self.height, self.fov_deg)
        routes = load_routes(self.routes)
        variant.ensure()
        field = load_field(self.field)
        if not isinstance(field, NGPField):
            raise InputError(
                f"{self.field}: is a {field.kind}; only an ngp_field is baked"
            )
        plan = plan_bricks(field, routes, options)
        with StageBars() as bars:
            bars.say(
                f"{len(plan.subdivisions)} bricks: {plan.file_mb:.0f} MB, "
                f"{plan.peak_mb:.0f} MB while they are baked"
            )
            started = time.perf_counter()
            counter = bars.counter("baking", "pass ")
            baked = bake(field, routes, camera, None, options, plan, counter)
            seconds = time.perf_counter() - started
            save_field(self.output, baked)
            score = bars.counter("comparing", "view ")
            views = score_bake(field, baked, routes, camera, progress=score)
        facts = {
            "field": self.field.name,
            "bricks": len(plan.subdivisions),
            "vertices_mb": round(plan.file_mb, 1),
            **asdict(options),
            "bake_s": round(seconds, 1),
        }
        title = f"Bake of {self.field.name}"
        page = write_bake_report(report_folder(self.output), views, facts, title)
        told = f"{bake_verdict(views)}\nWrote {self.output} and {page}."
        return Result(finite(facts | bake_summary(views)), lambda: print(told))

    def _check(self) -> None:
        """Refuse what would fail after the bake."""
        from mi_nerfattack.commands.shared.fit_report import check_output
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.fit.scores import MIN_EDGE_PX

        check_output(self.output)
        if self.output.resolve() == self.field.resolve():
            raise InputError(f"--output: {self.output} is the field itself")
        if min(self.width, self.height) < MIN_EDGE_PX:
            raise InputError(
                f"--width, --height: {self.width} x {self.height}; SSIM takes at least "
                f"{MIN_EDGE_PX} px each way"
            )
