"""``mi-nerfattack asset``: make an object whose texture can be attacked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    from mi_nerfattack.capture.object_views import ObjectViews
    from mi_nerfattack.fit.options import FitOptions

_SSIM_PX = 11


@dataclass(frozen=True)
class Asset:
    """Fit a decoder-free grid to views of an object.

    The views are rendered from a mesh or a cube, or read from a folder, as Blender's
    synthetic scenes have them. The object is centred in x and y and stands on z = 0,
    unless --bounds is given. Every 8th view is held out and scored. An interrupted fit
    leaves a checkpoint; the same command goes on from there.
    """

    continues: ClassVar[bool] = True
    anew: ClassVar[tuple[str, ...]] = ("--force",)

    source: tyro.conf.Positional[str]
    """glTF (.glb, .gltf), OBJ or PLY; a folder with RGBA images and poses, as fit reads
    it; or the word cube (a folder named so is ./cube)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Field file to write (.safetensors); a report of the fit lies beside it."""
    height_m: float | None = None
    """Scale to this height, metres."""
    longest_m: float | None = None
    """Scale the longest edge of the bounding box to this, metres."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the source that points up; y for glTF and OBJ, z for PLY and folders."""
    turn_deg: float = 0.0
    """Turn about the vertical, counter-clockwise as seen from above."""
    edge_m: float | None = None
    """Edge of the cube, metres."""
    faces: Path | None = None
    """Folder of six pictures of the cube: px.png, nx.png, py.png ... nz.png."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box of a folder's object: x0 y0 z0 x1 y1 z1; found from the alpha if left out."""
    long_edge: int | None = None
    """Reduce a folder's images to this longer edge, pixels."""
    skip_missing: bool = False
    """Leave out a folder's frames whose image file is missing."""
    ambient: float | None = None
    """Share of light from everywhere in renders, 0.75 by default; 1 bakes no shading
    into colours."""
    resolution: Literal[64, 128] = 64
    """Finest level of the grid: 64 for a hydrant, 128 for a car."""
    views: int | None = None
    """Views rendered; 96 by default."""
    size: int | None = None
    """Width and height of a render, pixels; about three for each cell by default."""
    steps: int | None = None
    """Steps of the optimiser; 600, or 1000 for a folder, which has no depth."""
    budget_minutes: float | None = None
    """End the fit after this time."""
    force: bool = False
    """Start again, whatever an interrupted fit left beside the output."""
    min_weight: float = 0.02
    """Cells that give no ray of the views this share of its colour are emptied: more of
    them make a smaller file, and leave out what is seen through."""
    batch_rays: int = 4096
    """Rays a step."""
    seed: int = 0
    """Of all random numbers."""
    json: bool = False
    """End with one line of JSON in place of the table."""

    def run(self) -> Result:
        """Render or read the views, fit, score and write."""
        from mi_nerfattack.commands.shared.fit_report import begun_fit

        with begun_fit(self.output) as checkpoint:
            return self._fit(checkpoint)

    def _fit(self, checkpoint: Path) -> Result:
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import finish, show_fit
        from mi_nerfattack.fit.fit import fit_object

        self._options(has_depth=True)  # checks them before views are rendered
        variant.ensure()
        with StageBars() as bars:
            found = self._views(bars)
            result = fit_object(
                found,
                self.resolution,
                self._options(found.depth is not None),
                partial(show_fit, bars),
                checkpoint,
                self.force,
            )
        provenance = {
            "source": Path(self.source).name,
            "source_unit": found.images.unit,
            "seed": str(self.seed),
        }
        return finish(
            result,
            found.images,
            self.output,
            provenance,
            checkpoint,
            found.depth,
        )

    def _options(self, has_depth: bool) -> FitOptions:
        from mi_nerfattack.fit.options import FitOptions

        return FitOptions(
            steps=(600 if has_depth else 1000) if self.steps is None else self.steps,
            budget_minutes=self.budget_minutes,
            batch_rays=self.batch_rays,
            seed=self.seed,
            occupancy_resolution=self.resolution,
            min_weight=self.min_weight,
        )

    def _views(self, bars: StageBars) -> ObjectViews:
        from mi_nerfattack.capture.object_renders import Lighting
        from mi_nerfattack.capture.object_views import (
            Placement,
            read_views,
            render_views,
        )

        placement = Placement(self.height_m, self.longest_m, self.up, self.turn_deg)
        is_cube, is_folder = self.source == "cube", Path(self.source).is_dir()
        self._refuse_unused(is_cube, is_folder or self.source.endswith(".json"))
        if is_folder or self.source.endswith(".json"):
            return read_views(
                self.source, placement, self.bounds, self.long_edge, self.skip_missing
            )
        if is_cube:
            mesh = placement.cube(self.edge_m, self.faces)
        else:
            mesh = placement.mesh(self.source)
        return render_views(
            mesh,
            96 if self.views is None else self.views,
            200 * self.resolution // 64 if self.size is None else self.size,
            self.seed,
            Lighting() if self.ambient is None else Lighting(self.ambient),
            bars.counter("rendering views"),
        )

    def _refuse_unused(self, is_cube: bool, is_folder: bool) -> None:
        """Raise InputError for an option that the source has no use for, or a size."""
        from mi_nerfattack.errors import InputError

        if self.size is not None and self.size < _SSIM_PX:
            raise InputError(
                f"--size: {self.size}; at least {_SSIM_PX} pixels, the window of SSIM"
            )
        rendered = not is_folder, "meshes and the cube"
        for name, value, allowed, kind in (
            ("edge-m", self.edge_m, is_cube, "the cube"),
            ("faces", self.faces, is_cube, "the cube"),
            ("bounds", self.bounds, is_folder, "folders"),
            ("long-edge", self.long_edge, is_folder, "folders"),
            ("skip-missing", self.skip_missing or None, is_folder, "folders"),
            ("views", self.views, *rendered),
            ("size", self.size, *rendered),
            ("ambient", self.ambient, *rendered),
            ("height-m", self.height_m, not is_cube, "meshes and folders"),
            ("longest-m", self.longest_m, not is_cube, "meshes and folders"),
            ("up", self.up, not is_cube, "meshes and folders"),
        ):
            if value is not None and not allowed:
                raise InputError(f"--{name}: is for {kind}, not for {self.source}")
