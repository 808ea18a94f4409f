"""Decoder-free multi-resolution grid field: the object whose texture is attacked."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding

from mi_nerfattack.backend.arrays import upload
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.levels import (
    GridLevel,
    largest_sum,
    lay_out_levels,
    level_growth,
    read_planes,
)
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.fields.vertex_colours import VertexColours
from mi_nerfattack.notebook import picture

_MOST_VERTICES = (1 << 30) - 1  # four numbers each, which kernels index by 32 bits


@dataclass(frozen=True)
class GridLayout:
    """Levels of a multi-resolution grid.

    Attributes:
        levels: number of levels.
        base_resolution: vertices along an edge of the coarsest level.
        max_resolution: vertices along an edge of the finest level.
    """

    levels: int = 16
    base_resolution: int = 16
    max_resolution: int = 64

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= 32:
            raise InputError(f"levels: {self.levels}; allowed are 1 to 32")
        if not 2 <= self.base_resolution <= self.max_resolution <= 512:
            raise InputError(
                f"resolutions: {self.base_resolution} to {self.max_resolution}; "
                "allowed is 2 <= base <= max <= 512"
            )
        if self.n_vertices > _MOST_VERTICES:
            raise InputError(
                f"levels: {self.levels}, from {self.base_resolution} to "
                f"{self.max_resolution}, have {self.n_vertices} vertices; at most "
                f"{_MOST_VERTICES} are allowed, take fewer levels"
            )

    @property
    def growth(self) -> float:
        """Factor between the resolutions of neighbouring levels."""
        return level_growth(self.levels, self.base_resolution, self.max_resolution)

    @property
    def grid_levels(self) -> list[GridLevel]:
        """The levels, the coarsest first."""
        return self._laid_out[0]

    @property
    def n_vertices(self) -> int:
        """Number of vertices of all levels, with what aligns them."""
        return self._laid_out[1]

    @property
    def hashmap_size(self) -> int:
        """Most vertices of a level; so many that nothing is hashed."""
        return self.max_resolution**3 * 4

    @property
    def _laid_out(self) -> tuple[list[GridLevel], int]:
        resolutions = self.base_resolution, self.max_resolution
        return lay_out_levels(self.levels, *resolutions, 4, self.hashmap_size)


class GridField(AbstractField):
    """Multi-resolution grid without decoder and without view dependence.

    Every vertex holds one density value and three colours. The values of all
    levels are interpolated trilinearly and added up:
    ``density = density_scale * exp(sum_l d_l)`` and
    ``L = srgb_to_linear(sigmoid(sum_l c_l))``. Sixteen levels from 16 to 64 hold
    4.4 million values (appendix A.4.1, B.1).

    Not differentiable with respect to ``density_scale``, the bounding box and the
    occupancy.

    Args:
        layout: levels and resolutions.
        lower: (3,) of the bounding box, metres.
        upper: (3,) of the bounding box, metres.
        density: (n_vertices,) raw density values; zeros when left out.
        texture: (n_vertices, 3) raw colour values; zeros (mid grey) when left out.
        occupancy: where density may be; everywhere when left out.
        density_scale: 1/metre.
        step_m: marching step, metres; a voxel of the finest level by default.
        info: free metadata that is kept in the file (provenance, units).

    Source: appendix A.4.1 and B.1; Mueller et al. 2022 for the levels.
    """

    kind = "grid_field"

    def __init__(
        self,
        layout: GridLayout,
        lower: np.ndarray,
        upper: np.ndarray,
        density: np.ndarray | None = None,
        texture: np.ndarray | None = None,
        occupancy: Occupancy | None = None,
        density_scale: float = 1.0,
        step_m: float | None = None,
        info: dict[str, str] | None = None,
    ) -> None:
        self.layout = layout
        self.lower: np.ndarray = np.asarray(lower, np.float64)
        self.upper: np.ndarray = np.asarray(upper, np.float64)
        check_box(self.lower, self.upper)
        self.density_scale: float = float(density_scale)
        voxel = float((self.upper - self.lower).max()) / layout.max_resolution
        self.step_m: float = voxel if step_m is None else float(step_m)
        self.cone: float = 0.0
        check_positive("step_m", self.step_m)
        check_positive("density_scale", self.density_scale)
        self.info: dict[str, str] = dict(info or {})
        self.occupy(occupancy or Occupancy.full())
        self.encoding: HashGridEncoding = HashGridEncoding(
            mi.Float,
            3,
            n_levels=layout.levels,
            n_features_per_level=4,
            hashmap_size=layout.hashmap_size,
            base_resolution=layout.base_resolution,
            per_level_scale=layout.growth,
            align_corners=True,
            init_scale=0.0,
        )
        self.n_vertices: int = layout.n_vertices
        self._density = flat_parameter(density, (self.n_vertices,), "density")
        self._texture = flat_parameter(texture, (self.n_vertices, 3), "texture")
        self._colours: VertexColours | None = None
        self._pack()

    def _repr_png_(self) -> bytes:
        return picture(self)

    def occupy(self, occupancy: Occupancy) -> None:
        """See :meth:`AbstractField.occupy`."""
        super().occupy(occupancy)
        self._bound: float | None = None

    @property
    def texture(self) -> mi.TensorXf:
        """Raw colour values, (n_vertices, 3); the parameter that is attacked."""
        return mi.TensorXf(self._texture, (self.n_vertices, 3))

    @property
    def packed(self) -> mi.Float:
        """Density and colours side by side, (4 n_vertices,): what kernels read."""
        return self.encoding.data

    @packed.setter
    def packed(self, value: mi.Float) -> None:
        self.encoding.data = value
        self._relist()

    @property
    def colours(self) -> VertexColours:
        """The colours of the finest level's vertices."""
        if self._colours is None:
            self._colours = VertexColours(self)
        return self._colours

    def texture_gradient(self, packed_gradient: mi.Float) -> mi.TensorXf:
        """Pick the colours' part, (n_vertices, 3), out of a gradient of `packed`."""
        i = dr.arange(mi.UInt32, 3 * self.n_vertices)
        vertex = i // 3
        grad = dr.gather(mi.Float, packed_gradient, 4 * vertex + 1 + (i - 3 * vertex))
        return mi.TensorXf(grad, (self.n_vertices, 3))

    def pack(self, texture: mi.Float, density: mi.Float | None = None) -> mi.Float:
        """Lay density and colours side by side, (4 n_vertices,); differentiable.

        Args:
            texture: (3 n_vertices,), vertex by vertex.
            density: (n_vertices,); the field's own when left out.
        """
        i = dr.arange(mi.UInt32, 4 * self.n_vertices)
        vertex, channel = i >> 2, i & 3
        is_density = channel == 0
        colour = dr.select(is_density, 0, 3 * vertex + channel - 1)
        density = self._density if density is None else density
        packed = dr.select(
            is_density,
            dr.gather(mi.Float, density, vertex, is_density),
            dr.gather(mi.Float, texture, colour, ~is_density),
        )
        dr.eval(packed)
        return packed

    def _pack(self) -> None:
        self.packed = self.pack(self._texture)

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """See :meth:`AbstractField.eval_everywhere`."""
        # The encoding reads one vertex past the last cell at exactly 1.
        unit = dr.clip(self.unit(point), 0.0, 1.0 - 1e-6)
        features = self.encoding(unit, active)
        d, r, g, b = [
            sum(
                (features[4 * level + c] for level in range(1, self.layout.levels)),
                start=features[c],
            )
            for c in range(4)
        ]
        density = self.density_scale * dr.exp(dr.minimum(d, 15.0))
        colour = mi.Color3f(*[1 / (1 + dr.exp(-x)) for x in (r, g, b)])
        return density & active, dr.srgb_to_linear(colour) & active

    def levels(self) -> list[GridLevel]:
        """Return the levels, the coarsest first."""
        return self.layout.grid_levels

    def density_bound(self) -> float:
        """Return the largest density in occupied cells before the window's factor.

        Exact but for rounding. Kept until the density or the occupancy changes, since
        media ask for it after every change of a parameter.
        """
        if self._bound is None:
            raw = dr.detach(self._density).numpy()
            largest = largest_sum(self.levels(), raw, self.window.cells)
            self._bound = self.density_scale * float(np.exp(min(largest, 15.0)))
        return self._bound

    def arrays(self) -> list[Any]:
        """Return `packed`, occupancy and window."""
        return [self.packed, *self.occupancy.arrays, self.window.array]

    @property
    def has_gradients(self) -> bool:
        """Whether derivatives with respect to `packed` are asked for."""
        with dr.resume_grad():
            return dr.grad_enabled(self.packed)

    def parameters(self) -> dict[str, Any]:
        """Return ``texture`` (n_vertices, 3) and ``density`` (n_vertices,)."""
        return {"texture": self.texture, "density": self._density}

    def set_parameter(self, name: str, value: Any) -> None:
        """Replace ``texture``, ``colour`` (that of :attr:`colours`) or ``density``."""
        if name == "colour":
            self._texture = self.colours.replace(value)
        elif name == "texture":
            self._texture = flat_parameter(value, (self.n_vertices, 3), name)
        elif name == "density":
            value = flat_parameter(value, (self.n_vertices,), name)
            mi.set_property(self._density, value)
            self._bound = None
        else:
            raise KeyError(
                f"{name}: a grid field has 'texture', 'colour' and 'density'"
            )
        self._pack()
        if name == "texture" and self._colours is not None:
            self._colours.read()

    def held_vertices(self) -> np.ndarray:
        """Tell which vertices are read anywhere in an occupied cell, (n_vertices,)."""
        held = np.zeros(self.n_vertices, bool)
        for level in self.levels():
            planes = read_planes(level, self.window.cells)
            held[level.vertices] = np.concatenate([plane.ravel() for plane in planes])
        return held

    def tensors(self) -> dict[str, np.ndarray]:
        """Return density and texture of the held vertices, in half precision, and bits.

        The bits are the occupancy's, which say what is held.
        """
        held = self.held_vertices()
        return {
            "density": self._density.numpy()[held].astype(np.float16),
            "texture": self.texture.numpy()[held].astype(np.float16),
            **self.occupancy_tensors(),
        }

    def metadata(self) -> dict[str, str]:
        """Return layout, bounds, units and provenance."""
        return {
            **self.info,
            **{k: str(v) for k, v in asdict(self.layout).items()},
            **box_metadata(self, self.info),
            "density_scale": repr(self.density_scale),
        }


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
    found = tuple(value.shape)
    if found not in (shape, (int(np.prod(shape)),)):
        raise InputError(f"{name}: shape {found}; expected {shape}")
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
