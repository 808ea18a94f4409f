"""Parameters of a Mitsuba scene: their values, and gradients of several frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.vertex_colours import gradient, start_gradient
from mi_nerfattack.render.rays import Gain


@runtime_checkable
class CollectsRays(Protocol):
    """An integrator that marches the rays of several frames together."""

    def start_gradient(self, scene: mi.Scene, keys: list[str]) -> None:
        """Collect rays from now on; InputError where a key has no derivative."""

    def finish_gradient(self) -> None:
        """Accumulate the gradients of all collected rays."""

    def stop_gradient(self) -> None:
        """Collect no more, and forget the rays that wait."""

    def check_camera(self, scene: mi.Scene) -> None:
        """Raise InputError where rays have no derivative by the camera."""

    def keep(self, state: Any) -> Any:
        """Return the costly part of a state that `sample` gave."""

    def restore(self, ray: mi.Ray3f, record: Any, gains: Sequence[Gain]) -> Any:
        """Return the state again, for the same rays in the same light."""


class Differentiated:
    """Parameters of a scene, and the gradients of some of them.

    Between :meth:`start` and :meth:`stop`, the values of the selected parameters are
    leaves of Dr.Jit's graph. Colours and densities of a grid field share a leaf: the
    array that marches read.

    Args:
        scene: that is rendered.
        collector: its integrator, if that collects rays.

    Attributes:
        params: `mi.traverse(scene)`.
        keys: of the parameters to differentiate by.
    """

    def __init__(self, scene: mi.Scene, collector: CollectsRays | None) -> None:
        self._scene, self._collector = scene, collector
        self._started: tuple[str, ...] = ()
        self._before: dict[str, Any] = {}
        self._leaves: dict[str, Any] = {}
        self._arrays: list[tuple[GridField, mi.Float, mi.Float]] = []
        self.params: Any = mi.traverse(scene)
        self.keys: tuple[str, ...] = ()

    def select(self, keys: Sequence[str]) -> None:
        """See :meth:`AbstractDifferentiableSensor.select`."""
        for key in keys:
            if key not in self.params:
                near = ", ".join(name for name in self.params.keys() if "." in name)
                raise InputError(f"{key}: no parameter of the scene; there are: {near}")
            _, _, node, flags = self.params.properties[key]
            constant = mi.ParamFlags.NonDifferentiable | mi.ParamFlags.Discontinuous
            if isinstance(node, mi.Sensor | mi.Film | mi.Sampler) or flags & constant:
                raise InputError(
                    f"{key}: a constant of the derivative, as lens, film and the shape "
                    "of surfaces are; leave it out of params (mi.render differentiates "
                    "by the lens, prb_projective by shapes)"
                )
        self.keys = tuple(keys)

    def assign(self, values: Mapping[str, Any]) -> None:
        """See :meth:`AbstractDifferentiableSensor.set_parameters`."""
        for key, value in values.items():
            if key not in self.params:
                raise InputError(f"{key}: no parameter of the scene")
            if not _is_same(self.params[key], value):
                self.params[key] = dr.detach(value) if _is_array(value) else value
        self.params.update()

    def start(self, extra_keys: Sequence[str] = ()) -> None:
        """See :meth:`AbstractDifferentiableSensor.start_gradient`."""
        self.stop()
        try:
            self._started = tuple(dict.fromkeys([*self.keys, *extra_keys]))
            self._start(list(self._started))
        except BaseException:
            self.stop()
            raise

    def _start(self, keys: list[str]) -> None:
        if self._collector is not None:
            self._collector.start_gradient(self._scene, keys)
        # Parameters outside of packed arrays: each one is a leaf
        for key in keys:
            if self.packed(key) is None:
                value = self.params[key]
                self._before[key] = type(value)(value)
                leaf = type(value)(dr.detach(value))
                dr.enable_grad(leaf)
                self.params[key] = self._leaves[key] = leaf
        if self._leaves:  # an update evaluates the values of all parameters
            self.params.update()
        # Colours and densities: a leaf for each packed array
        fields = {id(field): field for key in keys if (field := self.packed(key))}
        for field in fields.values():
            before = start_gradient(field)
            self._arrays.append((field, before, field.packed))

    def gradients(self) -> dict[str, Any]:
        """Return what has been accumulated, by key, each of its parameter's shape."""
        self.finish()
        gradients = {}
        for key in self._started:
            field = self.packed(key)
            name = key.rpartition(".")[2]
            leaf = self._leaves.get(key)
            if field is None:
                gradients[key] = dr.grad(leaf)
                dr.eval(gradients[key])
            else:  # evaluated if it is looked at
                gradients[key] = gradient(field, name)
        return gradients

    def finish(self) -> None:
        """March the rays that wait, so that gradients are complete."""
        if self._collector is not None:
            self._collector.finish_gradient()

    def stop(self) -> None:
        """Leave no parameter attached; what has been replaced since stays so."""
        if self._collector is not None:
            self._collector.stop_gradient()
        # Put values back, except where somebody has replaced them since
        for key, value in self._before.items():
            if _is_same(self.params[key], self._leaves[key]):
                self.params[key] = value
        if self._before:
            self.params.update()
        for field, before, leaf in self._arrays:
            if field.packed is leaf:
                field.packed = before
        self._before, self._leaves, self._arrays = {}, {}, []

    def packed(self, key: str) -> GridField | None:
        """Return the grid field whose packed array a parameter is part of."""
        node = self.params.properties[key][2]
        field = getattr(node, "field", None)
        is_part = key.rpartition(".")[2] in ("colour", "density")
        return field if is_part and isinstance(field, GridField) else None

    def objects(self) -> dict[str, Any]:
        """Return the volumes whose colours are selected, by prefix of their keys."""
        return {
            key.rpartition(".")[0]: self.params.properties[key][2]
            for key in self.keys
            if key.endswith(".colour") and self.packed(key) is not None
        }


def _is_array(value: Any) -> bool:
    return bool(dr.detail.collect_indices(value))


def _is_same(a: Any, b: Any) -> bool:
    """Tell whether two values are one and the same in memory, or equal numbers."""
    if not _is_array(a) or not _is_array(b):
        return bool(np.all(np.equal(a, b)))
    one, other = (dr.detail.collect_indices(dr.detach(value)) for value in (a, b))
    return one == other
