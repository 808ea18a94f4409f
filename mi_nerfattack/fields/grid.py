"""Decoder-free multi-resolution grid field: the object whose texture is attacked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import (
    AbstractField,
    box_metadata,
    check_box,
    check_positive,
    flat_parameter,
)
from mi_nerfattack.fields.levels import (
    GridLevel,
    largest_sum,
    lay_out_levels,
    level_growth,
    read_planes,
)
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.fields.one_level import OneLevel
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
        return lay_out_levels(
            self.levels,
            self.base_resolution,
            self.max_resolution,
            features=4,
            most=self.hashmap_size,
        )


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
        self._marched: OneLevel | None = None  # in place of all levels
        self._cached_level: OneLevel | None = None  # from the last time
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
        self.refuse_one_level("occupy")
        super().occupy(occupancy)
        self._bound: float | None = None
        self._cached_level = None

    @property
    def texture(self) -> mi.TensorXf:
        """Raw colour values, (n_vertices, 3); the parameter that is attacked."""
        return mi.TensorXf(self._texture, (self.n_vertices, 3))

    @property
    def packed(self) -> mi.Float:
        """Density and colours side by side, what kernels read.

        (4 n_vertices,); of one level, the sums of all (see `OneLevel`).
        """
        return self.encoding.data if self._marched is None else self._marched.table

    @packed.setter
    def packed(self, value: mi.Float) -> None:
        if self._marched is None:
            self.encoding.data = value
        else:
            self._marched.table = value
        self._relist()

    @contextmanager
    def one_level(self, level: GridLevel) -> Iterator[None]:
        """Evaluate the field as one level instead of all levels; see `OneLevel`.

        Meanwhile the field has derivatives by the colours of this level only.

        Args:
            level: one of :meth:`levels`.
        """
        self.refuse_one_level("one_level")
        if not self.window.cells.any():
            raise InputError("one_level: no cell of the grid field is occupied")
        if self._cached_level is None or self._cached_level.level != level:
            finest = self.levels()[-1]
            self._cached_level = OneLevel(finest, level, self.window.cells)
        try:
            self._marched = self._cached_level
            self._pack()
            yield
        finally:
            self._marched = None
            self._pack()

    @property
    def colours(self) -> VertexColours:
        """The colours of the finest level's vertices."""
        if self._colours is None:
            self._colours = VertexColours(self)
        return self._colours

    def refuse_one_level(self, name: str) -> None:
        """Raise InputError while the field is one level, which leaves this out."""
        if self._marched is not None:
            raise InputError(
                f"{name}: while a grid field is marched as one level, only "
                "Rollout.gradient differentiates it, by the colours of that level, and "
                "nothing else of it may change; leave one_level out"
            )

    def texture_gradient(self, packed_gradient: mi.Float) -> mi.TensorXf:
        """Pick the colours' part, (n_vertices, 3), out of a gradient of `packed`.

        Where the field is one level, it is NaN for the vertices of all other levels.
        """
        if self._marched is not None:
            grad = self._marched.texture_gradient(packed_gradient, self.n_vertices)
            return mi.TensorXf(grad, (self.n_vertices, 3))
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
        if self._marched is None:
            self.encoding.data = self.pack(self._texture)
        else:
            self._marched.sum_up(self._texture, self.sums)
        self._relist()

    def sums(self, unit: mi.Point3f, texture: mi.Float) -> list[mi.Float]:
        """Add all levels up at points, also while the field is one level.

        Args:
            unit: (3, n) in the unit cube.
            texture: (3 n_vertices,) raw colours, used instead of the field's colours.

        Returns:
            density, red, green and blue, raw, (n,) each.
        """
        before = self.encoding.data
        self.encoding.data = self.pack(texture)
        try:
            totals = [mi.Float(x) for x in self._sum_levels(unit, mi.Bool(True))]
            dr.eval(totals)
        finally:
            self.encoding.data = before
        return totals

    def _sum_levels(self, unit: mi.Point3f, active: mi.Bool) -> list[Any]:
        features = self.encoding(unit, active)
        return [
            sum(
                (features[4 * level + c] for level in range(1, self.layout.levels)),
                start=features[c],
            )
            for c in range(4)
        ]

    def eval_everywhere(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """See :meth:`AbstractField.eval_everywhere`."""
        # The encoding reads one vertex past the last cell at exactly 1.
        unit = dr.clip(self.unit(point), 0.0, 1.0 - 1e-6)
        evaluate = self._sum_levels if self._marched is None else self._marched.eval
        d, r, g, b = evaluate(unit, active)
        density = self.density_scale * dr.exp(dr.minimum(d, 15.0))
        colour = mi.Color3f(*[1 / (1 + dr.exp(-x)) for x in (r, g, b)])
        return density & active, dr.srgb_to_linear(colour) & active

    def levels(self) -> list[GridLevel]:
        """Return the levels, the coarsest first."""
        return self.layout.grid_levels

    def density_bound(self) -> float:
        """Return the largest density in occupied cells before the window's factor.

        Exact except for rounding. Kept until density or occupancy changes, because
        media ask for it after every change of a parameter.
        """
        if self._bound is None:
            raw = dr.detach(self._density).numpy()
            largest = largest_sum(self.levels(), raw, self.window.cells)
            self._bound = self.density_scale * float(np.exp(min(largest, 15.0)))
        return self._bound

    def arrays(self) -> list[Any]:
        """Return `packed`, the lattice of one level, occupancy and window."""
        lattice = [] if self._marched is None else self._marched.lattice
        return [self.packed, *lattice, self.occupancy.words, self.window.array]

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
        if dr.grad_enabled(value):
            self.refuse_one_level(name)
        if name == "colour":
            self._texture = self.colours.replace(value)
        elif name == "texture":
            self._texture = flat_parameter(value, (self.n_vertices, 3), name)
        elif name == "density":
            self.refuse_one_level("density")
            value = flat_parameter(value, (self.n_vertices,), name)
            mi.set_property(self._density, value)
            self._bound = self._cached_level = None
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
