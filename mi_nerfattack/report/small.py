"""Small pictures of a route, drives, a field and a frame: a notebook shows them."""

from __future__ import annotations

import io
from collections.abc import Iterable
from functools import singledispatch
from typing import Any

import numpy as np
from PIL import Image

from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.pathtrace.frames import Frame, to_srgb
from mi_nerfattack.report.plots.charts import BLUE, GREEN, ORANGE, blank, png
from mi_nerfattack.report.plots.map import draw_lane, frame_map
from mi_nerfattack.report.plots.strip import Around, over_paper
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.rollout.loop import Trajectory
from mi_nerfattack.vehicle.route.route import Route

_SIZE_IN, _DPI = (6.0, 2.8), 100
_AZIMUTHS_DEG, _EDGE_PX = (30.0, 120.0, 210.0, 300.0), 160  # of a field's views


@singledispatch
def draw(thing: Any) -> bytes:
    """Draw an object as a PNG file.

    Args:
        thing: a `Route`, a `Drive`, a `Trajectory`, a `GridField` or a `Frame`.

    Raises:
        TypeError: there is no picture of such an object.
    """
    raise TypeError(f"{type(thing).__name__}: has no picture")


@draw.register
def _route(route: Route) -> bytes:
    """Draw the lane from above, its start green and its end orange."""
    with blank(_SIZE_IN, _DPI) as figure:
        axis = figure.subplots()
        draw_lane(axis, route)
        for point, colour in ((route.points[0], GREEN), (route.points[-1], ORANGE)):
            axis.plot(*point, "o", color=colour, markersize=6)
        frame_map(axis, f"{route.name}, {route.length:.0f} m")
        return png(figure)


@draw.register
def _drive(drive: Drive) -> bytes:
    """Draw the path from above, and the cross-track error over time."""
    with blank(_SIZE_IN, _DPI) as figure:
        above, errors = figure.subplots(1, 2)
        title = f"{drive.environment}, {drive.route}, {drive.case}"
        _draw_paths(above, [drive.states[:, :2]], title)
        errors.plot(drive.time_s, drive.cross_track_m, color=BLUE)
        errors.axhline(0, color="#9a9a9a", linewidth=0.8)
        errors.set_xlabel("time (s)")
        errors.set_title("cross-track error (m)")
        return png(figure)


@draw.register
def _trajectory(trajectory: Trajectory) -> bytes:
    """Draw the paths from above, and over time the controls; of several the first."""
    with blank(_SIZE_IN, _DPI) as figure:
        above, controls = figure.subplots(1, 2)
        vehicles = "vehicle" if trajectory.count == 1 else "vehicles"
        paths = trajectory.states_numpy()[:, :, :2]
        _draw_paths(above, paths, f"{trajectory.count} {vehicles}")
        time_s = trajectory.dt * np.arange(trajectory.horizon)
        commands = trajectory.controls_numpy()
        steering = commands if commands.ndim == 2 else commands[..., 0]
        controls.plot(time_s, steering.T, linewidth=1)
        controls.set_xlabel("time (s)")
        controls.set_title("the policy's control")
        return png(figure)


@draw.register
def _field(field: GridField) -> bytes:
    """Render the object from four sides, over white."""
    around = Around(field.lower, field.upper, _AZIMUTHS_DEG, edge_px=_EDGE_PX)
    views = [over_paper(*view) for view in around.views(field)]
    return _encoded((255 * np.concatenate(views, axis=1)).round().astype(np.uint8))


@draw.register
def _frame(frame: Frame) -> bytes:
    return _encoded(to_srgb("frame", frame))


def _draw_paths(axis: Any, paths: Iterable[np.ndarray], title: str) -> None:
    """Draw positions (T + 1, 2) from above; a dot is where each path starts."""
    for path in paths:
        (line,) = axis.plot(*path.T, linewidth=1.4)
        axis.plot(*path[0], "o", color=line.get_color(), markersize=4)
    frame_map(axis, title)


def _encoded(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()
