"""``mi-nerfattack asset``: make an object whose texture can be attacked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.options import check_suffix
from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    from mi_nerfattack.capture.mesh.mesh import TexturedMesh
    from mi_nerfattack.capture.object_views import ObjectViews
    from mi_nerfattack.fit.options import FitOptions

_SSIM_PX = 11
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True)
class _Asset(ABC):
    """Arguments of all fits of an object."""

    continues: ClassVar[bool] = True
    anew: ClassVar[tuple[str, ...]] = ("--force",)

    output: Path
    """Field file to write (.safetensors); its report lies beside it."""
    turn_deg: float = 0.0
    """Turn about the vertical, counter-clockwise as seen from above."""
    resolution: Literal[64, 128] = 64
    """Finest level of the grid: 64 for a hydrant, 128 for a car."""
    steps: int = 600
    """Steps of the optimiser."""
    budget_minutes: float | None = None
    """End the fit after this time."""
    min_weight: float = 0.02
    """Empty cells that give no ray this share of its colour."""
    batch_rays: int = 4096
    """Rays of a step."""
    seed: int = 0
    """Seed of all random numbers."""
    force: bool = False
    """Start again, whatever an interrupted fit left beside the output."""
    json: bool = False
    """End with one line of JSON instead of the table."""

    def run(self) -> Result:
        """Render or read the views, fit, score and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import (
            begun_fit,
            finish,
            show_fit,
        )
        from mi_nerfattack.fit.fit import fit_object

        with begun_fit(self.output) as checkpoint:
            options = self._options()  # checks them before views are rendered
            variant.ensure()
            with StageBars() as bars:
                views = self._views(bars)
                result = fit_object(
                    views,
                    self.resolution,
                    options,
                    progress=partial(show_fit, bars),
                    checkpoint=checkpoint,
                    anew=self.force,
                )
            provenance = {
                "source": self._source(),
                "source_unit": views.images.unit,
                "seed": str(self.seed),
                **self._light(),
            }
            return finish(
                result,
                views.images,
                self.output,
                provenance=provenance,
                checkpoint=checkpoint,
            )

    def _options(self) -> FitOptions:
        from mi_nerfattack.fit.options import FitOptions

        return FitOptions(
            steps=self.steps,
            budget_minutes=self.budget_minutes,
            batch_rays=self.batch_rays,
            seed=self.seed,
            occupancy_resolution=self.resolution,
            min_weight=self.min_weight,
        )

    @abstractmethod
    def _source(self) -> str:
        """Return the source's name, for the file's header."""

    def _light(self) -> dict[str, str]:
        """Return what is known about the light of the views, for the file's header."""
        return {}

    @abstractmethod
    def _views(self, bars: StageBars) -> ObjectViews:
        """Render or read the views."""


@dataclass(frozen=True)
class _Rendered(_Asset):
    """Arguments of fits to renders."""

    views: int = 96
    """Views that are rendered; every 8th is held out and scored."""
    view_px: int | None = None
    """Width and height of a view; about three pixels a cell by default."""
    ambient: float = 0.75
    """Share of light from everywhere; 1 bakes no shading into colours."""

    def _light(self) -> dict[str, str]:
        return {"ambient": repr(self.ambient)}

    def _views(self, bars: StageBars) -> ObjectViews:
        from mi_nerfattack.capture.object_views import render_views
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.render.lighting.lights import Lighting

        view_px = 200 * self.resolution // 64 if self.view_px is None else self.view_px
        if view_px < _SSIM_PX:
            raise InputError(
                f"--view-px: {view_px}; at least {_SSIM_PX} pixels, the window of SSIM"
            )
        return render_views(
            self._mesh(),
            self.views,
            view_px,
            self.seed,
            Lighting(self.ambient),
            bars.counter("rendering views"),
        )

    @abstractmethod
    def _mesh(self) -> TexturedMesh:
        """Return what is rendered."""


