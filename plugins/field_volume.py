"""What the volumes `grid_field`, `ngp_field` and `brick_field` share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import AbstractField, load_field
from mi_nerfattack.fields.base import check_positive
from mi_nerfattack.plugins.properties import Mask, read_filename, read_pose
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.lighting import spectrum
from mi_nerfattack.render.posed import PosedField

QUANTITIES = ("density", "radiance")


def read_field(
    props: mi.Properties, kind: str, skips_thin: bool | None
) -> AbstractField:
    """Load the file named by the property `filename` and check its kind.

    Args:
        props: of the plugin.
        kind: of the field.
        skips_thin: whether rays skip what is thin; None if the property says it.
    """
    name = read_filename(props)
    field = load_field(name)
    if field.kind != kind:
        raise InputError(
            f'{name}: holds a {field.kind}; use <volume type="{field.kind}">'
        )
    if skips_thin is None:
        skips_thin = bool(props.get("skip_thin", False))
    if not skips_thin:
        field.see_all()
    return field


def place_unit_cube(
    props: mi.Properties, field: AbstractField, pose: Pose
) -> mi.Properties:
    """Copy properties, with `to_world` from [0, 1]^3 to the field's box in the world.

    Media clip their rays to the box that Mitsuba derives from `to_world` of a volume;
    they never call a Python method for it.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = pose.scale * pose.rotation @ np.diag(field.upper - field.lower)
    matrix[:3, 3] = pose.translation + pose.scale * pose.rotation @ field.lower
    copy = mi.Properties(props)
    copy["to_world"] = mi.ScalarTransform4f(matrix)
    return copy


def read_limit(props: mi.Properties) -> float:
    """Read `density_limit`, 1/metre."""
    density_limit: Any = props.get("density_limit", dr.inf)
    limit = float(density_limit)
    if not limit > 0:
        raise InputError(f"density_limit: {limit}; must be positive, 1/metre")
    return limit


def read_step(props: mi.Properties, own: float) -> float:
    """Read `step_m`, metres in the field's frame."""
    step_m: Any = props.get("step_m", own)
    step = float(step_m)
    check_positive("step_m", step)
    return step


def read_quantity(props: mi.Properties) -> str:
    """Read `quantity`: what the volume evaluates to in a medium."""
    quantity = props.get("quantity", "density")
    if quantity not in QUANTITIES:
        raise InputError(f"quantity: {quantity!r}; allowed: {', '.join(QUANTITIES)}")
    return quantity


