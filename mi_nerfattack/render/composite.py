"""Composites of several fields along a ray: what is seen, and its derivatives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from mi_nerfattack.render.backdrop import AbstractBackdrop, Layer, fields_by_rays
from mi_nerfattack.render.march import RayGradient, march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import (
    March,
    Rays,
    Sparse,
    Task,
    select,
    shares_by_depth,
)
from mi_nerfattack.render.scene_march import AbstractSceneMarch, scene_march


@dataclass
class Marches:
    """What a composite gives.

    Attributes:
        total: of everything along a ray.
        layers: one march a layer, in their order.
    """

    total: March = field(default_factory=March)
    layers: list[March] = field(default_factory=list)

    def copy(self) -> Marches:
        """Return the same values with no derivatives attached."""
        return Marches(self.total.copy(), [layer.copy() for layer in self.layers])


class AbstractComposite(ABC):
    """Rule by which several layers along a ray, mostly fields, become one colour.

    None of the methods is differentiable by Dr.Jit: :meth:`forward`,
    :meth:`backward` and :meth:`backward_rays` are the derivatives of :meth:`render`.
    """

    def check(self, posed: Sequence[Layer]) -> None:
        """Raise InputError if a layer is not among those that the rule can take."""
        del posed

    @abstractmethod
    def render(self, posed: Sequence[Layer], rays: Rays, stop: float) -> Marches:
        """March rays through layers.

        Args:
            posed: the layers, at least one.
            rays: n rays.
            stop: transmittance below which a ray ends.
        """

    @abstractmethod
    def forward(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        stop: float,
    ) -> Marches:
        """Return tangents of what was seen, from tangents of the fields' parameters.

        Args:
            posed: as given to :meth:`render`.
            rays: as given to :meth:`render`.
            primal: what :meth:`render` returned.
            stop: as given to :meth:`render`.
        """

    def ahead(self, scene: Layer, stop: float) -> AbstractSceneMarch | None:
        """Return a way to march the first layer by itself, for :meth:`restore`.

        Args:
            scene: the first layer; its parameters are constants.
            stop: transmittance below which a ray ends.

        Returns:
            None where the rule marches all layers together, or the layer is no field.
        """
        del scene, stop

    def shares(self, marches: Marches) -> list[March]:
        """Return what of each layer reaches the camera; they add up to the total."""
        return marches.layers

    @abstractmethod
    def keep(self, marches: Marches) -> Any:
        """Return the part of what was seen that is costly to find again."""

    @abstractmethod
    def restore(
        self, posed: Sequence[Layer], rays: Rays, record: Any, stop: float
    ) -> Marches:
        """Return what :meth:`render` gave, from what :meth:`keep` kept of it."""

    def backward(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        cotangent: Marches,
        stop: float,
    ) -> None:
        """Accumulate gradients of the parameters of the fields that ask for them.

        Args:
            posed: as given to :meth:`render`.
            rays: as given to :meth:`render`.
            primal: what :meth:`render` returned.
            cotangent: derivative of the objective by what was seen, per ray; no
                layers where it depends on the total alone.
            stop: as given to :meth:`render`.
        """
        for task in self.tasks(posed, rays, primal, cotangent=cotangent):
            self.accumulate([posed[k] for k in task.fields], task, stop)

    @abstractmethod
    def tasks(
        self, posed: Sequence[Layer], rays: Rays, primal: Marches, cotangent: Marches
    ) -> list[Task]:
        """Say what :meth:`backward` has to march again.

        These are the rays that meet a field which asks for gradients, no others. How
        many there are is known after this, so that :meth:`accumulate` can be frozen.
        """

    @abstractmethod
    def accumulate(self, posed: Sequence[Layer], task: Task, stop: float) -> None:
        """Do one task of :meth:`backward`; `posed` are the fields that it names."""

    @abstractmethod
    def backward_rays(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        cotangent: Marches,
        stop: float,
        layers: Sequence[int],
    ) -> list[RayGradient]:
        """Do what :meth:`backward` does, and differentiate by the rays.

        Args:
            posed: as given to :meth:`render`.
            rays: as given to :meth:`render`.
            primal: what :meth:`render` returned.
            cotangent: derivative of the objective by what was seen, per ray; no
                layers where it depends on the total alone.
            stop: as given to :meth:`render`.
            layers: indices of the layers that matter, among them those that ask for
                gradients.

        Returns:
            the objective's derivatives by origin and direction, (3, n), as each of
            these layers sees them.
        """


class DepthComposite(AbstractComposite):
    """Every layer by itself, then folded front to back by expected depth.

    Exact where layers do not overlap along a ray; see ``depth_composite``.
    Takes backdrops as well as fields. Cost: one march a layer. Source: appendix A.4
    to A.6.
    """

    def render(self, posed: Sequence[Layer], rays: Rays, stop: float) -> Marches:
        """See :meth:`AbstractComposite.render`; a layer is the field alone."""
        layers = [_see(item, rays, stop) for item in rays.light(posed)]
        return Marches(depth_composite(layers), layers) if layers else nothing(rays)

    def ahead(self, scene: Layer, stop: float) -> AbstractSceneMarch | None:
        """See :meth:`AbstractComposite.ahead`."""
        return scene_march(scene, stop) if isinstance(scene, PosedField) else None

    def shares(self, marches: Marches) -> list[March]:
        """See :meth:`AbstractComposite.shares`."""
        return shares_by_depth(marches.layers)

    def keep(self, marches: Marches) -> Any:
        """See :meth:`AbstractComposite.keep`: 20 bytes a layer and ray that meets it.

        A ray that meets a layer is 24 bytes where these are less than half of the rays.
        """
        layers = [Sparse.of(layer) for layer in marches.layers]
        dr.eval(layers)
        return layers

    def restore(
        self, posed: Sequence[Layer], rays: Rays, record: Any, stop: float
    ) -> Marches:
        """See :meth:`AbstractComposite.restore`; marches the layers that are None."""
        layers = [
            _see(item, rays, stop) if layer is None else layer
            for item, layer in zip(rays.light(posed), map(_full, record), strict=True)
        ]
        return Marches(depth_composite(layers), layers) if layers else nothing(rays)

    def forward(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        stop: float,
    ) -> Marches:
        """See :meth:`AbstractComposite.forward`."""
        mode, none = dr.ADMode.Forward, March()
        # From the parameters to each layer by itself
        tangents = [
            _derive(mode, item, rays, layer, none, stop)[0]
            if item.has_gradients
            else none
            for item, layer in zip(rays.light(posed), primal.layers, strict=True)
        ]
        with dr.resume_grad():
            # From the layers to the total, through the folds (A.6)
            leaves = [layer.copy() for layer in primal.layers]
            dr.enable_grad(leaves)
            for leaf, tangent in zip(leaves, tangents, strict=True):
                dr.set_grad(leaf, tangent)
            total: Any = depth_composite(leaves)
            return Marches(dr.forward_to(total, flags=dr.ADFlag.ClearEdges), tangents)

    def tasks(
        self, posed: Sequence[Layer], rays: Rays, primal: Marches, cotangent: Marches
    ) -> list[Task]:
        """See :meth:`AbstractComposite.tasks`; one for each field."""
        # From the total to each layer, through the folds
        by_layer = self._cotangents(primal, cotangent)
        dr.eval(by_layer)  # so that it is known how many rays have to be marched again
        return [
            task
            for k, item in enumerate(posed)
            if item.has_gradients
            for task in select(
                primal.layers[k].opacity > 0,
                rays,
                primal.layers[k],
                cotangent=by_layer[k],
                which=(k,),
            )
        ]

    def accumulate(self, posed: Sequence[Layer], task: Task, stop: float) -> None:
        """See :meth:`AbstractComposite.accumulate`."""
        (item,) = task.rays.light(posed)
        mode = dr.ADMode.Backward
        _derive(mode, item, task.rays, task.primal, task.cotangent, stop)

    def backward_rays(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        cotangent: Marches,
        stop: float,
        layers: Sequence[int],
    ) -> list[RayGradient]:
        """See :meth:`AbstractComposite.backward_rays`."""
        lit = rays.light(posed)
        fields_by_rays([lit[k] for k in layers])
        # From the total to each layer, through the folds (A.6)
        by_layer = self._cotangents(primal, cotangent)
        # From each layer to its parameters and rays: now its march is replayed
        mode = dr.ADMode.Backward
        return [
            _derive(mode, lit[k], rays, primal.layers[k], by_layer[k], stop, True)[1]
            for k in layers
        ]

    def _cotangents(self, primal: Marches, cotangent: Marches) -> list[March]:
        """Return the derivatives of the objective by each layer."""
        with dr.resume_grad():
            # Now the layers are folded again, attached
            leaves = [layer.copy() for layer in primal.layers]
            dr.enable_grad(leaves)
            result = depth_composite(leaves).pair(cotangent.total)
            for leaf, part in zip(leaves, cotangent.layers, strict=False):
                result += leaf.pair(part)  # of losses on a layer by itself
            dr.backward_from(result)
            return [dr.grad(leaf) for leaf in leaves]


def nothing(rays: Rays) -> Marches:
    """Return what is seen of no layers."""
    return Marches(dr.zeros(March, dr.width(rays.direction)), [])


def _full(layer: March | Sparse | None) -> March | None:
    return layer.full() if isinstance(layer, Sparse) else layer


def _see(item: Layer, rays: Rays, stop: float) -> March:
    if isinstance(item, AbstractBackdrop):
        return item.march(rays, stop)
    return _march_where_it_is(item, rays, stop)


@dr.syntax
def _march_where_it_is(posed: PosedField, rays: Rays, stop: float) -> March:
    """March; a vector of rays of which none meets the field's box does nothing."""
    layer = March()
    with dr.suspend_grad():
        o, d = posed.to_local(rays.origin, rays.direction)
        near, far = posed.interval(o, d, rays.t_max)
        if rays.active & (near < far):
            layer = march(posed, rays, stop)
    return layer


