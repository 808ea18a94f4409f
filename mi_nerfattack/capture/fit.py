"""Fit radiance fields to posed images.

Every step draws a batch of pixels, marches their rays, compares with the images in
sRGB, and replays the march for the gradient: one kernel each whatever the number of
samples, and no tape. The held-out images (every 8th) are never fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.capture.evaluation import evaluate
from mi_nerfattack.capture.fit_cells import (
    cells_near_surfaces,
    depth_points,
    grid_shape,
    learned,
)
from mi_nerfattack.capture.fit_loss import loss_and_cotangent
from mi_nerfattack.capture.fit_options import (
    FitOptions,
    FitProgress,
    FitResult,
    ProgressCallback,
    no_progress,
)
from mi_nerfattack.capture.fit_order import coherent_order, sample_count
from mi_nerfattack.capture.fit_rays import RayBank, RayBatch
from mi_nerfattack.capture.frames import PosedImages, held_out
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.render.batched import march_gradient
from mi_nerfattack.render.march import STOP, Rays, march
from mi_nerfattack.render.posed import PosedField

_REPORT_EVERY = 25
_PROBE = 2048  # rays that tell how many samples a ray takes
_LEAST_RAYS = 64
_NETWORK_WARM_UP = 200  # steps
_STEPS_BEHIND = 4  # marching steps that a ray goes on behind a known surface
_MIN_OPACITY = 0.01  # of a step; occupancy drops cells that reach less


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
) -> FitResult:
    """Fit an NGP with a sky to images of a place.

    Args:
        images: RGB (or RGBA, whose alpha must then be 1 everywhere that matters).
        lower: corner of the field's box, metres; what lies outside becomes sky.
        upper: opposite corner, metres.
        layout: None for a small network (10 levels of 2^17, width 32).
        options: None for the defaults.
        depth: (n, height, width), metres along the ray, infinite in the sky, NaN
            where it is unknown; it places density and keeps free space free. None
            fits to colour alone.
        step_m: marching step; None for a thousandth of the longest edge.
        cone: growth of the step with distance.
        progress: called every 25 steps and at the end.

    Source: Mueller et al. 2022, section 5.4 and appendix.
    """
    options = options or FitOptions()
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    ngp = NGPField(
        layout or NGPLayout(10, 2, 17, 16, 2048, 32),
        low,
        high,
        step_m=float((high - low).max()) / 1000 if step_m is None else step_m,
        cone=cone,
        seed=options.seed,
    )
    names = tuple(ngp.parameters())
    fit = _Fit(ngp, images, options, depth, ngp.parameters(), whole_images=True)

    def install(values: Any, step: int) -> None:
        resting = step >= _NETWORK_WARM_UP and step % options.network_every != 0
        for name in names:
            rests = resting and name.endswith("weights")
            ngp.set_parameter(name, dr.detach(values[name]) if rests else values[name])

    return fit.run(install, progress)


def fit_grid(
    images: PosedImages,
    lower: Sequence[float] | np.ndarray,
    upper: Sequence[float] | np.ndarray,
    layout: GridLayout | None = None,
    options: FitOptions | None = None,
    depth: np.ndarray | None = None,
    progress: ProgressCallback = no_progress,
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
        depth: (n, height, width), metres along the ray, infinite beside the object.
        progress: called every 25 steps and at the end.

    Raises:
        InputError: the images have no alpha.

    Source: appendix A.4.1, B.1.
    """
    if images.images.shape[3] != 4:
        raise InputError("images: have no alpha channel; an object's grid needs RGBA")
    options = options or FitOptions()
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    grid = GridField(
        layout or GridLayout(), low, high, density_scale=1 / float((high - low).max())
    )
    fit = _Fit(grid, images, options, depth, {"packed": grid.packed}, False)

    def install(values: Any, step: int) -> None:
        del step
        grid.packed = values["packed"]

    def finish() -> None:
        unpack(grid, dr.detach(grid.packed))

    return fit.run(install, progress, finish)


