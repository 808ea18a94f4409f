"""The state of a running fit, and its steps."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import adam_tensors, load_adam
from mi_nerfattack.capture.inputs import depth_rays
from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.ngp import NGPField
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.fit.batch import BatchSource, Score, mean_samples
from mi_nerfattack.fit.cameras import EXPOSURE, POSES, CameraCorrections
from mi_nerfattack.fit.cells import cells_near_surfaces, grid_shape
from mi_nerfattack.fit.occupancy import RunningOccupancy, seen_cells
from mi_nerfattack.fit.options import FitOptions
from mi_nerfattack.fit.pruning import dense_octants, seen_matter
from mi_nerfattack.fit.rays import RayBank
from mi_nerfattack.fit.scores import MIN_EDGE_PX
from mi_nerfattack.fit.steps.march import MarchStep
from mi_nerfattack.fit.steps.points import PointStep

_FULL = 0.9  # share of the samples that a batch is made to need
_LEAST_RAYS = 64
_LISTED = 2  # room for samples before visibility is known, against that after
_STATE = ("step", "rays", "limit")


class Training:
    """A field, the images it is fitted to, an optimiser, and how far it has come.

    Args:
        radiance_field: is changed in place.
        images: posed images; every 8th is held out.
        options: of the fit.
        depth: (n, height, width), metres along the ray, NaN where unknown, or None.
        box_only: draw only rays that meet the field's box, as for an object.

    Attributes:
        step: steps done.
        rays: drawn so far.
        limit: rays of the next step.

    Raises:
        InputError: too few or too small images, depth that is not positive, a box that
            no image or depth reaches, or an option that has no use for this fit.
    """

    def __init__(
        self,
        radiance_field: GridField | NGPField,
        images: PosedImages,
        options: FitOptions,
        depth: np.ndarray | None = None,
        box_only: bool = False,
    ) -> None:
        self.field, self.images, self.options = radiance_field, images, options
        self.depth = depth
        self.held_out = held_out(len(images))
        self.fitted = np.setdiff1d(np.arange(len(images)), self.held_out)
        if len(self.fitted) == 0:
            raise InputError(f"images: {len(images)}; at least 2 are needed for a fit")
        for image in images.images:
            if min(image.shape[:2]) < MIN_EDGE_PX:
                raise InputError(
                    f"images: {image.shape[1]} x {image.shape[0]} px; SSIM takes at "
                    f"least {MIN_EDGE_PX} px each way"
                )
        if depth is not None and any((each <= 0).any() for each in depth):
            raise InputError("depth: holds values of 0 or less; NaN says unknown")
        if options.exposure and images.channels == 4:
            raise InputError("exposure: needs images without alpha, as of a camera")
        learn = [EXPOSURE] * options.exposure + [POSES] * options.poses
        self.cameras = CameraCorrections(len(self.fitted), learn)
        box = (radiance_field.lower, radiance_field.upper) if box_only else None
        bank = RayBank(images, self.fitted, depth, box=box, corrections=self.cameras)
        self.pixels = bank.count
        self.occupancy = RunningOccupancy(
            radiance_field, self._allowed(depth), options.seed
        )
        sky = options.sky and not bank.has_alpha
        source = BatchSource(bank, options.loss, radiance_field, sky=sky)
        self._march: MarchStep | PointStep = MarchStep(radiance_field, source)
        on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
        if isinstance(radiance_field, NGPField) and on_cpu:
            room = options.samples
            self._march = PointStep(
                radiance_field, source, _LISTED * room, visible=room
            )
        elif options.loss.spread > 0:
            raise InputError("spread: only an NGP on a CPU (LLVM) is fitted with it")
        self.optimiser = mi.ad.Adam(
            lr=options.learning_rate,
            beta_1=0.9,
            beta_2=0.99,
            epsilon=1e-15,
            params=self._values(),
            mask_updates=True,
        )
        self.step, self.rays = 0, 0
        self._total = Score()
        self.random = mi.PCG32(options.batch_rays, options.seed + 1)  # pyright: ignore[reportCallIssue]
        dr.make_opaque(self.random)
        self.limit = self._size(mean_samples(self._march.posed, source, options.seed))

    def _allowed(self, depth: np.ndarray | None) -> np.ndarray:
        lower, upper = self.field.lower, self.field.upper
        n = self.options.occupancy_resolution
        # the levels of a grid divide all edges alike
        is_grid = isinstance(self.field, GridField)
        shape = (n, n, n) if is_grid else grid_shape(lower, upper, n)
        if depth is None or any(np.isnan(depth[i]).any() for i in self.fitted):
            cells = seen_cells(
                self.images, self.fitted, lower, upper=upper, shape=shape
            )
            if not cells.any():
                raise InputError(
                    f"bounds: {lower.tolist()} to {upper.tolist()}; no two images see "
                    "a part of this box, give bounds around what the cameras look at"
                )
            return cells
        views = depth_rays(self.images, depth, self.fitted)
        cells = cells_near_surfaces(views, self.field, shape)
        if not cells.any():
            raise InputError(
                f"bounds: {lower.tolist()} to {upper.tolist()}; no depth lies inside"
            )
        return cells

    def _values(self) -> dict[str, Any]:
        """Return everything that is learned, by name."""
        if isinstance(self.field, GridField):
            return {"packed": self.field.packed, **self.cameras.values}
        return {**self.field.parameters(), **self.cameras.values}

    def _install(self, values: Any) -> None:
        """Give field and cameras the optimiser's values."""
        self.cameras.install(values)
        if isinstance(self.field, GridField):
            self.field.packed = values["packed"]
            return
        for name in self.field.parameters():
            self.field.set_parameter(name, values[name])

    def do_step(self, rate: float) -> None:
        """Draw rays, accumulate gradients and update.

        Args:
            rate: learning rate of the field; that of the cameras is a share of it.
        """
        rates: dict[str, float] = dict.fromkeys(self._values(), rate)
        for name in self.cameras.values:
            rates[name] = rate * self.options.camera_rate
        self.optimiser.set_learning_rate(rates)
        self._install(self.optimiser)
        for name in rates:
            value = self.optimiser[name]
            dr.set_grad(value, dr.opaque(mi.Float, 0, dr.width(value)))
        limit = dr.opaque(mi.UInt32, self.limit)
        score, self.random = self._march(self.random, limit)
        self.optimiser.step(eval=False)
        self._total = self._total.plus(score)
        dr.eval(self.optimiser, self._total, self.random)
        self.step += 1

    def collect(self) -> Score:
        """Return the sums since the last call, and size the next batches by them."""
        total, self._total = self._total, Score()
        rays = int(total.rays[0])
        self.rays += rays
        listed = int(total.listed[0]) / max(rays, 1)
        visible = int(total.visible[0]) / max(rays, 1)
        # a batch that overflowed tells of its first rays alone: grow gently
        size = self._size(max(visible, listed / _LISTED))
        self.limit = min(size, 2 * self.limit)
        return total

    def _size(self, samples: float) -> int:
        """Return how many rays of so many samples fill a batch."""
        size = int(_FULL * self.options.samples / max(samples, 1e-6))
        return min(self.options.batch_rays, max(_LEAST_RAYS, size))

    def update_occupancy(self) -> None:
        """Look at some cells now and then, as the options say."""
        late = self.step - self.options.occupancy_start
        if late >= 0 and late % self.options.occupancy_every == 0:
            self.occupancy.update(self.step)
            if late % (4 * self.options.occupancy_every) == 0:
                self.occupancy.install()

    def finish(self) -> None:
        """Detach the field from the optimiser.

        It keeps the occupancy of the last steps: density in other cells has had no
        part in what was compared. Cells of a grid that do not show are emptied, since
        files keep what cells read, and a thinner shell needs half the step; marches
        through an NGP also skip thin octants.
        """
        self._install({k: dr.detach(self.optimiser[k]) for k in self._values()})
        if isinstance(self.field, GridField):
            unpack(self.field, dr.detach(self.field.packed))
            self.field.refine(
                self.field.step_m / 2
            )  # for the thinner shell that is left
            least, seed = self.options.min_weight, self.options.seed
            shown = seen_matter(
                self.field, self.images, self.fitted, min_weight=least, seed=seed
            )
            self.field.occupy(Occupancy(shown))
        else:
            cells = self.field.window.cells
            self.field.occupancy = Occupancy(cells, dense_octants(self.field))

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the complete state."""
        result = {
            "random.state": self.random.state.numpy(),
            "random.inc": self.random.inc.numpy(),
            "density": self.occupancy.density,
            "cells": np.packbits(self.field.occupancy.cells.ravel()),
            "state": np.array([getattr(self, name) for name in _STATE], np.int64),
        }
        copies = {name: np.array(value) for name, value in result.items()}
        return copies | adam_tensors(self.optimiser)

    def load_tensors(self, tensors: dict[str, np.ndarray]) -> None:
        """Continue from what :meth:`tensors` returned."""
        counter = type(self.random.state)
        self.random.state = counter(tensors["random.state"].tolist())
        self.random.inc = counter(tensors["random.inc"].tolist())
        dr.make_opaque(self.random)
        self.occupancy.restore(tensors["density"], tensors["cells"])
        for name, value in zip(_STATE, tensors["state"], strict=True):
            setattr(self, name, int(value))
        load_adam(self.optimiser, tensors)


def unpack(grid: GridField, packed: Any) -> None:
    """Make a packed array (4 n_vertices,) the density and texture of a grid field."""
    vertex = dr.arange(mi.UInt32, grid.n_vertices)
    density = dr.gather(mi.Float, packed, 4 * vertex)
    texture = grid.texture_gradient(packed)  # the colours' part of the array
    dr.eval(density, texture)
    grid.set_parameter("density", density)
    grid.set_parameter("texture", texture)
