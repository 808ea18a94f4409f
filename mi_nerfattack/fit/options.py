"""Settings, progress and result of a fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.io import save_field
from mi_nerfattack.fields.ngp import NGPField
from mi_nerfattack.fit.loss import LossWeights
from mi_nerfattack.fit.scores import ViewScore
from mi_nerfattack.ranges import (
    Count,
    Fraction,
    Natural,
    Positive,
    Share,
    SomeShare,
    checked,
)


@dataclass(frozen=True)
@checked()
class FitOptions:
    """How a field is fitted.

    Attributes:
        steps: of the optimiser; None for as many as `epochs` take.
        epochs: over the pixels of the fitted images, where `steps` is None.
        budget_minutes: end after this time if the fit is not done by then; the
            learning rate then decays by time. None sets no limit.
        patience: end early if this many steps lower the loss by less than 1 % against
            as many steps before; None never does.
        batch_rays: rays a step, at most.
        samples: of a step, about; as long as the occupancy is full, and rays therefore
            long, a batch has fewer rays.
        seed: of initialisation, pixels, sample positions and backgrounds. Results
            still differ in the last bits unless Dr.Jit runs on one thread.
        learning_rate: of Adam, constant in the first half of the fit.
        final_rate: share of `learning_rate` that is left at the end; between, it
            falls exponentially.
        occupancy_resolution: cells along the longest edge of the box; of a grid's box,
            along each.
        occupancy_every: steps between two looks at some cells; every fourth changes
            the occupancy.
        occupancy_start: steps before the first one.
        min_weight: of a sample in the colour of a fitted image's ray; cells of a grid
            where none reaches it are emptied at the end.
        sky: of an NGP and images without alpha, learn light from behind the box, by
            direction; otherwise a random colour lies behind each ray, as with objects.
        exposure: learn the exposure of each image.
        poses: learn corrections of the cameras' poses.
        camera_rate: learning rate of these, as a share of the field's.
        loss: weights of the terms.
    """

    steps: Count | None = None
    epochs: Positive = 50.0
    budget_minutes: Positive | None = None
    patience: Count | None = None
    batch_rays: Count = 1 << 14
    samples: Count = 1 << 16
    seed: Natural = 0
    learning_rate: Fraction = 1e-2
    final_rate: SomeShare = 0.03
    occupancy_resolution: Count = 128
    occupancy_every: Count = 16
    occupancy_start: Natural = 128
    min_weight: Share = 0.02
    sky: bool = True
    exposure: bool = False
    poses: bool = False
    camera_rate: Positive = 0.02
    loss: LossWeights = field(default_factory=LossWeights)


@dataclass(frozen=True)
class FitProgress:
    """State of a running fit.

    Attributes:
        step: done.
        steps: planned; None where epochs or time decide.
        fraction: of the whole fit, by steps or by time, whichever is further.
        loss: mean over the last steps.
        psnr_db: of the last batches, sRGB.
        elapsed_s: wall time.
        occupied: share of cells that are marched through.
        rays: rays in a step, mean over the last steps.
        samples: samples in a step that light reaches the eye from, mean over the last
            steps.
    """

    step: int
    steps: int | None
    fraction: float
    loss: float
    psnr_db: float
    elapsed_s: float
    occupied: float
    rays: float = 0.0
    samples: float = 0.0


@dataclass(frozen=True)
class FitResult:
    """A fitted field and how well it shows the images that it never saw.

    Attributes:
        field: the field, with its occupancy.
        psnr_heldout_db: mean over held-out views, sRGB.
        ssim_heldout: mean over held-out views.
        per_view: one entry for each held-out view.
        history: reports in order.
        wall_s: of the fit and the evaluation, interruptions not counted.
        steps: done.
        exposure: (n, 3), factors of linear radiance of the fitted images, or None.
        poses: (n, 4, 4), corrected camera_to_world of the fitted images, or None.
    """

    field: GridField | NGPField
    psnr_heldout_db: float
    ssim_heldout: float
    per_view: tuple[ViewScore, ...]
    history: tuple[FitProgress, ...]
    wall_s: float
    steps: int
    exposure: np.ndarray | None = None
    poses: np.ndarray | None = None

    def save(self, path: Path, provenance: Mapping[str, str]) -> None:
        """Write the field, with what it was fitted to and how well.

        Args:
            path: field file.
            provenance: source and settings, for the file's header.
        """
        header = {
            **provenance,
            "steps": str(self.steps),
            "held_out": "every 8th image, from the first",
            "frame": "that of the poses, right-handed",
            "psnr_heldout_db": f"{self.psnr_heldout_db:.3f}",
            "ssim_heldout": f"{self.ssim_heldout:.4f}",
        }
        self.field.info.update({f"fit.{key}": text for key, text in header.items()})
        save_field(path, self.field)


ProgressCallback = Callable[[FitProgress], None]


def no_progress(progress: FitProgress) -> None:
    """Show nothing."""
    del progress
