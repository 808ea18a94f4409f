"""Fit radiance fields to posed images.

Every step draws a batch of pixels, marches their rays, compares with the images in
sRGB, and accumulates gradients sample by sample: see `fit_points` for an NGP on a CPU,
`fit_march` for the rest. The held-out images (every 8th) are never fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.object_views import ObjectViews
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fit.checkpoint import FitCheckpoint
from mi_nerfattack.fit.options import (
    FitOptions,
    FitProgress,
    FitResult,
    ProgressCallback,
    no_progress,
)
from mi_nerfattack.fit.scores import evaluate
from mi_nerfattack.fit.training import Training

_REPORT_EVERY = 25
_BLACK = -30.0  # raw value of a colour
_SETTLED = 0.95  # of the fit, from where the occupancy stays as it is
_PROGRESS = 0.99  # of the loss, within `patience`


def fit_ngp(
    images: PosedImages,
    lower: Sequence[float] | np.ndarray,
    upper: Sequence[float] | np.ndarray,
    layout: NGPLayout | None = None,
    options: FitOptions | None = None,
    depth: np.ndarray | None = None,
    step_m: float | None = None,
    cone: float = 1 / 128,
    progress: ProgressCallback = no_progress,
    checkpoint: Path | None = None,
    anew: bool = False,
) -> FitResult:
    """Fit an NGP with a sky to images of a scene.

    Args:
        images: RGB or RGBA. With RGBA, as with `FitOptions.sky` off, a random colour
            lies behind each ray instead of the sky, which stays black.
        lower: corner of the field's box, metres; what lies outside becomes sky.
        upper: opposite corner, metres.
        layout: None for Instant-NGP's: 16 levels of 2^19, width 64. `NGPLayout.small()`
            is faster.
        options: None for the defaults.
        depth: (n, height, width), metres along the ray, infinite in the sky, NaN
            where it is unknown; it places density and keeps free space free. None
            fits to colour alone.
        step_m: marching step; None for a thousandth of the longest edge.
        cone: growth of the step with distance.
        progress: called every 25 steps and at the end.
        checkpoint: file that keeps the state of the fit, which goes on from it if it is
            there; it is the caller's to delete once the field is saved.
        anew: start again, and replace the checkpoint with the first that is saved.

    Returns:
        the field, and its scores on the held-out images.

    Raises:
        InputError: see `Training` and `FitCheckpoint`.

    Source: Mueller et al. 2022, section 5.4 and appendix.
    """
    options = options or FitOptions()
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    ngp = NGPField(
        layout or NGPLayout(),
        low,
        high,
        step_m=float((high - low).max()) / 1000 if step_m is None else step_m,
        cone=cone,
        seed=options.seed,
    )
    if images.channels == 4 or not options.sky:
        ngp.set_parameter("sky", dr.full(mi.Float, _BLACK, dr.width(ngp.sky)))
    training = Training(ngp, images, options, depth=depth)
    return _run(training, progress, checkpoint, anew=anew)


def fit_grid(
    images: PosedImages,
    lower: Sequence[float] | np.ndarray,
    upper: Sequence[float] | np.ndarray,
    layout: GridLayout | None = None,
    options: FitOptions | None = None,
    depth: np.ndarray | None = None,
    progress: ProgressCallback = no_progress,
    checkpoint: Path | None = None,
    anew: bool = False,
) -> FitResult:
    """Fit a decoder-free grid to images of an object with alpha.

    Behind the object lies a random colour, another one for each ray, so that density
    cannot hide in the background.

    Args:
        images: RGBA.
        lower: corner of the object's box, metres.
        upper: opposite corner, metres.
        layout: None for 16 levels from 16 to 64.
        options: None for the defaults.
        depth: (n, height, width), metres along the ray, infinite where the ray misses
            the object.
        progress: as of `fit_ngp`.
        checkpoint: as of `fit_ngp`.
        anew: as of `fit_ngp`.

    Returns:
        the field, and its scores on the held-out images.

    Raises:
        InputError: the images have no alpha; and see `Training`, `FitCheckpoint`.

    Source: appendix A.4.1, B.1.
    """
    if images.channels != 4:
        raise InputError("images: have no alpha channel; an object's grid needs RGBA")
    options = options or FitOptions()
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    grid = GridField(
        layout or GridLayout(), low, high, density_scale=1 / float((high - low).max())
    )
    training = Training(grid, images, options, depth=depth, box_only=True)
    return _run(training, progress, checkpoint, anew=anew)


def fit_object(
    views: ObjectViews,
    resolution: int,
    options: FitOptions,
    progress: ProgressCallback = no_progress,
    checkpoint: Path | None = None,
    anew: bool = False,
) -> FitResult:
    """Fit a grid to views of an object, in a box with room around it.

    Args:
        views: with the object's box, which the field's header keeps.
        resolution: of the finest level.
        options: of the fit.
        progress: as of `fit_ngp`.
        checkpoint: as of `fit_ngp`.
        anew: as of `fit_ngp`.
    """
    # room for the outermost vertices' own cells
    room = 2.0 / resolution * float((views.upper - views.lower).max())
    result = fit_grid(
        views.images,
        views.lower - room,
        views.upper + room,
        layout=GridLayout(16, 16, resolution),
        options=options,
        depth=views.depth,
        progress=progress,
        checkpoint=checkpoint,
        anew=anew,
    )
    for name in ("lower", "upper"):
        corner = " ".join(map(repr, getattr(views, name).tolist()))
        result.field.info[f"provenance.object_{name}"] = corner
    return result


def _run(
    training: Training, progress: ProgressCallback, path: Path | None, anew: bool
) -> FitResult:
    """Do steps until the fit is done; interrupted, keep its state."""
    checkpoint = None if path is None else FitCheckpoint(path, training, anew)
    clock = _Clock(training, checkpoint)
    try:
        while not clock.is_over():
            training.do_step(clock.rate())
            if clock.fraction() < _SETTLED:
                training.update_occupancy()
            if training.step % _REPORT_EVERY == 0:
                progress(clock.report())
                if checkpoint is not None:
                    checkpoint.save_if_due(clock.elapsed, clock.history)
        if clock.has_news:
            progress(clock.report())
    except BaseException as error:
        if checkpoint is not None and is_interrupt(error):
            training.collect()
            checkpoint.save(clock.elapsed, clock.history)
        raise
    if checkpoint is not None:
        checkpoint.save(clock.elapsed, clock.history)  # scoring may be interrupted
    training.finish()
    scores = evaluate(
        training.field, training.images, training.held_out, depth=training.depth
    )
    poses = training.images.camera_to_world[training.fitted]
    return FitResult(
        field=training.field,
        psnr_heldout_db=float(np.mean([score.psnr_db for score in scores])),
        ssim_heldout=float(np.mean([score.ssim for score in scores])),
        per_view=tuple(scores),
        history=tuple(clock.history),
        wall_s=clock.elapsed,
        steps=training.step,
        exposure=training.cameras.gains(),
        poses=training.cameras.poses(poses),
    )


class _Clock:
    """How far a fit is, by steps, rays or time, and what follows from that."""

    def __init__(self, training: Training, checkpoint: FitCheckpoint | None) -> None:
        self.training, self.options = training, training.options
        before = 0.0 if checkpoint is None else checkpoint.elapsed_s
        self.history = [] if checkpoint is None else list(checkpoint.history)
        self._start = time.perf_counter() - before
        self._reported = training.step
        self._is_stuck = False

    @property
    def has_news(self) -> bool:
        """Whether steps were done since the last report."""
        return self.training.step > self._reported

    @property
    def elapsed(self) -> float:
        """Wall time in seconds."""
        return time.perf_counter() - self._start

    def fraction(self) -> float:
        """Return how much of the fit is done, in [0, 1]."""
        options = self.options
        if options.steps is not None:
            fraction = self.training.step / options.steps
        else:
            fraction = self.training.rays / (options.epochs * self.training.pixels)
        if options.budget_minutes is not None:
            fraction = max(fraction, self.elapsed / (60 * options.budget_minutes))
        return min(1.0, fraction)

    def is_over(self) -> bool:
        """Tell whether the fit has ended."""
        return self._is_stuck or self.fraction() >= 1

    def rate(self) -> float:
        """Return the learning rate."""
        decay = max(0.0, 2 * self.fraction() - 1)
        return self.options.learning_rate * self.options.final_rate**decay

    def report(self) -> FitProgress:
        """Sum up the steps since the last report."""
        total = self.training.collect()
        rays = int(total.rays[0])
        if rays == 0:
            raise InputError(
                f"samples: {self.options.samples}; no ray has room for its samples, "
                "give a larger number or a longer marching step (step_m)"
            )
        steps = max(1, self.training.step - self._reported)
        self._reported = self.training.step
        square = float(total.square[0]) / rays
        at = FitProgress(
            step=self.training.step,
            steps=self.options.steps,
            fraction=self.fraction(),
            loss=float(total.loss[0]) / rays,
            psnr_db=-10 * float(np.log10(max(square, 1e-12))),
            elapsed_s=self.elapsed,
            occupied=self.training.field.occupancy.fraction,
            rays=rays / steps,
            samples=int(total.visible[0]) / steps,
        )
        self.history.append(at)
        self._is_stuck = self._stands_still()
        return at

    def _stands_still(self) -> bool:
        if self.options.patience is None:
            return False
        span = max(1, self.options.patience // _REPORT_EVERY)
        if len(self.history) < 2 * span:
            return False
        losses = [at.loss for at in self.history[-2 * span :]]
        return sum(losses[span:]) > _PROGRESS * sum(losses[:span])