class AbstractFieldVolume(mi.Volume):
    """Field of one kind as a Mitsuba volume.

    Members set `kind` and register themselves.

    Args:
        props: of the plugin.
        posed: the field where it is, if it is loaded already: it is shared, and of the
            properties, those of a file count for nothing.
    """

    kind = ""
    field: Any  # of that kind
    skips_thin: bool | None = None

    def __init__(self, props: mi.Properties, posed: PosedField | None = None) -> None:
        spectrum.prepare()
        quantity, limit = read_quantity(props), read_limit(props)
        if posed is None:
            pose = read_pose(props)
            field = read_field(props, self.kind, self.skips_thin)
            field.refine(read_step(props, field.step_m))
            posed = PosedField(field, pose)
        super().__init__(place_unit_cube(props, posed.field, posed.placed))
        self.quantity, self.limit = quantity, limit
        self.relit = bool(props.get("relit", False))
        self.field, self.posed = posed.field, posed
        self._loaded = posed.placed
        # Mitsuba finds them here where `drjit.freeze` records a rendering
        self.live = [posed.field.live, posed.live]

    def parameters(self) -> dict[str, Any]:
        """Return what `traverse` exposes, by name: the same objects for good."""
        return self.field.parameters()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the parameters of the field, and its pose."""
        kind, moved = mi.ParamFlags, self.field.differentiable_by_position
        for name, value in self.parameters().items():
            cb.put(name, value, mi.ParamFlags.Differentiable)
        by_pose = kind.Differentiable if moved else kind.NonDifferentiable
        cb.put("to_world", self.posed.to_world, by_pose)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Hand changed parameters to the field; what is empty stays so.

        Raises:
            InputError: a value that is not allowed, with its name.
        """
        for name, value in self.parameters().items():
            if not keys or name in keys:
                self.field.set_parameter(name, value)
        if not keys or "to_world" in keys:
            try:
                self.posed.follow(f"{self.id()}.to_world")
            except InputError:
                raise
            except ValueError as err:
                raise InputError(
                    f"{self.id()}.to_world: {err}; fields take rotation, translation "
                    "and uniform scale"
                ) from err

    @contextmanager
    def tangents(self) -> Iterator[None]:
        """Let what kernels read have the tangents of the parameters.

        Raises:
            InputError: the pose has one.
        """
        if self.posed.has_pose_gradients:
            raise InputError(
                f"{self.id()}.to_world: has no derivative in forward mode; use "
                "dr.backward"
            )
        with self._tangents():
            yield

    def _tangents(self) -> AbstractContextManager[None]:
        """Do so for the field's parameters."""
        return nullcontext()

    def eval(self, it: mi.Interaction3f, active: Mask = True) -> Any:
        """Evaluate the quantity as a spectrum, (channels, n).

        Radiance counts as a reflectance: white is 1 in every channel.
        """
        if self.quantity == "density":
            return mi.Spectrum(self.eval_1(it, active))
        return spectrum.reflectance(self._evaluate(it, active)[1], it.wavelengths)

    def eval_1(self, it: mi.Interaction3f, active: Mask = True) -> mi.Float:
        """Evaluate density (n,), 1/metre, or the luminance of the radiance."""
        density, colour = self._evaluate(it, active)
        if self.quantity == "radiance":
            return mi.luminance(colour)
        return dr.minimum(density, self.limit) if self.limit < dr.inf else density

    def eval_3(self, it: mi.Interaction3f, active: Mask = True) -> mi.Vector3f:
        """Evaluate radiance (3, n), linear RGB, seen along the field's +z."""
        return mi.Vector3f(self._evaluate(it, active)[1])

    def _evaluate(self, it: mi.Interaction3f, active: Mask) -> Any:
        if not self.posed.placed.is_near(self._loaded):
            raise InputError(
                f"{self.id()}: a medium cannot follow to_world, since Mitsuba keeps "
                "the box in which the volume was loaded; load the scene again, or use "
                "field_integrator or field_emitter"
            )
        if self.posed.has_pose_gradients:
            raise InputError(
                f"{self.id()}.to_world: has no derivative in a medium; use "
                "field_integrator"
            )
        point, _ = self.posed.to_local(it.p, mi.Vector3f(0, 0, 1))
        lower = mi.Point3f(*map(float, self.field.lower))
        upper = mi.Point3f(*map(float, self.field.upper))
        inside = mi.Bool(active) & dr.all((point >= lower) & (point <= upper))
        return self.posed.eval(point, mi.Vector3f(0, 0, 1), inside)

    def max(self) -> float:
        """Return an upper bound of the density, 1/metre; 1 for radiance.

        A medium asks for it when it is built and after a change of its parameters.
        """
        if self.quantity == "radiance":
            return 1.0
        return min(self.field.density_bound() / self.posed.pose.scale, self.limit)

    def max_per_channel(self) -> list[float]:
        """Return :meth:`max` for each channel."""
        return [self.max()] * len(mi.Spectrum(0))

    def resolution(self) -> mi.ScalarVector3i:
        """Return vertices along the edges of the finest level."""
        return mi.ScalarVector3i(self.field.layout.max_resolution)

    def to_string(self) -> str:
        """Describe the checked parameters."""
        return (
            f"{self.kind}[{self.field}, quantity={self.quantity}, bbox={self.bbox()}]"
        )
