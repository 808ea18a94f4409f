"""Our side of `bench fit`: the training steps of `fit.fit.fit_ngp`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from bench.ngp_data import NGPData
from bench.torch.fit import COUNTED_RAYS, Pictures
from bench.worker import Clock
from mi_nerfattack.capture.inputs import find_bounds, read_depth
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fit.options import FitOptions
from mi_nerfattack.fit.training import Training
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays

RATE = 1e-2


class OurTrainer:
    """Training steps of ours.

    Args:
        folder: of the posed images, without alpha.
        step_m: marching step.
        layout: values of the network's layout.
        rays: of a step at most.
        samples: of a step, which as many rays as fill it take.
    """

    def __init__(
        self,
        folder: str,
        step_m: float,
        layout: Sequence[int],
        rays: int,
        samples: int,
    ) -> None:
        self.images = read_images(Path(folder))
        depth = read_depth(Path(folder), self.images)
        lower, upper = find_bounds(self.images, depth)
        self.field = NGPField(
            NGPLayout(*layout), lower, upper, step_m=step_m, cone=1 / 128
        )
        options = FitOptions(batch_rays=rays, samples=samples)
        self.training = Training(self.field, self.images, options)  # without depth
        self.rays = self.training.limit

    def steps(self, count: int) -> dict[str, float]:
        """Do training steps.

        Returns:
            ``seconds``, ``cpu_seconds`` and ``loss`` of a step, means.
        """
        self.training.collect()
        self.training.limit = self.rays
        dr.sync_thread()
        clock = Clock()
        for _ in range(count):
            self.training.do_step(RATE)
        dr.sync_thread()
        result = clock.per_step(count)
        total = self.training.collect()
        return {**result, "loss": total.loss[0] / total.rays[0]}

    def train(self, count: int) -> int:
        """Do steps as a fit does, with updates of the occupancy.

        Returns:
            rays of the next step.
        """
        for _ in range(count):
            self.training.do_step(RATE)
            self.training.update_occupancy()
        self.training.collect()
        self.rays = self.training.limit
        return self.rays

    def write_pictures(self, path: str) -> None:
        """Write the pixels that are fitted to."""
        pictures_of(self.images, self.training.fitted).write(Path(path))

    def write_field(self, path: str) -> None:
        """Write the field as it is."""
        for name in self.field.parameters():
            value = dr.detach(self.training.optimiser[name])
            self.field.set_parameter(name, value)
        NGPData.of(self.field).write(Path(path))

    def facts(self) -> dict[str, Any]:
        """Return rays and samples of a step, and settings; does some steps."""
        self.training.collect()
        self.training.limit = self.rays
        count = -(-COUNTED_RAYS // self.rays)
        for _ in range(count):
            self.training.do_step(0.0)
        total = self.training.collect()
        return {
            "rays": self.rays,
            "rays_used": int(total.rays[0]) / count,
            "samples": int(total.visible[0]) * self.rays / int(total.rays[0]),
            "threads": dr.thread_count(),
            "occupied": self.field.occupancy.fraction,
        }


def pictures_of(images: PosedImages, indices: np.ndarray) -> Pictures:
    """Make pixels and rays of some images.

    Args:
        images: posed images; alpha is left out.
        indices: of the images.
    """
    colour, direction = [], []
    for index in indices:
        origin, rotation = pose_arrays(images.camera_to_world[index])
        rays = generate_rays(images.camera_of(index), origin, rotation, n_poses=1)[1]
        direction.append(rays.numpy().T.astype(np.float32))
        colour.append(images.images[index][..., :3].reshape(-1, 3))
    centre = images.camera_to_world[indices, :3, 3].astype(np.float32)
    return Pictures(np.stack(colour), centre, np.stack(direction))