def _derive(
    mode: dr.ADMode, item: Layer, rays: Rays, *arguments: Any
) -> tuple[March, RayGradient]:
    if isinstance(item, AbstractBackdrop):
        return item.derivative(mode, rays, *arguments)
    return march_derivative(mode, item, rays, *arguments)


def depth_composite(layers: list[March]) -> March:
    """Fold fields front to back in the order of their expected depth.

    Per ray and fold, ``I = I_f + (1 - a_f) I_b`` and ``a = a_f + (1 - a_f) a_b``
    with premultiplied radiance I; this is A.6 with ``c = I / a``, times the opacity
    that A.6 divides by. Fields of equal depth keep the order of the list.
    Differentiable except in the order itself.

    Args:
        layers: one march a layer, each of n rays; at least one.

    Returns:
        the composite; its depth is the expected depth of all that is seen.

    Source: appendix A.4 to A.6.
    """
    ordered = sort_by_depth(layers)
    # Back to front (A.6): I = I_f + (1 - a_f) I_b
    result = ordered[-1]
    for front in reversed(ordered[:-1]):
        result = front.over(result)
    return result


def sort_by_depth(layers: list[March]) -> list[March]:
    """Sort marches per ray by expected depth, nearest first, with stable selections.

    An odd-even transposition network: (k^2 - k) / 2 selections for k layers.
    """
    ordered = list(layers)
    depths = [dr.detach(layer.depth) for layer in ordered]
    for end in range(len(ordered) - 1, 0, -1):
        for i in range(end):
            # The nearer of two neighbours is f, the other one is b (A.4, A.5)
            swap = depths[i + 1] < depths[i]
            a, b = ordered[i], ordered[i + 1]
            ordered[i], ordered[i + 1] = dr.select(swap, b, a), dr.select(swap, a, b)
            da, db = depths[i], depths[i + 1]
            depths[i], depths[i + 1] = dr.minimum(da, db), dr.maximum(da, db)
    return ordered
