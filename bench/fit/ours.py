"""Our side of `bench fit`: the training steps of `fit.fit.fit_ngp`."""

from __future__ import annotations

import cProfile
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from bench.full_ngp import NGPData
from bench.render.sides import COUNTED_RAYS, AbstractTrainer, Clock
from bench.torch.fit import Pictures
from mi_nerfattack.capture.inputs import find_bounds, read_depth
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.cpu.networks import Networks
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fit.options import FitOptions
from mi_nerfattack.fit.training import Training
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import generate_rays, pose_arrays

RATE = 1e-2
_PROFILED = 4  # steps
PARTS = (
    "rays",  # drawn, sought in the occupancy, composited, compared
    "table",
    "networks",
    "activations",
    "table, derivative",
    "optimiser",
    "copies and sums",
    "host",
)
NETWORK_CALLS = {
    method.__code__
    for method in (Networks.raw_density, Networks.forward, Networks.backward)
}
ENCODING_OPERATIONS = 600  # of a kernel; those of activations are smaller


class OurTrainer(AbstractTrainer):
    """Training steps of ours.

    Args:
        job: file that names folder, long_edge, step_m and layout, and the most rays
            and samples of a step.
    """

    def __init__(self, job: Path) -> None:
        document = files.read_json(job)
        self.images = read_images(document["folder"], document["long_edge"])
        if self.images.channels == 4:
            raise InputError(
                f"{document['folder']}: images have alpha, behind which a fit puts "
                "random colours and the peers do not; give images without alpha"
            )
        depth = read_depth(document["folder"], self.images)
        lower, upper = find_bounds(self.images, depth)
        step_m = document["step_m"] or float((upper - lower).max()) / 1000
        layout = NGPLayout(**document["layout"])
        self.field = NGPField(layout, lower, upper, step_m=step_m, cone=1 / 128)
        options = FitOptions(batch_rays=document["rays"], samples=document["samples"])
        self.training = Training(self.field, self.images, options)  # without depth
        self.rays = self.training.limit

    def steps(self, count: int) -> dict[str, float]:
        """See :meth:`AbstractTrainer.steps`."""
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
            "samples": int(total.kept[0]) * self.rays / int(total.rays[0]),
            "threads": dr.thread_count(),
            "occupied": self.field.occupancy.fraction,
        }

    def breakdown(self) -> dict[str, float]:
        """Tell where the time of a step goes, microseconds a sample.

        From Dr.Jit's kernel history, by the width of the launches, and from Python's
        profiler for the networks, whose products of matrices are NumPy's.
        """
        samples, profile = self.facts()["samples"], cProfile.Profile()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            profile.enable()
            seconds = self.steps(_PROFILED)["seconds"]
            profile.disable()
            history = dr.kernel_history()
        parts: dict[str, float] = dict.fromkeys(PARTS, 0.0)
        for entry in history:
            parts[self._part(entry)] += entry["execution_time"]
        parts["networks"] = 1e3 * sum(
            entry.totaltime
            for entry in profile.getstats()
            if entry.code in NETWORK_CALLS
        )
        parts["host"] = 1e3 * seconds * _PROFILED - sum(parts.values())
        return {k: 1e3 * v / (_PROFILED * samples) for k, v in parts.items()}

    def _part(self, entry: dict[str, Any]) -> str:
        """Sort a launch into `PARTS`."""
        options, size = self.training.options, entry["size"]
        widths = [dr.width(value) for value in self.training.optimiser.values()]
        if entry["type"] != dr.KernelType.JIT:
            return "copies and sums"
        if size in widths:
            return "optimiser"
        if size <= options.batch_rays:
            return "rays"
        if entry["operation_count"] < ENCODING_OPERATIONS:
            return "activations"
        return "table, derivative" if size == options.samples else "table"


def pictures_of(images: PosedImages, indices: np.ndarray) -> Pictures:
    """Make pixels and rays of some images.

    Args:
        images: posed images; alpha is left out.
        indices: of the images.
    """
    colour, direction = [], []
    for index in indices:
        origin, rotation = pose_arrays(images.camera_to_world[index])
        rays = generate_rays(images.camera_of(index), origin, rotation, 1)[1]
        direction.append(rays.numpy().T.astype(np.float32))
        colour.append(images.images[index][..., :3].reshape(-1, 3))
    centre = images.camera_to_world[indices, :3, 3].astype(np.float32)
    return Pictures(np.stack(colour), centre, np.stack(direction))
