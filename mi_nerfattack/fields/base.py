"""The interface of a radiance field, and what fields of several kinds share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.occupancy import Occupancy, Window

FLAT = "provenance.flat"
"""Header entry of the field of a flat object: its kind."""


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
        info: free metadata of its file (provenance, scores of its fit, units).
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
    info: dict[str, str]
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
        skipping = [self.occupancy.words, self.window.array]
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
        return mi.Point3f(self.unit_vector(mi.Vector3f(point - lower)))

    def unit_vector(self, vector: mi.Vector3f) -> mi.Vector3f:
        """Map a difference of points of the field's frame to one in [0, 1]^3."""
        inverse = mi.Vector3f(*[1.0 / float(v) for v in self.upper - self.lower])
        return mi.Vector3f(vector * inverse)


def check_sky(image: np.ndarray) -> None:
    """Raise InputError unless an image is (height, width, 3), and there is some."""
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise InputError(f"sky: shape {image.shape}; expected (height, width, 3)")


def activate(raw: list[mi.Float]) -> mi.Color3f:
    """Turn raw colours, 3 x (n,), into linear ones."""
    return dr.srgb_to_linear(mi.Color3f(*[1 / (1 + dr.exp(-x)) for x in raw]))


def sky_colour(
    image: mi.Float, shape: tuple[int, int], direction: mi.Vector3f
) -> mi.Color3f:
    """Look up a latitude-longitude image of raw colours bilinearly.

    Args:
        image: (height width 3,), row by row from the zenith (+z).
        shape: height and width.
        direction: (3, n), unit vectors.

    Returns:
        (3, n), linear.
    """
    height, width = shape
    u = dr.atan2(direction.y, direction.x) * (0.5 / dr.pi) * width
    v = dr.safe_acos(direction.z) / dr.pi * height - 0.5
    u0, v0 = dr.floor(u), dr.floor(v)
    colour = mi.Color3f(0)
    for du in (0, 1):
        for dv in (0, 1):
            weight = (u - u0 if du else 1 - u + u0) * (v - v0 if dv else 1 - v + v0)
            column = mi.Int32(u0) + du
            column = dr.select(column < 0, column + width, column)
            column = dr.select(column >= width, column - width, column)
            column = dr.clip(column, 0, width - 1)  # where it is NaN
            row = dr.clip(mi.Int32(v0) + dv, 0, height - 1)
            index = mi.UInt32(row * width + column)
            colour += weight * dr.gather(mi.Color3f, image, index)
    return activate([colour.x, colour.y, colour.z])


def box_metadata(field: AbstractField, info: dict[str, str]) -> dict[str, str]:
    """Return the header entries that every kind of field file shares."""
    return {
        "kind": field.kind,
        "lower": " ".join(repr(float(v)) for v in field.lower),
        "upper": " ".join(repr(float(v)) for v in field.upper),
        "occupancy_shape": " ".join(str(n) for n in field.window.cells.shape),
        "step_m": repr(field.step_m),
        "cone": repr(field.cone),
        "length_unit": info.get("fit.source_unit", "metre"),
        "colour_space": "radiance = srgb_to_linear(sigmoid(raw)), linear Rec. 709",
    }


def flat_parameter(value: Any, shape: tuple[int, ...], name: str) -> mi.Float:
    """Turn an array of a given shape (or its flat form) into a flat Dr.Jit array.

    Memory of NumPy is copied.

    Raises:
        InputError: another shape, or a value that is not finite.
    """
    if value is None:
        value = np.zeros(shape, np.float32)
    value_shape = tuple(value.shape)
    if value_shape not in (shape, (int(np.prod(shape)),)):
        raise InputError(f"{name}: shape {value_shape}; expected {shape}")
    if isinstance(value, np.ndarray):
        flat = upload(mi.Float, value)
    else:
        flat = mi.Float(value.array if dr.is_tensor_v(value) else value)
    check_finite(name, flat, int(np.prod(shape[1:])))
    return flat


def check_finite(
    name: str, flat: Any, channels: int = 1, place: str = "vertex"
) -> None:
    """Raise InputError if a parameter holds NaN or infinity.

    Nothing is checked while a kernel or a frozen function is recorded, since there are
    no values yet.

    Args:
        name: of the parameter.
        flat: its values, vertex by vertex; may be attached.
        channels: values per vertex.
        place: what messages call a vertex.
    """
    if dr.flag(dr.JitFlag.SymbolicScope) or dr.flag(dr.JitFlag.FreezingScope):
        return
    values = dr.detach(flat)
    dr.schedule(values)  # or what gives them is computed twice
    if dr.all(dr.isfinite(values)):
        return
    bad = ~np.isfinite(values.numpy())
    raise InputError(
        f"{name}: {np.count_nonzero(bad)} of {bad.size} values are NaN or infinite, "
        f"the first at {place} {bad.argmax() // channels}; lower the learning rate, "
        "and look for the first gradient that is not finite"
    )


def check_box(lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise InputError unless two (3,) corners are finite and in order."""
    good = lower.shape == upper.shape == (3,) and np.isfinite(lower).all()
    if not (good and np.isfinite(upper).all() and (upper > lower).all()):
        raise InputError(f"bounding box: {lower} to {upper}; expected lower < upper")


def check_positive(name: str, value: float) -> None:
    """Raise InputError unless a number is finite and above zero."""
    if not 0 < value < np.inf:
        raise InputError(f"{name}: {value}; must be positive and finite")
