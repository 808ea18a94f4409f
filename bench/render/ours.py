"""Our side: the exact composite of one field, as every part of the project renders."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from bench.ngp_data import NGPData
from bench.render.cameras import STOP, route_rays
from mi_nerfattack.render.composite import Marches
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.walk import Walk

NGP_PARAMETERS = ("table", "density_weights", "colour_weights")
Leaf = tuple[Callable[[], Any], Callable[[Any], None]]


class OurSide:
    """Our renderer with a field.

    Args:
        posed: the field.
        leaves: how to read and how to replace each array to differentiate by.
        rays: origins and directions, each (n, 3).
        seed: of the image's cotangent.
    """

    def __init__(
        self,
        posed: PosedField,
        leaves: list[Leaf],
        rays: tuple[np.ndarray, np.ndarray],
        seed: int = 0,
    ) -> None:
        self.posed, self.leaves = posed, leaves
        self.composite = InterleavedComposite()
        self.rays = self._rays(*rays)
        cotangent = np.random.default_rng(seed).normal(size=(3, len(rays[0])))
        self.cotangent = mi.Color3f(cotangent.astype(np.float32).tolist())
        self.marches: Any = None
        self.behind: Any = None
        dr.eval(self.cotangent)

    def _rays(self, origin: np.ndarray, direction: np.ndarray) -> Rays:
        # lists: memory from NumPy has an alignment of its own, and so its own kernels
        rays = Rays(
            mi.Point3f(origin.T.tolist()),
            mi.Vector3f(direction.T.tolist()),
            dr.opaque(mi.Float, dr.inf),
            jitter=dr.opaque(mi.Float, 0.5),
        )
        dr.eval(rays)
        return rays

    def forward(self) -> float:
        """Render a frame and return the seconds it took."""
        dr.sync_thread()
        start = time.perf_counter()
        self.marches = self.composite.render([self.posed], self.rays, STOP)
        total = self.marches.total
        self.behind = self.posed.field.background(self.rays.direction)
        image = total.radiance + (1 - total.opacity) * self.behind
        dr.eval(self.marches, self.behind, image)
        dr.sync_thread()
        return time.perf_counter() - start

    def backward(self) -> tuple[float, float]:
        """Differentiate a scalar of the image by all parameters.

        Returns:
            seconds of the derivative alone, and of everything from the rays on.
        """
        forward = self.forward()
        start = time.perf_counter()
        for read, replace in self.leaves:
            leaf = dr.detach(read(), preserve_type=True)
            leaf = type(leaf)(leaf)
            dr.enable_grad(leaf)
            replace(leaf)
            dr.set_grad(read(), dr.opaque(mi.Float, 0, dr.width(leaf)))
        by_opacity = -dr.dot(self.cotangent, self.behind)
        total = March(self.cotangent, by_opacity, dr.opaque(mi.Float, 0))
        self.composite.backward(
            [self.posed], self.rays, self.marches, Marches(total), STOP
        )
        dr.eval([dr.grad(read()) for read, _ in self.leaves])
        dr.sync_thread()
        alone = time.perf_counter() - start
        for read, replace in self.leaves:
            replace(dr.detach(read()))
        return alone, forward + alone

    def facts(self) -> dict[str, Any]:
        """Return samples, the share of rays that meet the field, and threads."""
        samples = count_samples(self.posed, self.rays, STOP).numpy().astype(np.float64)
        return {
            "samples": int(samples.sum()),
            "rays_met": float((samples > 0).mean()),
            "threads": dr.thread_count(),
        }

    def drjit_memory(self) -> float:
        """Return Dr.Jit's own peak during a forward and a backward pass, in MB."""
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        self.backward()
        return dr.detail.malloc_watermark(dr.backend_v(mi.Float)) / 1e6

    def kernels(self) -> int:
        """Move the camera, render, differentiate, and count what is compiled."""
        shift = dr.opaque(mi.Float, 0.01)
        self.rays.origin = self.rays.origin + shift
        dr.eval(self.rays)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            self.backward()
            history = dr.kernel_history((dr.KernelType.JIT,))
        return sum(not entry["cache_hit"] for entry in history)


def scene_side(path: str, width: int, height: int) -> OurSide:
    """Look along the route at a scene's field; differentiate by table and networks."""
    field = NGPData.read(Path(path)).field()

    def leaf(name: str) -> Leaf:
        return (
            lambda: field.parameters()[name],
            lambda value: field.set_parameter(name, value),
        )

    leaves = [leaf(name) for name in NGP_PARAMETERS]
    return OurSide(PosedField(field), leaves, route_rays(width, height))


@dr.syntax
def count_samples(posed: PosedField, rays: Rays, stop: float) -> mi.UInt32:
    """Count the evaluations of a field along each ray, (n,)."""
    walk, active = Walk.start(posed, rays)
    (path,) = walk.paths
    tau = mi.Float(0)  # optical depth so far
    count = mi.UInt32(0)
    while active:
        walk, segment = walk.next([posed], active)
        count += dr.select(segment.active, 1, 0)
        density = posed.eval(path.at(segment.t), path.heading, segment.active)[0]
        tau += segment.depths([density])[0]
        active = segment.active & (dr.exp(-tau) > stop)
    return count
