"""``mi-nerfattack fit``: fit a field to a folder of posed images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import tyro

from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    from mi_nerfattack.capture.posed_images import PosedImages
    from mi_nerfattack.fields.ngp import NGPLayout
    from mi_nerfattack.fit.options import FitOptions


@dataclass(frozen=True)
class Fit:
    """Fit a neural field to posed images, and score it on every 8th image.

    The same command continues an interrupted fit from its checkpoint. Without --bounds
    the field's box holds all depths in the folder. Without depth, it holds the cameras
    and sparse points. Without these too, it is a cube around the point nearest to all
    optical axes, four times as wide as the distance of the farthest camera.
    """

    continues: ClassVar[bool] = True
    anew: ClassVar[tuple[str, ...]] = ("--force",)

    folder: tyro.conf.Positional[Path]
    """Folder with images and transforms.json or a COLMAP model, or the JSON file."""
    output: Path
    """Field file to write (.safetensors); FILE.report says how good it is."""
    long_edge: int | None = None
    """Reduce the images to this longer edge, pixels."""
    epochs: int = 50
    """Passes over the pixels; hours without a GPU, see --budget-minutes."""
    steps: int | None = None
    """Steps of the optimiser, instead of --epochs."""
    budget_minutes: float | None = None
    """End the fit after this time; the learning rate decays to fit."""
    patience: int | None = None
    """End the fit when so many steps lower the loss by less than 1 %."""
    force: bool = False
    """Start again; an interrupted fit next to the output is not continued."""
    batch_rays: int = 16384
    """Rays of a step, at most."""
    network: Literal["instant-ngp", "small"] = "instant-ngp"
    """16 levels of 2^19 entries and width 64, or 10 of 2^17 and 32."""
    levels: int | None = None
    """Levels of the hash grid; the network's by default."""
    log2_table: int | None = None
    """Binary logarithm of the entries on each level."""
    max_resolution: int | None = None
    """Resolution of the finest level; 2048 in both networks."""
    exposure: bool = False
    """Learn the exposure of each image."""
    refine_poses: bool = False
    """Correct the poses of the fitted images."""
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Box of the field: x0 y0 z0 x1 y1 z1, metres."""
    step_m: float | None = None
    """March's step near the camera; a thousandth of the box by default."""
    occupancy: int | None = None
    """Cells along the longest edge; 256 with depth, else 128."""
    no_sky: bool = False
    """Let no light come from behind the box, as in a room."""
    spread: float = 0.0
    """Weight of a penalty on fog, for example 0.003."""
    seed: int = 0
    """Seed of all random numbers."""
    skip_missing: bool = False
    """Leave out frames whose image file is missing."""
    json: bool = False
    """End with one line of JSON instead of the table."""

    def _layout(self) -> NGPLayout:
        from mi_nerfattack.fields.ngp import NGPLayout

        base = NGPLayout.small() if self.network == "small" else NGPLayout()
        names = ("levels", "log2_table", "max_resolution")
        sizes = {name: getattr(self, name) for name in names}
        return replace(base, **{k: v for k, v in sizes.items() if v is not None})

    def _options(self, has_depth: bool) -> FitOptions:
        from mi_nerfattack.fit.loss import LossWeights
        from mi_nerfattack.fit.options import FitOptions

        cells = 256 if has_depth else 128
        return FitOptions(
            steps=self.steps,
            epochs=self.epochs,
            patience=self.patience,
            exposure=self.exposure,
            poses=self.refine_poses,
            sky=not self.no_sky,
            budget_minutes=self.budget_minutes,
            batch_rays=self.batch_rays,
            seed=self.seed,
            loss=LossWeights(spread=self.spread),
            occupancy_resolution=cells if self.occupancy is None else self.occupancy,
        )

    def _provenance(self, images: PosedImages) -> dict[str, str]:
        names = ("seed", "network", "budget_minutes", "exposure", "refine_poses")
        return {
            "source": self.folder.resolve().name,
            "source_unit": images.unit,
            "size_px": f"{images.camera.width} x {images.camera.height}",
            **{name: str(getattr(self, name)) for name in (*names, "spread", "no_sky")},
        }

    def run(self) -> Result:
        """Fit, score and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.fit_report import begun_fit

        variant.ensure()
        with begun_fit(self.output) as checkpoint:
            return self._fit(checkpoint)

    def _fit(self, checkpoint: Path) -> Result:
        from mi_nerfattack.capture.inputs import find_bounds, read_depth
        from mi_nerfattack.capture.transforms import read_images
        from mi_nerfattack.commands.shared.fit_report import finish, show_fit
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.fit.fit import fit_ngp

        images = read_images(self.folder, self.long_edge, self.skip_missing)
        depth = read_depth(self.folder, images)
        lower, upper = find_bounds(images, depth, self.bounds)
        with StageBars() as bars:
            for line in _gap_warnings(images):
                bars.say(line)
            result = fit_ngp(
                images,
                lower,
                upper,
                layout=self._layout(),
                options=self._options(depth is not None),
                depth=depth,
                step_m=self.step_m,
                progress=partial(show_fit, bars),
                checkpoint=checkpoint,
                anew=self.force,
            )
        provenance = self._provenance(images)
        return finish(
            result,
            images,
            self.output,
            provenance=provenance,
            checkpoint=checkpoint,
        )


def _gap_warnings(images: PosedImages) -> Iterator[str]:
    """Say what speaks against a fit before hours are spent on it."""
    import numpy as np

    from mi_nerfattack.capture.coverage import FAR_DEG, view_gaps
    from mi_nerfattack.capture.posed_images import held_out

    if images.points is None or len(images) < 2:
        return
    skipped = held_out(len(images))
    fitted = np.ones(len(images), bool)
    fitted[skipped] = False
    cameras = [images.camera_of(i) for i in range(len(images))]
    gaps = view_gaps(cameras, images.camera_to_world, images.points, others=fitted)
    gap = float(np.median(gaps[skipped]))
    if gap > FAR_DEG:
        yield (
            f"warning: the views stand {gap:.0f} degrees apart, as seen from what they "
            f"show. More than {FAR_DEG:.0f} leave a field that is good in its views "
            "and foggy between them: take more photographs between these"
        )
