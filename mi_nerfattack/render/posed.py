"""Fields at a pose in the world, as kernels see them."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.render.camera.pose import Pose, offset_gradient
from mi_nerfattack.render.rays import Gain, meet_box


class AbstractLightMaps(ABC):
    """Factors of a field's radiance over its box, one map for each light."""

    @abstractmethod
    def factor(self, unit: mi.Point3f, row: mi.UInt32, active: mi.Bool) -> mi.Color3f:
        """Interpolate a map, (3, n); differentiable by the place.

        Args:
            unit: (3, n), in the unit cube of the field's box; outside is clamped to it.
            row: (n,), number of the map; 0 for the light of the capture.
            active: (n,) mask.
        """

    @abstractmethod
    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""


class PosedField:
    """A field at a pose, as kernels see it: all numbers opaque.

    Args:
        field: the field.
        pose: field to world; identity by default.
    """

    def __init__(self, field: AbstractField, pose: Pose | None = None) -> None:
        self.field = field
        # cone -> 0 makes the lattice uniform; the floor keeps step / cone finite, and
        # so large that no ray comes there
        self._cone = mi.Float(max(field.cone, 1e-12))
        dr.make_opaque(self._cone)
        self._gain: Gain | None = None
        #: Maps of other lights, which rays choose from by their gains.
        self.light_maps: AbstractLightMaps | None = None
        #: What kernels read of the pose, in a list that is always up to date.
        self.live: list[Any] = []
        #: Field to world as Mitsuba has it; the same object for good.
        self.to_world: Any = mi.AffineTransform4f()
        self.place(pose or Pose.identity())

    def place(self, pose: Pose) -> None:
        """Give the field another pose, from which :meth:`move` counts."""
        self._set(pose)
        self.move(np.zeros(6))

    def move(self, offset: np.ndarray) -> None:
        """Put the field elsewhere: `placed`; `pose` stays what it was.

        Args:
            offset: (6,) from `pose`, see :meth:`Pose.moved`.

        Raises:
            ValueError: another shape, or a number that is not finite.
        """
        offset = np.array(offset, np.float64)
        if offset.shape != (6,) or not np.isfinite(offset).all():
            raise ValueError(f"offset: {offset.tolist()}; expected 6 finite numbers")
        self.offset = offset
        placed = self.pose.moved(self.offset)
        self._put(placed)
        matrix = np.eye(4)
        matrix[:3, :3] = placed.scale * placed.rotation
        matrix[:3, 3] = placed.translation
        mi.set_property(self.to_world, mi.AffineTransform4f(matrix))
        self._attached: Any = None
        self._followed = self._matrix()

    def follow(self, name: str) -> None:
        """Take the pose of `to_world`, which has been changed, and its derivatives.

        Args:
            name: of the parameter, for messages.

        Raises:
            ValueError: it shears, reflects or scales unequally.
            InputError: a derivative is asked for, and there is none.
        """
        matrix = self._matrix()
        if not np.array_equal(matrix, self._followed):
            pose = Pose.from_matrix(matrix)
            self._set(pose)
            self._put(pose)
            self._followed = matrix
        attached = dr.grad_enabled(self.to_world.matrix)
        if attached:
            self.check_continuous(name)
        self._attached = self.to_world if attached else None

    def check_continuous(self, parameter: str) -> None:
        """Raise InputError if the density jumps, or rays skip thin parts of it.

        Args:
            parameter: that moves rays or box, for the message.
        """
        field = self.field
        if field.window.is_open:
            raise InputError(
                f"{parameter}: the {field.kind} has no empty cell, so its density "
                "ends at the faces of its box at once, which has no derivative; leave "
                "cells at its border empty"
            )
        skips = field.occupancy.octants is not None
        if skips and field.differentiable_by_position:  # others are refused elsewhere
            raise InputError(
                f"{parameter}: rays skip thin parts of the {field.kind}, whose "
                "derivative would be left out; set skip_thin to false (in Python, call "
                "see_all() of the field)"
            )

    def offset_gradient(self, by_pose: Any) -> np.ndarray:
        """Return the derivative by `offset`, (6,), from that by `to_world`."""
        return offset_gradient(self._matrix(), _numbers(by_pose), self.offset)

    def _matrix(self) -> np.ndarray:
        return _numbers(self.to_world)

    def _set(self, pose: Pose) -> None:
        self.pose: Pose = pose
        #: (6,), where it was moved to from `pose`.
        self.offset: np.ndarray = np.zeros(6)
        self._inverse_scale = mi.Float(1 / pose.scale)
        self._step = mi.Float(self.field.step_m * pose.scale)
        dr.make_opaque(self._inverse_scale, self._step)

    def _put(self, placed: Pose) -> None:
        self.placed: Pose = placed
        rotation = np.asarray(placed.rotation, np.float32)
        self._columns = [mi.Vector3f(*map(float, rotation[:, i])) for i in range(3)]
        self._origin = mi.Point3f(*map(float, placed.translation))
        dr.make_opaque(self._columns, self._origin)
        self.live[:] = [
            *self._columns,
            self._origin,
            self._inverse_scale,
            self._step,
            self._cone,
        ]

    def with_gain(self, gain: Gain) -> PosedField:
        """Return this field in another light, ray by ray.

        Args:
            gain: of the n rays of a march.
        """
        twin = copy.copy(self)
        twin._gain = Gain(dr.detach(gain.colour), gain.row)
        return twin

    @property
    def has_gradients(self) -> bool:
        """Whether derivatives by the field's parameters are asked for."""
        return self.field.has_gradients

    @property
    def has_pose_gradients(self) -> bool:
        """Whether derivatives by `to_world` are asked for."""
        return self._attached is not None

    def attached(self) -> list[mi.Float]:
        """Return the entries of `to_world` if derivatives by it are asked for."""
        if self._attached is None:
            return []
        return [row for column in self._attached.matrix for row in column]

    def in_world(self, density: mi.Float) -> mi.Float:
        """Turn a density per metre of the field's frame into one per world metre."""
        return density * self._inverse_scale

    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""
        numbers = [self._columns, self._origin, self._inverse_scale]
        cells = self.field.occupancy.shape, self.field.window.is_open
        maps = [] if self.light_maps is None else self.light_maps.state()
        arrays = [self._step, self._cone, *self.field.arrays(), *maps]
        return [self, cells, *numbers, *arrays]

    def to_local(
        self, origin: mi.Point3f, direction: mi.Vector3f
    ) -> tuple[mi.Point3f, mi.Vector3f]:
        """Map a world ray; ``o + t d`` keeps its meaning with t in world metres."""
        offset = mi.Vector3f(origin - self._origin)
        return mi.Point3f(self.turn(offset)), self.turn(direction)

    def turn(self, vector: mi.Vector3f) -> mi.Vector3f:
        """Map a difference of world points, (3, n), to the field's frame."""
        return mi.Vector3f(
            *[dr.dot(column, vector) * self._inverse_scale for column in self._columns]
        )

    def background(self, direction: mi.Vector3f) -> mi.Color3f:
        """Return what lies behind the field, (3, n), linear; it turns with the field.

        Differentiable by `direction`, and by `to_world` if derivatives by it are
        asked for.

        Args:
            direction: (3, n), unit vectors in the world.
        """
        heading = self.turn(direction)
        if self._attached is not None and dr.grad_enabled(self._attached.matrix):
            # Columns of the matrix are those of the rotation, times the scale
            m = self._attached.matrix
            columns = [mi.Vector3f(m[0, i], m[1, i], m[2, i]) for i in range(3)]
            heading = mi.Vector3f(*[dr.dot(column, direction) for column in columns])
        return self.field.background(dr.normalize(heading))

    def to_world_gradient(
        self, d_origin: mi.Vector3f, d_direction: mi.Vector3f
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Transpose of :meth:`to_local`, for cotangents."""

        def turn(v: mi.Vector3f) -> mi.Vector3f:
            axes = zip(self._columns, v, strict=True)
            return sum((c * x for c, x in axes), mi.Vector3f(0)) * self._inverse_scale

        return turn(d_origin), turn(d_direction)

    def backward_pose(self, rays: Any, by_rays: Any) -> None:
        """Accumulate the gradient of `to_world`, if it is asked for.

        A field that moves sees rays move the other way; one that grows thins out.

        Args:
            rays: n rays.
            by_rays: the objective's `RayGradient` by them, as the field sees them.
        """
        if self._attached is None:
            return
        with dr.resume_grad():
            m = self._attached.matrix
            columns = [mi.Vector3f(m[0, i], m[1, i], m[2, i]) for i in range(3)]
            offset = rays.origin - mi.Point3f(m[0, 3], m[1, 3], m[2, 3])
            scale = dr.cbrt(dr.dot(columns[0], dr.cross(columns[1], columns[2])))
            # Cotangents of the local ray (o, d) = M^-1 (origin, direction)
            result = -dr.log(scale) * by_rays.log_density
            for column in columns:
                to_local = column / dr.square(scale)
                still = dr.detach(column)
                result += dr.dot(to_local, offset) * dr.dot(still, by_rays.origin)
                along = dr.dot(to_local, rays.direction)
                result += along * dr.dot(still, by_rays.direction)
            dr.backward_from(result)

    def interval(
        self, o: mi.Point3f, d: mi.Vector3f, t_max: mi.Float
    ) -> tuple[mi.Float, mi.Float]:
        """Intersect a local ray with the bounding box, clipped to [0, t_max]."""
        lower = mi.Point3f(*map(float, self.field.lower))
        upper = mi.Point3f(*map(float, self.field.upper))
        near, far = meet_box(o, d, lower, upper=upper)
        return dr.maximum(near, 0), dr.minimum(far, t_max)

    def lattice(self, index: mi.Float) -> mi.Float:
        """Distance of a lattice point, metres."""
        return self.lattice_after(mi.Float(0), mi.Float(0), index)

    def lattice_index(self, t: mi.Float) -> mi.Float:
        """Inverse of :meth:`lattice`."""
        return self.lattice_index_after(mi.Float(0), mi.Float(0), t)

    def lattice_after(
        self, begin: mi.Float, first: mi.Float, index: mi.Float
    ) -> mi.Float:
        """Return ``lattice(first + index) - begin``, exact far away, too.

        Args:
            begin: (n,), metres; at lattice point `first`, or 0.
            first: (n,), a lattice point.
            index: (n,), counted from there.
        """
        knee = self._step / self._cone
        bend = dr.rcp(self._cone)
        count = first + index
        grown = knee * dr.exp(self._cone * (dr.maximum(count, bend) - bend))
        return dr.select(count <= bend, index * self._step, grown - begin)

    def lattice_index_after(
        self, begin: mi.Float, first: mi.Float, s: mi.Float
    ) -> mi.Float:
        """Inverse of :meth:`lattice_after`."""
        knee = self._step / self._cone
        bend = dr.rcp(self._cone)
        t = begin + s
        grown = bend + dr.log(dr.maximum(t, knee) / knee) * bend
        return dr.select(t <= knee, s / self._step, grown - first)

    def eval(
        self, point: mi.Point3f, direction: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Color3f]:
        """Evaluate at a local point: density in 1/(world metre), and radiance."""
        density, radiance = self.field.eval(point, direction, active)
        if self._gain is not None:
            radiance *= self._gain.colour
            if self.light_maps is not None:
                unit = self.field.unit(point)
                radiance *= self.light_maps.factor(unit, self._gain.row, active)
        return self.in_world(density), radiance


def offsets_of(objects: Sequence[PosedField]) -> np.ndarray:
    """Return where objects were moved to, (k, 6): see :meth:`Pose.moved`."""
    return np.array([posed.offset for posed in objects]).reshape(-1, 6)


def move_all(objects: Sequence[PosedField], offsets: np.ndarray) -> None:
    """Move objects by offsets (k, 6) from where they were put."""
    for posed, offset in zip(objects, offsets, strict=True):
        posed.move(offset)


def _numbers(transform: Any) -> np.ndarray:
    return np.array(dr.detach(transform.matrix), np.float64).reshape(4, 4)


def object_footprints(objects: Iterable[PosedField]) -> list[np.ndarray]:
    """Return the outlines of the objects' boxes on the ground, (4, 2) metres each."""
    outlines = []
    for posed in objects:
        low, high = posed.field.lower, posed.field.upper
        x, y = (low[0], high[0], high[0], low[0]), (low[1], low[1], high[1], high[1])
        corners = np.stack([x, y, np.zeros(4)], axis=1)
        outlines.append(posed.placed.apply(corners)[:, :2])
    return outlines
