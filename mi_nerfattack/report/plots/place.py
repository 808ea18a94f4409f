"""A place in one picture: rendered from above with all that drives there, and views.

Lane centres have arrows in the direction of travel; the lane's borders are white lines.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mi_nerfattack.deploy.views.above import scene_above, surrogate_above
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, mount_matrix
from mi_nerfattack.render.camera.outside import Overhead, seen_at
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.report.plots.charts import DPI, RC, save
from mi_nerfattack.report.plots.map import (
    OBJECT,
    draw_lane,
    draw_objects,
    frame_map,
    lane_lines,
)
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.vehicle.route.route import Route

WIDTH_PX = 1600
CENTRE, START, END, CAMERA = "#00E5FF", "#00C853", "#FF1744", "#FF6D00"
_SAMPLES, _ARROWS = 240, 7  # of a drive's line
_REAR, _FRONT = 0.5, 1.9  # of a car's middle rear axle, in widths
_SENTENCE_COLOURS = {"REFUSED": "#B00020", "LOOK AT": "#9A5B00"}


@dataclass(frozen=True, eq=False)
class Overlay:
    """What is drawn over pictures of a place, all in metres of the world.

    Attributes:
        routes: lane centres.
        driven: arc lengths of start and end of a drive along the first route; None
            where there is none, and all routes count alike.
        objects: outlines (n, 2) on the ground by id.
        tops: points (3,) above the objects by id.
        starts: states (n, 3) that drives start from; the first is the nominal one.
        car_width_m: of the car.
        car_reference_m: of its states, ahead of its rear axle.
        camera: the car's; its frustum is drawn at the first start.
        paths: driven positions (n, 2) by title.
    """

    routes: Sequence[Route]
    driven: tuple[float, float] | None = None
    objects: Mapping[str, np.ndarray] = field(default_factory=dict)
    tops: Mapping[str, np.ndarray] = field(default_factory=dict)
    starts: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    car_width_m: float = 1.8
    car_reference_m: float = 0.0
    camera: Camera | None = None
    paths: Mapping[str, np.ndarray] = field(default_factory=dict)

    def overhead(self, longest_px: int) -> Overhead:
        """Frame all of it from above."""
        points = [lane_lines(route)[0] for route in self.routes]
        points += [self.starts[:, :2], *self.objects.values()]
        margin = max(1.5 * route.lane_width_m for route in self.routes)
        return Overhead.covering(np.concatenate(points), margin, longest_px)


@dataclass(frozen=True, eq=False)
class Look:
    """A picture that a camera at a pose made of a place.

    Attributes:
        image: (h, w, 3), uint8, sRGB.
        camera, camera_to_world: that made it, OpenCV axes.
        from_behind: whether the car is in front of it: route and car are drawn, too.
    """

    image: np.ndarray
    camera: Camera
    camera_to_world: np.ndarray
    from_behind: bool = False


def place_picture(
    path: str | Path,
    overlay: Overlay,
    overhead: Overhead,
    grounds: Mapping[str, np.ndarray],
    looks: Mapping[str, Look] | None = None,
    sentences: Sequence[str] = (),
    title: str = "",
) -> None:
    """Write the picture of a place as PNG.

    Args:
        path: the file.
        overlay: what is drawn.
        overhead: camera of all grounds.
        grounds: rendered pictures from above by title.
        looks: pictures through cameras by title.
        sentences: below the pictures.
        title: above all.
    """
    looks = looks or {}
    left, right, bottom, top = overhead.extent
    width_in = WIDTH_PX / DPI
    lines = [
        (line, text)
        for text in sentences
        for line in textwrap.wrap(text, 150, subsequent_indent="    ")
    ]
    aspect = (top - bottom) / (right - left)
    map_in = min((width_in / len(grounds) - 0.6) * aspect, 7.0) + 0.85
    view_in, shapes = 0.0, []
    if looks:
        shapes = [look.image.shape[1] / look.image.shape[0] for look in looks.values()]
        view_in = (width_in - 0.15 * len(looks)) / sum(shapes)
        view_in = min(view_in, 2.8) + 0.3
    text_in = 0.17 * len(lines) + 0.1 if lines else 0.0
    heights = [map_in, 0.55, *([view_in] if looks else []), *([text_in] * bool(lines))]
    with matplotlib.rc_context(RC):
        figure = Figure((width_in, sum(heights) + 0.4), DPI, layout="constrained")
        rows = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)
        rows[0, 0].suptitle(title, x=0.01, ha="left", fontweight="bold")
        for k, (name, image) in enumerate(grounds.items()):
            axis = rows[0, 0].add_subplot(1, len(grounds), k + 1)
            _draw_ground(axis, overlay, overhead, name=name, image=image)
        _draw_legend(rows[1, 0], rows[0, 0].axes[0])
        if looks:
            axes = rows[2, 0].subplots(
                1, len(looks), width_ratios=shapes, squeeze=False
            )
            for axis, (name, look) in zip(axes[0], looks.items(), strict=True):
                _draw_look(axis, overlay, name, look=look)
        if lines:
            for k, (line, text) in enumerate(lines):
                colour = _SENTENCE_COLOURS.get(text.partition(":")[0], "black")
                y = 1 - (k + 0.5) / len(lines)
                rows[-1, 0].text(0.01, y, line, va="center", color=colour)
        save(path, figure)


def routes_picture(
    path: str | Path,
    scene_path: str | Path,
    routes: Sequence[Route],
    camera: Camera,
    mount: CameraMount | None = None,
    sensor: SceneSensor | None = None,
    title: str = "",
) -> None:
    """Write the picture of a scene with all its routes, without objects and drives.

    Cost: some seconds of path tracing.

    Args:
        path: PNG file.
        scene_path: Mitsuba XML.
        routes: at least one; the first three are looked along from their starts.
        camera: that looks.
        mount: of the camera; None for the default.
        sensor: shows the scene's field, too, from above; None where there is none.
        title: above all.
    """
    overlay = Overlay(routes)
    overhead = overlay.overhead(560)
    scene = load_scene(scene_path)
    middles = [route.pose_at(route.length / 2) for route in routes]
    image = scene_above(scene, overhead, np.stack(middles)[:, :2], spp=4).image
    grounds = {f"{Path(scene_path).name}, from above": image}
    if sensor is not None:
        above = surrogate_above(sensor, overhead)
        grounds = {"Field, from above": above, **grounds}
    view, looks = MitsubaView(scene, camera, 4), {}
    for route in routes[:3]:
        pose = mount_matrix(route.pose_at(0.0)[None], mount or CameraMount())[0]
        shown = view.render(pose, 0).image
        looks[f"Start of {route.name}"] = Look(shown, camera, pose)
    place_picture(path, overlay, overhead, grounds=grounds, looks=looks, title=title)


def _draw_legend(figure: Any, axis: Any) -> None:
    """Name each kind of thing that a map shows once."""
    labels = dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    style = {"ncols": 5, "frameon": False, "columnspacing": 1.2}
    figure.legend(labels.values(), labels.keys(), loc="center", fontsize=8, **style)


def _draw_ground(
    axis: Axes, overlay: Overlay, overhead: Overhead, name: str, image: np.ndarray
) -> None:
    left, right, bottom, top = overhead.extent
    axis.imshow(image, extent=(left, right, bottom, top), interpolation="bilinear")
    for route in overlay.routes:
        _draw_route(axis, route, overlay)
    for (title, path), color in zip(overlay.paths.items(), cycle(_PATHS), strict=False):
        axis.plot(*path.T, color=color, linewidth=1.1, zorder=5, label=title)
    if overlay.camera is not None and len(overlay.starts):
        reach = 0.25 * max(right - left, top - bottom)
        corners = _frustum(overlay.starts[0], overlay.camera, reach)
        style: dict[str, Any] = {"facecolor": CAMERA, "alpha": 0.22, "zorder": 4}
        axis.fill(*corners.T, label="what the camera sees", **style)
    for state in overlay.starts[::-1]:
        corners = car_outline(state, overlay.car_width_m, overlay.car_reference_m)
        style = {"fill": False, "edgecolor": START, "zorder": 6}
        axis.fill(*corners.T, label="cars at the starts", **style)
    draw_objects(axis, list(overlay.objects.values()), on_ground=True)
    for label, outline in overlay.objects.items():
        x, y = outline.mean(0).tolist()
        axis.annotate(
            label, (x, y), (8, 8), textcoords="offset points", **_note(OBJECT)
        )
    frame_map(axis, name, overhead.extent)


def _note(colour: str) -> dict[str, Any]:
    box = {"facecolor": "black", "alpha": 0.65, "edgecolor": "none", "pad": 1.5}
    return {"color": colour, "fontsize": 8, "bbox": box, "zorder": 9}


def _draw_route(axis: Axes, route: Route, overlay: Overlay) -> None:
    draw_lane(axis, route, on_ground=True)
    axis.plot(*lane_lines(route)[0].T, color=CENTRE, linewidth=1.0, linestyle=":")
    begin, end = overlay.driven or (0.0, route.length)
    arc = np.linspace(begin, end, _SAMPLES)
    line = route.pose_at(arc)
    label = "route, in the direction of travel"
    axis.plot(*line[:, :2].T, color=CENTRE, linewidth=1.8, zorder=3, label=label)
    for s in np.linspace(begin, end, _ARROWS + 2)[1:-1]:
        tail, head = route.pose_at(np.array([s - 0.01 * (end - begin), s]))[:, :2]
        style = {"arrowstyle": "-|>", "color": CENTRE, "mutation_scale": 14}
        axis.annotate("", head, tail, arrowprops=style, zorder=6)
    style = {"markeredgecolor": "black", "zorder": 8}
    axis.plot(*line[0, :2], "o", color=START, label="start", **style)
    if not route.closed or overlay.driven:
        axis.plot(*line[-1, :2], "s", color=END, label="end", **style)
    if overlay.driven is None:
        at = (6, 6)
        x, y, _ = line[-1].tolist()
        axis.annotate(
            route.name, (x, y), at, textcoords="offset points", **_note(CENTRE)
        )


def _draw_look(axis: Axes, overlay: Overlay, name: str, look: Look) -> None:
    height, width = look.image.shape[:2]
    axis.imshow(look.image, extent=(0, width, height, 0), interpolation="nearest")

    def draw(points: np.ndarray, **style: Any) -> None:
        at = seen_at(look.camera, look.camera_to_world, points)
        axis.plot(*at.T, **style)

    if look.from_behind:
        for route in overlay.routes:
            centre, *borders = map(_raised, lane_lines(route))
            draw(centre, color=CENTRE, linewidth=1.2)
            for border in borders:
                draw(border, color="white", linewidth=1.0, linestyle=(0, (4, 2)))
        corners = car_outline(
            overlay.starts[0], overlay.car_width_m, overlay.car_reference_m
        )
        for ring in _car_box(corners, overlay.car_width_m):
            draw(ring, color=START, linewidth=1.5)
    for k, (label, top) in enumerate(overlay.tops.items()):
        at = seen_at(look.camera, look.camera_to_world, top[None])[0]
        if np.isfinite(at).all() and (0 <= at).all() and (at <= (width, height)).all():
            free = at[0], max(at[1] - 0.15 * height, (0.05 + 0.09 * (k % 3)) * height)
            pointer = {"arrowstyle": "-", "color": OBJECT}
            axis.annotate(
                label, at, free, ha="center", arrowprops=pointer, **_note(OBJECT)
            )
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_title(name)
    axis.set_anchor("N")
    axis.set_axis_off()


_PATHS = ("#2979FF", "#D500F9", "#76FF03", "#FF9100")


def _raised(points: np.ndarray, height_m: float = 0.02) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), height_m)])


def _frustum(state: np.ndarray, camera: Camera, reach: float) -> np.ndarray:
    half = math.radians(camera.fov_x_deg) / 2
    angles = state[2] + np.linspace(-half, half, 24)
    arc = state[:2] + reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([state[None, :2], arc])


def car_outline(
    state: np.ndarray, width_m: float, reference_m: float = 0.0
) -> np.ndarray:
    """Return the corners (4, 2) of a car; see `Overlay` for the last two arguments."""
    front, rear, y = _FRONT * width_m, -_REAR * width_m, width_m / 2
    front, rear = front - reference_m, rear - reference_m
    corners = np.array([[front, y], [rear, y], [rear, -y], [front, -y]])
    c, s = np.cos(state[2]), np.sin(state[2])
    return corners @ np.array([[c, s], [-s, c]]) + state[:2]


def _car_box(corners: np.ndarray, width_m: float) -> list[np.ndarray]:
    """Return the edges of a car's box as lines, (n, 3) each, from its outline."""
    ring = np.concatenate([corners, corners[:1]])
    low, high = _raised(ring, 0.1 * width_m), _raised(ring, 0.8 * width_m)
    posts = [np.stack([a, b]) for a, b in zip(low[:4], high[:4], strict=True)]
    return [low, high, *posts]
