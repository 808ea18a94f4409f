"""``mi-nerfattack capture``: posed renders of a Mitsuba scene along its routes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Capture:
    """Render posed images and depth of a scene, from where a drive may look at it."""

    scene: tyro.conf.Positional[Path]
    """Mitsuba scene (.xml)."""
    routes: Path
    """Routes file (.json); all its routes are used."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for transforms.json, images and depth."""
    views: int = 256
    """Number of views."""
    width: int = 320
    """Of a view, pixels."""
    height: int = 160
    """Of a view, pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    spp: int = 16
    """Samples per pixel."""
    seed: int = 0
    """Of poses and samples."""

    def run(self) -> int:
        """Render and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.scene import capture_scene
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.render.camera.intrinsics import from_fov
        from mi_nerfattack.report.plots.place import routes_picture
        from mi_nerfattack.vehicle.route.route import load_routes

        variant.ensure()
        for name in ("views", "width", "height", "spp"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}: {getattr(self, name)}; at least 1")
        camera = from_fov(self.width, self.height, self.fov_deg)
        with StageBars() as bars:
            path = capture_scene(
                self.scene,
                self.routes,
                self.output,
                self.views,
                camera,
                self.spp,
                self.seed,
                bars.counter("rendering views"),
            )
            show = bars.counter("drawing the place")
            show(0, 1)
            picture = path.parent / "place.png"
            routes_picture(picture, self.scene, load_routes(self.routes), camera)
            show(1, 1)
        print(f"{picture}: scene, routes and lanes from above; look at it first")
        print(f"Wrote {self.views} views to {path.parent}; fit a field to them with")
        folder = shlex.quote(str(path.parent))
        print(f"  mi-nerfattack fit {folder} -o FIELD.safetensors")
        return 0
