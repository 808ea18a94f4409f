"""Metric scale, upright axes and origin of a world of arbitrary frame and unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.colmap.follow import StageCallback
from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.markers import Markers, find_markers
from mi_nerfattack.capture.photographs.staging import copied
from mi_nerfattack.capture.photographs.tracked import HandEye, Tracked, fit_tracked
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Positive, checked

_LEAST_UP = 0.2  # length of the mean of unit vectors


@dataclass(frozen=True)
@checked("distance")
class Distance:
    """Metres between the places where two photographs were taken, by their names."""

    first: str
    second: str
    metres: Positive


@dataclass(frozen=True)
class Scale:
    """How the metric scale was found.

    Attributes:
        metres_per_unit: metres of one unit before the alignment; None where the scale
            is unknown.
        spread: relative standard deviation between markers; None without markers.
        markers: number of photographs that show each marker, by id.
        tracked: the fit to motion capture; None without motion capture.
    """

    metres_per_unit: float | None = None
    spread: float | None = None
    markers: Mapping[int, int] = field(default_factory=dict)
    tracked: HandEye | None = None


def align(
    structure: Structure,
    folder: Path,
    scale_source: float | Distance | Markers | Tracked | None,
    progress: StageCallback = lambda stage, done, total: None,
) -> tuple[Structure, Scale]:
    """Scale lengths to metres, turn z up and move the origin.

    z points up, against the mean of the images' downward directions, and the origin is
    the mean of the cameras; where markers lie flat, z = 0 is their plane. With motion
    capture, axes and origin are those of the motion capture system.

    Args:
        structure: with poses in any frame and unit.
        folder: of the photographs.
        scale_source: metres of one unit, or the distance, markers or motion capture
            from which the scale follows; None keeps the unit.
        progress: called with stage, done and total.

    Raises:
        InputError: the cameras have no common up, markers are not seen or contradict
            each other, motion capture cannot be used (see `fit_tracked`), or a
            photograph with a known place was not placed.
        SetupError: markers need OpenCV, which is not installed.
    """
    if isinstance(scale_source, Markers):
        markers = find_markers(folder, structure, scale_source, progress=progress)
        metres, spread = markers.scale(scale_source.edge_m)
        scale = Scale(metres, spread, dict(markers.views))
        if scale_source.flat:
            point, normal = markers.ground()
            return _on_ground(structure, metres, point, normal=normal), scale
        return upright(structure, metres), scale
    if isinstance(scale_source, Tracked):
        fit = fit_tracked(structure, scale_source)
        moved = _transformed(
            structure,
            fit.scale,
            np.array(fit.rotation),
            shift=np.array(fit.translation),
        )
        return moved, Scale(fit.scale, tracked=fit)
    metres = (
        _between(structure, scale_source)
        if isinstance(scale_source, Distance)
        else scale_source
    )
    return upright(structure, metres or 1.0), Scale(metres)


def _between(structure: Structure, distance: Distance) -> float:
    places = []
    for name in map(copied, (distance.first, distance.second)):
        if name not in structure.names:
            raise InputError(
                f"distance: {name!r} is not one of the {len(structure.names)} "
                f"photographs that were placed ({', '.join(structure.names[:3])}, "
                "...); give the names of two of them"
            )
        places.append(structure.camera_to_world[structure.names.index(name), :3, 3])
    apart = float(np.linalg.norm(places[0] - places[1]))
    if apart == 0:
        raise InputError(
            f"distance: {distance.first} and {distance.second} were taken at one "
            "place; give two that are far apart"
        )
    return distance.metres / apart


def upright(structure: Structure, scale: float) -> Structure:
    """Turn z up, move the origin to the cameras' mean, and scale lengths.

    Raises:
        InputError: the cameras have no common up.
    """
    poses = structure.camera_to_world
    up = -poses[:, :3, 1].mean(0)
    if np.linalg.norm(up) < _LEAST_UP:
        raise InputError(
            "photographs: their upward directions cancel, so that z cannot point up; "
            "turn the photographs upright first, or lay markers flat on the ground"
        )
    return _moved(structure, scale, up, origin=poses[:, :3, 3].mean(0))


def _on_ground(
    structure: Structure, scale: float, point: np.ndarray, normal: np.ndarray
) -> Structure:
    """Make a plane z = 0, the cameras above it and their mean above the origin."""
    centre = structure.camera_to_world[:, :3, 3].mean(0)
    height = float((centre - point) @ normal)
    return _moved(
        structure,
        scale,
        normal * np.sign(height or 1.0),
        origin=centre - height * normal,
    )


def _moved(
    structure: Structure, scale: float, up: np.ndarray, origin: np.ndarray
) -> Structure:
    turn = Rotation.align_vectors([0.0, 0.0, 1.0], up)[0].as_matrix()  # the smallest
    return _transformed(structure, scale, turn, shift=-scale * turn @ origin)


def _transformed(
    structure: Structure, scale: float, turn: np.ndarray, shift: np.ndarray
) -> Structure:
    result = structure.camera_to_world.copy()
    result[:, :3, :3] = turn @ result[:, :3, :3]
    result[:, :3, 3] = scale * result[:, :3, 3] @ turn.T + shift
    points = scale * structure.points @ turn.T + shift
    return replace(structure, camera_to_world=result, points=points)
