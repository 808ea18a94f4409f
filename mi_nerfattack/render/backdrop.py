"""Layers of a depth composite that are constants: seen, never differentiated."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays


class AbstractBackdrop(ABC):
    """What a ray shows of a scene that is no field.

    It has no parameters and no density, so it can be laid over and under fields by
    depth, and not be merged with them.

    Attributes:
        name: for messages.
        has_gradients: false; as of a field, whether derivatives are asked for.
        has_pose_gradients: likewise.
    """

    name: str
    has_gradients = False
    has_pose_gradients = False

    @abstractmethod
    def march(self, rays: Rays, stop: float) -> March:
        """Return what rays show: premultiplied linear radiance, opacity, moment.

        Args:
            rays: n rays; their jitter and gains count for nothing.
            stop: transmittance below which a ray ends.
        """

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
    """Return the layers, all of which must have derivatives by the rays.

    Raises:
        InputError: one of them is a backdrop or a field that is not continuous.
    """
    fields = only_fields(layers, "a backdrop is not differentiated by rays", DETACH)
    for item in fields:
        if not item.field.differentiable_by_position:
            raise InputError(
                f"{item.field.kind}: its values jump at the faces of bricks, so that "
                f"it has no derivatives by rays; {DETACH}, or give the field that it "
                "was baked from"
            )
    return fields
