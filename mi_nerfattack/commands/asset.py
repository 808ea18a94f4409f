"""``mi-nerfattack asset``: turn a mesh into an object whose texture can be attacked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Asset:
    """Render a mesh from all sides and fit a decoder-free grid to it.

    The object is centred in x and y and stands on z = 0. Every 8th view is held out
    and scored.
    """

    mesh: tyro.conf.Positional[Path]
    """glTF (.glb, .gltf), OBJ or PLY."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Field file to write (.safetensors); FILE.report beside it says how good it is."""
    height_m: float | None = None
    """Scale to this height, metres."""
    longest_m: float | None = None
    """Scale the longest edge of the bounding box to this, metres."""
    resolution: Literal[64, 128] = 64
    """Finest level of the grid: 64 for a hydrant, 128 for a car."""
    views: int = 96
    """Views rendered."""
    size: int | None = None
    """Width and height of a view, pixels; about three for each cell by default."""
    steps: int = 600
    """Steps of the optimiser."""
    budget_minutes: float | None = None
    """End the fit after this time."""
    batch_rays: int = 4096
    """Rays a step."""
    seed: int = 0
    """Of all random numbers."""
    json: bool = False
    """End with one line of JSON in place of the table."""

    def run(self) -> int:
        """Render, fit, score and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.asset import render_asset
        from mi_nerfattack.capture.fit import FitOptions, fit_grid
        from mi_nerfattack.capture.mesh import normalise
        from mi_nerfattack.capture.mesh_files import load_mesh
        from mi_nerfattack.commands.bars import StageBars
        from mi_nerfattack.commands.fit_report import (
            check_output,
            finish,
            show_fit,
            show_views,
        )
        from mi_nerfattack.fields.grid import GridLayout

        check_output(self.output)
        variant.ensure()
        mesh = normalise(load_mesh(self.mesh), self.height_m, self.longest_m)
        options = FitOptions(
            steps=self.steps,
            budget_minutes=self.budget_minutes,
            batch_rays=self.batch_rays,
            seed=self.seed,
            occupancy_resolution=self.resolution,
            occupancy_start=100,
            occupancy_every=100,
        )
        lower, upper = mesh.bounds
        # room for the outermost vertices' own cells
        room = 2.0 / self.resolution * float((upper - lower).max())
        with StageBars() as bars:
            images, depth = render_asset(
                mesh,
                self.views,
                self.size or 200 * self.resolution // 64,
                self.seed,
                progress=partial(show_views, bars),
            )
            result = fit_grid(
                images,
                lower - room,
                upper + room,
                GridLayout(16, 16, self.resolution),
                options,
                depth,
                progress=partial(show_fit, bars),
            )
        provenance = {"source": self.mesh.name, "seed": str(self.seed)}
        finish(result, images, self.output, provenance, self.json, depth)
        return 0