def unpack(grid: GridField, packed: Any) -> None:
    """Make a packed array (4 n_vertices,) the density and texture of a grid field."""
    vertex = dr.arange(mi.UInt32, grid.n_vertices)
    density = dr.gather(mi.Float, packed, 4 * vertex)
    texture = grid.texture_gradient(packed)  # the colours' part of the array
    dr.eval(density, texture)
    grid.set_parameter("density", density)
    grid.set_parameter("texture", texture)


class _Fit:
    """One fit: data on the device, optimiser, occupancy, clock."""

    def __init__(
        self,
        radiance_field: GridField | NGPField,
        images: PosedImages,
        options: FitOptions,
        depth: np.ndarray | None,
        parameters: dict[str, Any],
        whole_images: bool,
    ) -> None:
        self.field, self.images, self.options = radiance_field, images, options
        self.held_out = held_out(len(images))
        fitted = np.setdiff1d(np.arange(len(images)), self.held_out)
        if len(fitted) == 0:
            raise InputError(f"images: {len(images)}; at least 2 are needed for a fit")
        box = None if whole_images else (radiance_field.lower, radiance_field.upper)
        self.bank = RayBank(images, fitted, depth, box)
        self.sky = whole_images
        self.posed = PosedField(radiance_field)
        self.rng = np.random.default_rng(options.seed)
        self.allowed = self._allowed(fitted, depth)
        radiance_field.occupancy = Occupancy(self.allowed)
        self.optimiser = mi.ad.Adam(
            lr=options.learning_rate,
            beta_1=0.9,
            beta_2=0.99,
            epsilon=1e-15,
            params=parameters,
            mask_updates=True,
        )
        self.random = self._streams(0)
        self.history: list[FitProgress] = []
        self.started = time.perf_counter()

    def _allowed(self, fitted: np.ndarray, depth: np.ndarray | None) -> np.ndarray:
        lower, upper = self.field.lower, self.field.upper
        shape = grid_shape(lower, upper, self.options.occupancy_resolution)
        if depth is None or np.isnan(depth[fitted]).any():
            return np.ones(shape, bool)  # surfaces may lie where depth is unknown
        points = depth_points(self.images, depth, fitted, self.field.step_m)
        cells = cells_near_surfaces(points, lower, upper, shape)
        if not cells.any():
            raise InputError(
                f"bounds: {lower.tolist()} to {upper.tolist()}; no depth lies inside"
            )
        return cells

    def _streams(self, done: int) -> Any:
        """Make the random numbers of a batch, as large as `samples` allows."""
        seed = np.random.SeedSequence([self.options.seed, done])
        start, probe_start = seed.generate_state(2, np.uint64)
        rays = self.bank.batch(self.bank.draw(_random(_PROBE, probe_start)))
        far = self._ends(rays.depth)
        count = sample_count(self.posed, rays.origin, rays.direction, far)
        size = int(self.options.samples / max(1.0, dr.mean(count)[0]))
        size = min(self.options.batch_rays, max(_LEAST_RAYS, size))
        return _random(size, start)

    def run(
        self,
        install: Callable[[Any, int], None],
        progress: ProgressCallback,
        finish: Callable[[], None] = lambda: None,
    ) -> FitResult:
        loss, square, done = mi.Float(0), mi.Float(0), 0
        since = 0
        while done < self.options.steps and self._fraction(done) < 1:
            self.optimiser.set_learning_rate(self._rate(done))
            install(self.optimiser, done)
            step_loss, step_square = self._step()
            self.optimiser.step(eval=False)
            loss, square = loss + step_loss, square + step_square
            dr.eval(loss, square)
            done, since = done + 1, since + 1
            if done % _REPORT_EVERY == 0 or done == self.options.steps:
                self._report(done, loss[0] / since, square[0] / since, progress)
                loss, square, since = mi.Float(0), mi.Float(0), 0
            self._update_occupancy(done)
        install({name: dr.detach(value) for name, value in self.optimiser.items()}, 0)
        finish()
        self.field.occupancy = self._learned()
        return self._result(done)

    def _step(self) -> tuple[Any, Any]:
        batch = self._batch()
        jitter = self.random.next_float32()
        shade = [self.random.next_float32() for _ in range(3)]
        if self.sky:
            background = self.field.background(batch.direction)
        else:
            background = mi.Color3f(*shade)
        far = self._ends(batch.depth)
        rays = Rays(batch.origin, batch.direction, far, jitter, mi.Bool(True))
        with dr.suspend_grad():
            primal = march(self.posed, *rays, STOP)
        dr.eval(batch, jitter, shade, primal, self.random)
        loss, square, cotangent = loss_and_cotangent(
            primal, background, batch, self.options.loss
        )
        # rays of a packet rarely meet in a vertex: adding them up first is no gain
        with dr.scoped_set_flag(dr.JitFlag.ScatterReduceLocal, False):
            march_gradient(self.posed, rays, primal, cotangent, STOP)
        return dr.mean(loss), dr.mean(square)

    def _batch(self) -> RayBatch:
        index = self.bank.draw(self.random)
        rays = self.bank.batch(index)
        order = coherent_order(
            self.posed, rays.origin, rays.direction, self._ends(rays.depth)
        )
        return self.bank.batch(dr.gather(mi.UInt32, index, order))

    def _ends(self, depth: Any) -> Any:
        """End rays a little behind known surfaces: more samples would teach nothing.

        Where depth is unknown (NaN) they go to the end of the box.
        """
        if depth is None:
            return mi.Float(dr.inf)
        step = dr.maximum(self.field.step_m, self.field.cone * depth)
        return dr.select(dr.isnan(depth), dr.inf, depth + _STEPS_BEHIND * step)

    def _fraction(self, done: int) -> float:
        fraction = done / self.options.steps
        if self.options.budget_minutes is not None:
            elapsed = time.perf_counter() - self.started
            fraction = max(fraction, elapsed / (60 * self.options.budget_minutes))
        return min(1.0, fraction)

    def _rate(self, done: int) -> float:
        decay = max(0.0, 2 * self._fraction(done) - 1)
        return self.options.learning_rate * self.options.final_rate**decay

    def _learned(self) -> Occupancy:
        threshold = -np.log1p(-_MIN_OPACITY) / self.field.step_m
        with dr.suspend_grad():
            return learned(self.field, self.allowed, threshold, self.rng)

    def _update_occupancy(self, done: int) -> None:
        late = done - self.options.occupancy_start
        if late >= 0 and late % self.options.occupancy_every == 0:
            self.field.occupancy = self._learned()
            self.random = self._streams(done)

    def _report(
        self, done: int, loss: float, square: float, progress: ProgressCallback
    ) -> None:
        fraction = self._fraction(done)
        elapsed = time.perf_counter() - self.started
        self.history.append(
            FitProgress(
                done,
                self.options.steps,
                fraction,
                loss,
                -10 * float(np.log10(max(square, 1e-12))),
                elapsed,
                elapsed * (1 - fraction) / fraction,
                self.field.occupancy.fraction,
            )
        )
        progress(self.history[-1])

    def _result(self, done: int) -> FitResult:
        scores = evaluate(self.field, self.images, self.held_out)
        return FitResult(
            self.field,
            float(np.mean([score.psnr_db for score in scores])),
            float(np.mean([score.ssim for score in scores])),
            tuple(scores),
            tuple(self.history),
            time.perf_counter() - self.started,
            done,
        )


def _random(count: int, state: np.uint64) -> Any:
    """Make `count` streams; the state does not become part of a kernel."""
    streams = mi.PCG32(count, dr.opaque(mi.UInt64, int(state)))
    dr.make_opaque(streams)
    return streams
