"""The interface of a radiance field: bounds, occupancy and point evaluation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.occupancy import Occupancy, Window


class AbstractField(ABC):
    """Radiance field in its own frame: density and linear radiance at a point.

    A field owns its parameters as Dr.Jit arrays of the variant that was active
    when it was made. Geometry (density) and appearance are separate parameters,
    so that an attack can change the second without touching the first.

    Attributes:
        lower: (3,) lower corner of the bounding box, metres in the field's frame.
        upper: (3,) upper corner of the bounding box, metres in the field's frame.
        step_m: length of a marching step near the camera, metres in the field's
            frame.
        cone: growth of the step with distance, 1/1; a step at distance t is about
            ``max(step_m, cone * t)``. Zero keeps the step constant.
        occupancy: grid by which a march skips empty space and, where it has octants,
            what is thin.
        window: factor of the density that is 0 in empty space.
        differentiable_by_position: whether density and radiance are continuous, so that
            derivatives by rays are those of the picture.
        has_sky: whether :meth:`background` is a picture, not black.
    """

    kind: str
    has_sky = False
    differentiable_by_position = True
    lower: np.ndarray
    upper: np.ndarray
    step_m: float
    cone: float
    occupancy: Occupancy
    window: Window
    _live: list[Any]

    def __repr__(self) -> str:
        sides = " x ".join(f"{side:.3g}" for side in self.upper - self.lower)
        return f"{type(self).__name__}({sides} m, step {self.step_m:.3g} m)"

    def occupy(self, occupancy: Occupancy) -> None:
        """Make the field empty outside the occupied cells of a grid over its box."""
        self.occupancy, self.window = occupancy, Window(occupancy.cells)
        self._relist()

    def see_all(self) -> None:
        """Let marches see thin octants, too.

        Where a march skips them, samples come and go at once as a ray moves, and its
        derivative by the ray misses that.
        """
        self.occupancy = Occupancy(self.window.cells)
        self._relist()

    @property
    def live(self) -> list[Any]:
        """:meth:`arrays` in a list that is always up to date.

        A Mitsuba object that has it as an attribute can be part of a function that
        `drjit.freeze` records: Mitsuba finds the arrays there.
        """
        if "_live" not in self.__dict__:
            self._live = self.arrays()
        return self._live

    def _relist(self) -> None:
        """Bring :attr:`live` up to date."""
        if "_live" in self.__dict__:
            self._live[:] = self.arrays()

    def occupancy_tensors(self) -> dict[str, np.ndarray]:
        """Return what field files of all kinds hold of the occupancy."""
        cells, octants = self.window.cells, self.occupancy.octants
        bits = {"occupancy": np.packbits(cells.ravel())}
        return bits if octants is None else {**bits, "octants": octants[cells]}

    def refine(self, step_m: float) -> None:
        """Change the marching step; where it grows with distance, in proportion.

        Args:
            step_m: near the camera, metres in the field's frame; counts for posed
                fields that are made afterwards.
        """
        self.cone *= step_m / self.step_m
        self.step_m = step_m

    def eval(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate density and radiance.

        Args:
            point: (3, n), metres in the field's frame.
            direction: (3, n), unit vectors of travel in the field's frame.
            active: (n,) mask; masked lanes give zeros.

        Returns:
            density (n,), 1/metre of the field's frame, and radiance (3, n), linear
            Rec. 709.
        """
        density, radiance = self.eval_everywhere(point, direction, active)
        return density * self.window(self.unit(point), active), radiance

    @abstractmethod
    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate what the parameters say, also where the field is empty.

        Args and returns: as :meth:`eval`.
        """

    def parameters(self) -> dict[str, Any]:
        """Return the differentiable parameters by name (Dr.Jit arrays), if any."""
        return {}

    def set_parameter(self, name: str, value: Any) -> None:
        """Replace a parameter; shape and type must be those of the present one."""
        del value
        raise KeyError(f"{name}: a {self.kind} has no parameters")

    def arrays(self) -> list[Any]:
        """Return the Dr.Jit arrays that :meth:`eval` and the occupancy read."""
        skipping = [*self.occupancy.arrays, self.window.array]
        return [*self.parameters().values(), *skipping]

    @property
    def has_gradients(self) -> bool:
        """Whether derivatives with respect to what :meth:`eval` reads are asked for."""
        with dr.resume_grad():  # derivative passes ask while gradients are suspended
            return any(dr.grad_enabled(value) for value in self.parameters().values())

    def density(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Evaluate density alone, (n,), 1/metre of the field's frame."""
        factor = self.window(self.unit(point), active)
        return self.density_everywhere(point, active) * factor

    def density_everywhere(self, point: mi.Point3f, active: mi.Bool) -> mi.Float:
        """Evaluate the density of :meth:`eval_everywhere` alone, (n,)."""
        return self.eval_everywhere(point, mi.Vector3f(0, 0, 1), active)[0]

    def background(self, direction: mi.Vector3f) -> mi.Color3f:
        """Return the radiance of what lies behind the field, (3, n), linear.

        Black unless the field carries a background model.
        """
        return dr.zeros(mi.Color3f, dr.width(direction))

    def unit(self, point: mi.Point3f) -> mi.Point3f:
        """Map a point of the field's frame to [0, 1]^3 of its bounding box."""
        lower = mi.Point3f(*[float(v) for v in self.lower])
        inverse = mi.Vector3f(*[1.0 / float(v) for v in self.upper - self.lower])
        return mi.Point3f((point - lower) * inverse)
