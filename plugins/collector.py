"""Rays of frames: marched ahead of a composite, and again for its gradient."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr

from mi_nerfattack.backend.freeze import freeze_method
from mi_nerfattack.render.backdrop import AbstractBackdrop, Layer
from mi_nerfattack.render.composite import AbstractComposite, Marches
from mi_nerfattack.render.march import RayGradient
from mi_nerfattack.render.rays import March, Rays, Task, TaskQueue
from mi_nerfattack.render.scene_march import AbstractSceneMarch


class RayCollector:
    """Marches rays that meet a field which asks for gradients, and have a cotangent.

    Args:
        composite: rule by which the layers become one colour.
        posed: the layers.
        stop: transmittance at which rays end.

    Attributes:
        waits: whether rays of several frames are marched together, until `finish`.
    """

    def __init__(
        self, composite: AbstractComposite, posed: Sequence[Layer], stop: float
    ) -> None:
        self.waits = False
        self._arguments = composite, list(posed), stop
        self._layers: tuple[int, ...] = ()
        self._frozen = freeze_method(self._accumulate, self._state)
        self._queue = TaskQueue()
        self._by_rays = freeze_method(self._march_back, self._rays_state)

    def add(self, rays: Rays, primal: Marches, cotangent: Marches) -> None:
        """Take rays; see :meth:`AbstractComposite.backward`."""
        composite, posed, _ = self._arguments
        for task in composite.tasks(posed, rays, primal, cotangent=cotangent):
            for ready in self._queue.add(task):
                self._launch(ready)
        if not self.waits:
            self.finish()

    def by_rays(
        self, rays: Rays, primal: Marches, cotangent: Marches, layers: Sequence[int]
    ) -> list[RayGradient]:
        """See :meth:`AbstractComposite.backward_rays`; marches at once."""
        self._layers = tuple(layers)
        # A render, which somebody may be recording, or what cannot be recorded
        if not self.waits or self._has_backdrop(layers):
            return self._march_back(rays, primal, cotangent)
        dr.make_opaque(rays, primal, cotangent)
        return self._by_rays(rays, primal, cotangent)

    def _march_back(
        self, rays: Rays, primal: Marches, cotangent: Marches
    ) -> list[RayGradient]:
        composite, posed, stop = self._arguments
        return composite.backward_rays(
            posed, rays, primal, cotangent=cotangent, stop=stop, layers=self._layers
        )

    def _rays_state(self, rays: Rays, *arguments: Any) -> list[Any]:
        """Return what the frozen :meth:`_march_back` reads beside its arguments."""
        composite, posed, stop = self._arguments
        del arguments
        sizes = dr.width(rays.direction), self._layers
        return [composite, stop, sizes, [item.state() for item in posed]]

    def clear(self) -> None:
        """Forget the rays that wait."""
        self._queue.clear()

    def finish(self) -> None:
        """March the rays that wait."""
        for task in self._queue.finish():
            self._launch(task)

    def _launch(self, task: Task) -> None:
        once = self._has_backdrop(task.fields)
        (self._accumulate if once else self._frozen)(task)

    def _has_backdrop(self, layers: Sequence[int]) -> bool:
        return any(isinstance(self._arguments[1][k], AbstractBackdrop) for k in layers)

    def _accumulate(self, task: Task) -> None:
        composite, posed, stop = self._arguments
        composite.accumulate([posed[k] for k in task.fields], task, stop)

    def _state(self, task: Task) -> list[Any]:
        """Return what the frozen :meth:`_accumulate` reads beside its argument."""
        composite, posed, stop = self._arguments
        return [composite, stop, task.fields, [posed[k].state() for k in task.fields]]


class FrozenComposite:
    """Renders a composite as a recording that is replayed, not traced again.

    Args:
        composite: rule by which the layers become one colour.
        posed: the layers.
        stop: transmittance at which rays end.
    """

    def __init__(
        self, composite: AbstractComposite, posed: Sequence[Layer], stop: float
    ) -> None:
        self._arguments = composite, list(posed), stop
        self._first: AbstractSceneMarch | None = None
        self._render = freeze_method(self._record, self._state)

    def render(self, rays: Rays) -> Marches:
        """See :meth:`AbstractComposite.render`; evaluates, so not while recording.

        Args:
            rays: n rays, without literals.
        """
        # Layers that are marched before the recording; None for those inside it
        _, posed, stop = self._arguments
        layers: list[March | None] = []
        for k, layer in enumerate(posed):
            if isinstance(layer, AbstractBackdrop):  # cannot be recorded
                layers.append(layer.march(rays, stop))
            else:
                layers.append(self._scene(rays) if k == 0 else None)
        return self._render(rays, layers)

    def _scene(self, rays: Rays) -> March | None:
        """March the first layer, mostly the scene, in the fastest way, if there is."""
        composite, posed, stop = self._arguments
        if posed[0].has_gradients:
            return None
        if self._first is None:
            self._first = composite.ahead(posed[0], stop)
        if self._first is None:
            return None
        return self._first.march(replace(rays, gains=rays.gains[:1]))

    def _record(self, rays: Rays, layers: list[March | None]) -> Marches:
        composite, posed, stop = self._arguments
        if not any(layers):
            return composite.render(posed, rays, stop)
        return composite.restore(posed, rays, layers, stop)

    def _state(self, rays: Rays, layers: list[March | None]) -> list[Any]:
        """Return what the frozen :meth:`_record` reads beside its arguments."""
        composite, posed, stop = self._arguments
        sizes = dr.width(rays.direction), [layer is None for layer in layers]
        return [composite, stop, sizes, [item.state() for item in posed]]
