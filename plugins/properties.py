"""Properties that several plugins read."""

from __future__ import annotations

from typing import Any, TypeAlias

import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import AbstractComposite
from mi_nerfattack.render.interleaved import COMPOSITES
from mi_nerfattack.render.march import STOP
from mi_nerfattack.scenes import resolve

# Which lanes are active: Mitsuba passes an array, or leaves the default.
Mask: TypeAlias = "mi.Bool | bool"


def read_filename(props: mi.Properties) -> str:
    """Find the file that `filename` names: bundled, or in the scene's folder."""
    resolver = mi.file_resolver()  # pyright: ignore[reportCallIssue]  # no stub
    name: Any = props["filename"]
    return str(resolver.resolve(str(resolve(name))))


def read_pose(props: mi.Properties) -> Pose:
    """Read `to_world`: rotation, translation and uniform scale."""
    transform: Any = props.get("to_world", mi.ScalarTransform4f())
    try:
        return Pose.from_matrix(np.array(transform.matrix, np.float64))
    except ValueError as err:
        raise InputError(
            f"to_world: {err}; fields take rotation, translation and uniform scale"
        ) from err


def read_stop(props: mi.Properties) -> float:
    """Read `stop`, a transmittance."""
    transmittance: Any = props.get("stop", STOP)
    stop = float(transmittance)
    if not 0 <= stop < 1:
        raise InputError(f"stop: {stop}; allowed is 0 <= stop < 1")
    return stop


def read_composite(props: mi.Properties) -> AbstractComposite:
    """Read `composite`, the rule by which fields become one colour."""
    name: Any = props.get("composite", "interleaved")
    if name not in COMPOSITES:
        raise InputError(f"composite: {name!r}; allowed: {', '.join(COMPOSITES)}")
    return COMPOSITES[name]()


def read_nested(
    props: mi.Properties, plugin: str, kinds: tuple[type, ...], fewest: int = 1
) -> tuple[list[Any], list[Any]]:
    """Split nested objects into volumes of some kinds, and the others.

    Raises:
        InputError: there are too few volumes.
    """
    volumes, others = [], []
    for _, item in props.objects():
        (volumes if isinstance(item, kinds) else others).append(item)
    if len(volumes) < fewest:
        raise InputError(
            f"{plugin}: no nested volume; give one or more of grid_field, ngp_field "
            "and brick_field"
        )
    return volumes, others


def refuse_nested(others: list[Any], plugin: str, also: str = "") -> None:
    """Raise InputError if a nested object is left over."""
    if others:
        raise InputError(
            f"{plugin}: cannot use the nested {type(others[0]).__name__} "
            f"{others[0].id()!r}; allowed: grid_field, ngp_field, brick_field{also}"
        )


def background(volumes: list[Any], direction: mi.Vector3f) -> mi.Color3f:
    """Return what lies behind the first volume with a sky; black without one.

    The sky turns with the field.
    """
    for volume in volumes:
        field = getattr(volume, "field", None)  # splats have none
        if field is not None and field.has_sky:
            return volume.posed.background(direction)
    return mi.Color3f(0)