@dataclass(frozen=True, kw_only=True)
class AssetMesh(_Rendered):
    """Fit a decoder-free grid to renders of a mesh.

    The object is centred in x and y and stands on z = 0. The same command continues an
    interrupted fit from its checkpoint.
    """

    source: tyro.conf.Positional[Path]
    """Mesh: glTF (.glb, .gltf), OBJ or PLY."""
    height_m: float | None = None
    """Scale to this height, metres."""
    longest_m: float | None = None
    """Scale the longest edge of the bounding box to this, metres."""
    up: Axis | None = None
    """Axis of the mesh that points up; y for glTF and OBJ, z for PLY."""

    def _source(self) -> str:
        return self.source.name

    def _mesh(self) -> TexturedMesh:
        from mi_nerfattack.capture.object_views import Placement

        placement = Placement(
            self.height_m, self.longest_m, self.up, turn_deg=self.turn_deg
        )
        return placement.mesh(self.source)


@dataclass(frozen=True, kw_only=True)
class AssetCube(_Rendered):
    """Fit a decoder-free grid to renders of a cube, which stands on z = 0.

    The same command continues an interrupted fit from its checkpoint.
    """

    edge_m: float
    """Edge of the cube, metres."""
    faces: Path | None = None
    """Folder of its six pictures: px.png, nx.png, py.png ... nz.png."""

    def _source(self) -> str:
        return "cube"

    def _mesh(self) -> TexturedMesh:
        from mi_nerfattack.capture.object_views import Placement

        return Placement(turn_deg=self.turn_deg).cube(self.edge_m, self.faces)


@dataclass(frozen=True, kw_only=True)
class AssetFolder(_Asset):
    """Fit a decoder-free grid to RGBA images, as Blender's synthetic scenes have them.

    The object is centred in x and y and stands on z = 0, unless --bounds is given.
    Every 8th image is held out and scored. The same command continues an interrupted
    fit from its checkpoint.
    """

    source: tyro.conf.Positional[Path]
    """Folder of images and poses, as fit reads it, or its JSON file."""
    steps: int = 1000
    """Steps of the optimiser; more than with renders, which have depth."""
    height_m: float | None = None
    """Scale to this height, metres."""
    longest_m: float | None = None
    """Scale the longest edge of the bounding box to this, metres."""
    up: Axis | None = None
    """Axis of the folder's world that points up; z by default."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box of the object: x0 y0 z0 x1 y1 z1; found from the alpha by default."""
    long_edge: int | None = None
    """Reduce images to this longer edge, pixels."""
    skip_missing: bool = False
    """Leave out frames whose image file is missing."""

    def _source(self) -> str:
        return self.source.name

    def _views(self, bars: StageBars) -> ObjectViews:
        from mi_nerfattack.capture.object_views import Placement, read_views

        placement = Placement(
            self.height_m, self.longest_m, self.up, turn_deg=self.turn_deg
        )
        return read_views(
            self.source,
            placement,
            self.bounds,
            long_edge_px=self.long_edge,
            skip_missing=self.skip_missing,
        )


@dataclass(frozen=True, kw_only=True)
class AssetFlat:
    """Write a billboard, which stands, or a patch, which lies: one flat picture.

    A scenario needs no file of it: see `kind` of [[objects]]. A file serves commands
    that draw places, as train, evaluate and sweep do.
    """

    kind: tyro.conf.Positional[Literal["billboard", "patch"]]
    output: Path
    """Field file to write (.safetensors)."""
    width_m: float
    """Width of the picture."""
    height_m: float
    """Height of the picture; of a patch, its length along the lane."""
    picture: Path | None = None
    """Image that is stretched over it; grey by default."""
    pixels_per_m: float = 32.0
    """Resolution along the longer edge."""
    json: bool = False
    """End with one line of JSON instead of a sentence."""

    def run(self) -> Result:
        """Read the picture and write the field."""
        from mi_nerfattack import variant
        from mi_nerfattack.capture.mesh.flat import FlatObject, read_picture
        from mi_nerfattack.fields.io import save_field
        from mi_nerfattack.io import files

        check_suffix(self.output, ".safetensors")
        files.check_writable(self.output)
        flat = FlatObject(
            self.kind, self.width_m, self.height_m, pixels_per_m=self.pixels_per_m
        )
        variant.ensure()
        picture = None
        if self.picture is not None:
            picture = read_picture(self.picture)
        save_field(self.output, flat.field(picture))
        message = (
            f"Wrote {self.output}: {self.kind} of {self.width_m:g} x {self.height_m:g} "
            f"m, {flat.pixels} pixels along each edge"
        )
        figures = {"kind": self.kind, "pixels": flat.pixels}
        return Result({"output": str(self.output), **figures}, lambda: print(message))
