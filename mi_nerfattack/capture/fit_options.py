"""Settings, progress and result of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mi_nerfattack.capture.evaluation import ViewScore
from mi_nerfattack.capture.fit_loss import LossWeights
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.ngp import NGPField


@dataclass(frozen=True)
class FitOptions:
    """How a field is fitted.

    Attributes:
        steps: of the optimiser.
        budget_minutes: end after this time if `steps` are not done by then; the
            learning rate then decays by time. None sets no limit.
        batch_rays: rays a step, at most.
        samples: of a step, about; as long as the occupancy is full, and rays therefore
            long, a batch has fewer rays.
        seed: of initialisation, pixels, sample positions and backgrounds. Results
            still differ in the last bits unless Dr.Jit runs on one thread.
        learning_rate: of Adam, constant in the first half of the fit.
        final_rate: share of `learning_rate` that is left at the end; between, it
            falls exponentially.
        occupancy_resolution: cells along the longest edge of the box.
        occupancy_every: steps between two updates of the occupancy.
        occupancy_start: steps before the first one.
        network_every: of an NGP, steps between two updates of the networks' weights,
            whose gradient costs as much as that of the table; every step at first.
        loss: weights of the terms.
    """

    steps: int = 2000
    budget_minutes: float | None = None
    batch_rays: int = 4096
    samples: int = 1 << 16
    seed: int = 0
    learning_rate: float = 1e-2
    final_rate: float = 0.03
    occupancy_resolution: int = 128
    occupancy_every: int = 250
    occupancy_start: int = 250
    network_every: int = 4
    loss: LossWeights = field(default_factory=LossWeights)

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in (
            "steps",
            "batch_rays",
            "samples",
            "occupancy_resolution",
            "occupancy_every",
        ):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)}; must be at least 1")
        if self.budget_minutes is not None and not self.budget_minutes > 0:
            raise InputError(f"budget_minutes: {self.budget_minutes}; must be positive")
        if not 0 < self.learning_rate < 1:
            raise InputError(f"learning_rate: {self.learning_rate}; must be in (0, 1)")


@dataclass(frozen=True)
class FitProgress:
    """State of a running fit.

    Attributes:
        step, steps: done, and planned.
        fraction: of the whole fit, by steps or by time, whichever is further.
        loss: mean over the last steps.
        psnr_db: of the last batches, sRGB.
        elapsed_s, remaining_s: wall time.
        occupied: share of cells that are marched through.
    """

    step: int
    steps: int
    fraction: float
    loss: float
    psnr_db: float
    elapsed_s: float
    remaining_s: float
    occupied: float


@dataclass(frozen=True)
class FitResult:
    """A fitted field and how well it shows the images that it never saw.

    Attributes:
        field: the field, with its occupancy.
        psnr_heldout_db: mean over held-out views, sRGB.
        ssim_heldout: mean over held-out views.
        per_view: one entry for each held-out view.
        history: reports in order.
        wall_s: of the fit and the evaluation.
        steps: done.
    """

    field: GridField | NGPField
    psnr_heldout_db: float
    ssim_heldout: float
    per_view: tuple[ViewScore, ...]
    history: tuple[FitProgress, ...]
    wall_s: float
    steps: int


ProgressCallback = Callable[[FitProgress], None]


def no_progress(progress: FitProgress) -> None:
    """Show nothing."""
    del progress
