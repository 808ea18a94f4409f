"""Layers of a depth composite that are no fields."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import drjit as dr

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.march import RayGradient
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain, March, Rays


class AbstractBackdrop(ABC):
    """What a ray shows of a scene that is no field.

    It has no density, so it can be laid over and under fields by depth, and not be
    merged with them. It stays where it is.

    Attributes:
        name: for messages.
        has_pose_gradients: false, since it does not move.
    """

    name: str
    has_pose_gradients = False

    @property
    @abstractmethod
    def has_gradients(self) -> bool:
        """Whether derivatives by its parameters are asked for."""

    def with_gain(self, gain: Gain) -> AbstractBackdrop:
        """Return itself: the light of a backdrop stays as it was captured."""
        del gain
        return self

    @abstractmethod
    def march(self, rays: Rays, stop: float) -> March:
        """Return what rays show: premultiplied linear radiance, opacity, moment.

        Args:
            rays: n rays; their jitter and gains count for nothing.
            stop: transmittance below which a ray ends.
        """

    @abstractmethod
    def derivative(
        self,
        mode: dr.ADMode,
        rays: Rays,
        primal: March,
        cotangent: March,
        stop: float,
        with_rays: bool = False,
    ) -> tuple[March, RayGradient]:
        """Propagate derivatives, as `march.march_derivative` does of a field.

        Args:
            mode: forward or backward.
            rays: as in the pass that gave `primal`.
            primal: what :meth:`march` returned.
            cotangent: derivative of the objective by it; ignored in forward mode.
            stop: as in that pass.
            with_rays: differentiate by the rays, too; in backward mode alone.

        Returns:
            the tangent of the march (forward mode; zeros otherwise), and the
            objective's derivatives by the rays (with them; zeros otherwise).
        """

    def backward_pose(self, rays: Rays, by_rays: RayGradient) -> None:
        """Do nothing, where a field accumulates the gradient of its pose."""
        del rays, by_rays

    @abstractmethod
    def state(self) -> list[Any]:
        """Return all that a kernel reads or was compiled for, for `drjit.freeze`."""


Layer = PosedField | AbstractBackdrop


#: What to do where a layer has no derivative by the rays.
DETACH = "keep the camera detached"


def only_fields(layers: Sequence[Layer], purpose: str, remedy: str) -> list[PosedField]:
    """Return the layers, all of which must be fields.

    Raises:
        InputError: one of them is a backdrop; with its name.
    """
    fields = [item for item in layers if isinstance(item, PosedField)]
    for item in layers:
        if isinstance(item, AbstractBackdrop):
            raise InputError(f"{item.name}: {purpose}; {remedy}")
    return fields


def fields_by_rays(layers: Sequence[Layer]) -> list[PosedField]:
    """Return the fields among layers, which must all have derivatives by the rays.

    Raises:
        InputError: one of them is a field that is not continuous.
    """
    fields = [item for item in layers if isinstance(item, PosedField)]
    for item in fields:
        if not item.field.differentiable_by_position:
            raise InputError(
                f"{item.field.kind}: its values jump at the faces of bricks, so that "
                f"it has no derivatives by rays; {DETACH}, or give the field that it "
                "was baked from"
            )
    return fields
