"""The exact composite: one march through all fields at once.

Along a ray, the lattice intervals of all fields are merged into segments on which the
set of fields does not change (`walk.py`); each is one sample of all (`sums.py`).
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.backdrop import Layer, fields_by_rays, only_fields
from mi_nerfattack.render.composite import (
    AbstractComposite,
    DepthComposite,
    Marches,
    nothing,
)
from mi_nerfattack.render.march import (
    RayGradient,
    integrate,
    march,
    march_derivative,
    private_gradients,
    replay,
)
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays, Task, select
from mi_nerfattack.render.walk import MergedWalk


class InterleavedComposite(AbstractComposite):
    """All fields in one medium: ``sigma = sum sigma_k``, ``L`` their weighted mean.

    Exact also where fields overlap; the steps are those of all fields together.
    Cost: about the sum of the fields' marches, as :class:`DepthComposite`, in one
    loop; its derivative evaluates every field again, also those that ask for no
    gradient. A layer is the field's share of the total, behind whatever hides it, and
    the total is the sum of the shares.
    """

    def check(self, posed: Sequence[Layer]) -> None:
        """See :meth:`AbstractComposite.check`."""
        _fields(posed)

    def render(self, posed: Sequence[Layer], rays: Rays, stop: float) -> Marches:
        """See :meth:`AbstractComposite.render`."""
        lit = rays.light(_fields(posed))
        if not lit:
            return nothing(rays)
        if len(lit) == 1:  # nothing to merge
            share = march(lit[0], rays, stop)
            return Marches(share, [share])
        # Several fields: one loop gathers the share of each, segment by segment
        with dr.suspend_grad():
            walk, active = MergedWalk.start(lit, rays)
            shares = integrate(
                lit,
                walk,
                active,
                evaluate=[item.eval for item in lit],
                towards=[path.heading for path in walk.paths],
                stop=stop,
            ).shares
        return Marches(_total(shares), shares)

    def keep(self, marches: Marches) -> Any:
        """See :meth:`AbstractComposite.keep`: all, 20 + 20 k bytes a ray."""
        return marches

    def restore(
        self, posed: Sequence[Layer], rays: Rays, record: Any, stop: float
    ) -> Marches:
        """See :meth:`AbstractComposite.restore`."""
        del posed, rays, stop
        return record

    def forward(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        stop: float,
    ) -> Marches:
        """See :meth:`AbstractComposite.forward`; of several fields, of the total."""
        fields, mode = _fields(posed), dr.ADMode.Forward
        total = March()
        if any(item.has_gradients for item in fields):
            with dr.suspend_grad():
                total, _ = _replay(
                    mode, fields, rays, primal.total, March(), stop, False
                )
        return Marches(total, [total] if len(fields) == 1 else [])

    def tasks(
        self, posed: Sequence[Layer], rays: Rays, primal: Marches, cotangent: Marches
    ) -> list[Task]:
        """See :meth:`AbstractComposite.tasks`; one, which needs all fields."""
        met = [
            layer.opacity > 0
            for item, layer in zip(posed, primal.layers, strict=True)
            if item.has_gradients
        ]
        if not met:
            return []
        mask = reduce(operator.or_, met)
        d_total = _total_cotangent(primal, cotangent)
        return select(
            mask, rays, primal.total, cotangent=d_total, which=tuple(range(len(posed)))
        )

    def accumulate(self, posed: Sequence[Layer], task: Task, stop: float) -> None:
        """See :meth:`AbstractComposite.accumulate`."""
        mode, rays, fields = dr.ADMode.Backward, task.rays, _fields(posed)
        # A single field: the derivative of its march, without a merge
        if len(posed) == 1:
            (item,) = rays.light(posed)
            march_derivative(
                mode,
                item,
                rays,
                primal=task.primal,
                cotangent=task.cotangent,
                stop=stop,
            )
            return
        # Several fields: one replay of the merged march
        with dr.suspend_grad(), private_gradients():
            _replay(mode, fields, rays, task.primal, task.cotangent, stop, False)

    def backward_rays(
        self,
        posed: Sequence[Layer],
        rays: Rays,
        primal: Marches,
        cotangent: Marches,
        stop: float,
        layers: Sequence[int],
    ) -> list[RayGradient]:
        """See :meth:`AbstractComposite.backward_rays`; always evaluates all fields."""
        fields_by_rays([posed[k] for k in layers])
        fields, mode = _fields(posed), dr.ADMode.Backward
        with dr.suspend_grad(), private_gradients():
            d_total = _total_cotangent(primal, cotangent)
            by_field = _replay(mode, fields, rays, primal.total, d_total, stop, True)[1]
        return [by_field[k] for k in layers]


COMPOSITES: dict[str, type[AbstractComposite]] = {
    "interleaved": InterleavedComposite,
    "depth": DepthComposite,
}


def _fields(posed: Sequence[Layer]) -> list[PosedField]:
    purpose = "the interleaved composite cannot merge what has no density"
    return only_fields(posed, purpose, "set composite to depth")


def _total_cotangent(primal: Marches, cotangent: Marches) -> March:
    """Return the cotangent of the total; that of a single layer is part of it.

    Raises:
        InputError: one of several layers has a cotangent.
    """
    if len(primal.layers) == 1 and cotangent.layers:
        return cotangent.total.plus(cotangent.layers[0], mi.Bool(True))
    if any(dr.any(layer.differs()) for layer in cotangent.layers):
        raise InputError(
            "composite interleaved: the shares of single fields have no derivatives; "
            "set composite to depth, or leave <id>.R to <id>.Z out of the loss"
        )
    return cotangent.total


def _total(shares: list[March]) -> March:
    return reduce(lambda a, b: a.plus(b, mi.Bool(True)), shares)


def _replay(
    mode: dr.ADMode, posed: list[PosedField], rays: Rays, *options: Any
) -> tuple[March, list[RayGradient]]:
    lit = rays.light(posed)
    return replay(mode, lit, *MergedWalk.start(lit, rays), *options)
