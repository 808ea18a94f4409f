"""Deployment environments as `gymnasium` environments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.place import Conditions, Place, bundled_place
from mi_nerfattack.deploy.registry import ENVIRONMENTS, make_environment
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import missing
from mi_nerfattack.rollout.drive import departure_limits
from mi_nerfattack.vehicle.route.polyline import LARGEST_M
from mi_nerfattack.vehicle.route.route import Route, load_routes

try:
    import gymnasium
except ImportError as error:
    raise missing("gymnasium", "an environment of Gymnasium", error) from error

#: Depth that observations have where there is nothing, and the largest, metres.
FAR_M = 1000.0

_WORLD_M = 2 * LARGEST_M  # beyond what is driven from the farthest pose


class DrivingEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """Follow a route in a deployment environment.

    Observation, a `Dict`:

    - `image`: (height, width, 3) uint8, sRGB.
    - `depth`: (height, width) float32, metres along the ray, at most 1000 m. Where the
      ray hits nothing, the depth is 1000 m, too.
    - `camera_to_world`: (4, 4) float64, OpenCV axes, metres.
    - `goal`: (), the route's goal.

    Action: `Box` (k,) float32 from -1 to 1, one number for each of the k controls of
    `environment.control_names`. The first is the share of `environment.max_control`, in
    `environment.control_unit`; positive steers to the left. A positive number for
    another control is a share of its highest value, a negative one of its lowest.

    Reward: 1 where the vehicle is in the lane's centre after the step. The reward falls
    linearly to 0 where the vehicle's side passes the lane's border. So a step in the
    lane is always worth more than no step. Beyond the border the vehicle has left the
    lane, and the episode terminates. The episode is truncated at the end of the route,
    after `max_steps` steps, or where the environment has nothing more to observe.

    `info` holds `cross_track_m`, `arc_length_m`, `state` and, in a reset, `route`.
    Options of `reset`: `route`, the name of one of the routes; `pose`, (3,) x, y and
    heading. Without `route`, the seed draws a route; without `pose`, the episode
    begins at the route's start.

    Args:
        environment: what is driven; it is closed with this one.
        routes: at least one.
        width: of the vehicle, metres; less than that of every lane.
        max_steps: of an episode.
        margin_m: arc length before the route's end at which an episode is truncated,
            at least 0.
        render_mode: "rgb_array" or None.

    Raises:
        InputError: no route, a lane that is no wider than the vehicle, or an argument
            out of range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        environment: AbstractEnvironment,
        routes: Sequence[Route],
        width: float = 1.8,
        max_steps: int = 1000,
        margin_m: float = 2.0,
        render_mode: str | None = None,
    ) -> None:
        if not routes:
            raise InputError("routes: none; at least one route to follow")
        if not max_steps >= 1:
            raise InputError(f"max_steps: {max_steps}; at least 1")
        if not 0 <= margin_m < math.inf:
            raise InputError(f"margin_m: {margin_m}; a finite length of at least 0")
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode: {render_mode!r}; 'rgb_array' or None")
        self._limits = departure_limits(routes, width)
        self.environment, self.routes = environment, {r.name: r for r in routes}
        self.width, self.max_steps, self.margin_m = width, max_steps, margin_m
        self.render_mode = render_mode
        self.metadata = {
            **self.metadata,
            "render_fps": max(1, round(1 / environment.period)),
        }
        self.observation_space = _observations(environment, routes)
        size = len(environment.control_names)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self._route = routes[0]
        self._frame: CameraFrame | None = None
        self._steps, self._closed = 0, False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode; see the class for the options."""
        super().reset(seed=seed)
        self._require_open()
        options = options or {}
        unknown = set(options) - {"route", "pose"}
        if unknown:
            raise InputError(f"options: {', '.join(sorted(unknown))}; 'route', 'pose'")
        drawn = int(self.np_random.integers(len(self.routes)))
        name = options.get("route", list(self.routes)[drawn])
        if name not in self.routes:
            known = ", ".join(map(repr, self.routes))
            raise InputError(f"options.route: {name!r}; one of {known}")
        route, image_seed = self.routes[name], int(self.np_random.integers(2**31))
        frame = self.environment.reset(route, options.get("pose"), image_seed)
        self._route, self._frame, self._steps = route, frame, 0
        return self._observe(frame), {**self._info(), "route": name}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Hold a control for one period.

        Raises:
            InputError: the action is not one finite number for each control, or the
                environment is closed.
        """
        self._require_open()
        frame = self.environment.step(self._controls(action))
        self._frame, self._steps = frame, self._steps + 1
        info = self._info()
        share = abs(info["cross_track_m"]) / self._limits[self._route.name]
        reward, departed = max(0.0, 1.0 - share), share > 1.0
        over = self._steps >= self.max_steps or self.environment.is_over
        if not self._route.closed:
            over |= info["arc_length_m"] >= self._route.length - self.margin_m
        return self._observe(frame), reward, departed, over, info

    def render(self) -> np.ndarray | None:
        """Return the last image (height, width, 3), sRGB, or None."""
        if self.render_mode is None or self._frame is None:
            return None
        return self._frame.image.copy()

    def close(self) -> None:
        """Close the environment."""
        self._closed = True
        self.environment.close()

    def _controls(self, action: np.ndarray) -> float | np.ndarray:
        """Return the controls that an action stands for."""
        names, others = self.environment.control_names, self.environment.more_controls
        size = len(names)
        expected = (
            "one control, shape (1,)"
            if size == 1
            else f"{size} controls ({', '.join(names)}), shape ({size},)"
        )
        try:
            numbers = np.asarray(action)
        except (TypeError, ValueError) as error:
            raise InputError(f"action: {action!r}; {expected}") from error
        if numbers.size != size:
            raise InputError(f"action: shape {numbers.shape}; {expected}")
        if numbers.dtype.kind not in "iuf":
            raise InputError(f"action: {action!r}; a number from -1 to 1")
        if size == 1:
            return float(numbers.item()) * self.environment.max_control
        shares = numbers.reshape(-1).astype(np.float64)
        largest = self.environment.max_control
        high = np.array([largest, *(control.highest for control in others)])
        low = np.array([largest, *(-control.lowest for control in others)])
        return shares * np.where(shares < 0, low, high)

    def _require_open(self) -> None:
        if self._closed:
            raise InputError("DrivingEnv: it is closed; make another")

    def _info(self) -> dict[str, Any]:
        state = self.environment.state
        arc, error, _ = self._route.project_numpy(state[:3])
        return {
            "cross_track_m": float(error[0]),
            "arc_length_m": float(arc[0]),
            "state": state,
        }

    def _observe(self, frame: CameraFrame) -> dict[str, Any]:
        return {
            "image": frame.image,
            "depth": np.minimum(frame.depth, np.float32(FAR_M)).astype(np.float32),
            "camera_to_world": np.asarray(frame.camera_to_world, np.float64),
            "goal": np.int64(self._route.goal),
        }


def _observations(
    environment: AbstractEnvironment, routes: Sequence[Route]
) -> gymnasium.spaces.Dict:
    width, height = environment.rig.size
    size = (height, width)
    box, goals = gymnasium.spaces.Box, max(route.goal for route in routes) + 1
    return gymnasium.spaces.Dict(
        {
            "image": box(0, 255, (*size, 3), np.uint8),
            "depth": box(0.0, FAR_M, size, np.float32),
            "camera_to_world": box(-_WORLD_M, _WORLD_M, (4, 4), np.float64),
            "goal": gymnasium.spaces.Discrete(goals),
        }
    )


def make_gym(
    name: str,
    place: Place | str = "intersection",
    conditions: Conditions | None = None,
    routes: Sequence[str] = (),
    size_px: tuple[int, int] | None = None,
    render_mode: str | None = None,
    **options: Any,
) -> DrivingEnv:
    """Make a `DrivingEnv` of a registered environment; `gymnasium.make` calls it.

    Args:
        name: key of `ENVIRONMENTS`.
        place: or the name of a bundled one.
        conditions: of light and camera.
        routes: names in the place's file; all of them by default.
        size_px: width and height of the images; the place's camera decides by default,
            and a recording's own in any case.
        render_mode: "rgb_array" or None.
        **options: to `DrivingEnv`.

    Raises:
        InputError: the environment cannot be made, has images of another size than
            `size_px`, or does not suit the routes.
    """
    from mi_nerfattack import variant

    variant.ensure()
    place = bundled_place(place) if isinstance(place, str) else place
    if size_px is not None:
        place.rig.require_one("size_px", "leave it out, and size each camera")
        place = replace(place, camera=place.camera.resized(*size_px))
    chosen_routes = load_routes(place.routes, routes)
    environment = make_environment(name, place, conditions)
    options.setdefault("width", place.car.width)
    try:
        _check_size(name, environment, size_px)
        return DrivingEnv(
            environment, chosen_routes, render_mode=render_mode, **options
        )
    except InputError:
        environment.close()
        raise


def _check_size(
    name: str, environment: AbstractEnvironment, size_px: tuple[int, int] | None
) -> None:
    camera = environment.camera
    if size_px is not None and tuple(size_px) != (camera.width, camera.height):
        raise InputError(
            f"size_px: {size_px[0]} x {size_px[1]} px; environment {name!r} has images "
            f"of {camera.width} x {camera.height} px, as recorded; leave size_px out "
            "and resize what you observe"
        )


def register() -> None:
    """Register "mi_nerfattack/NAME-v0" for every environment; repeating is harmless."""
    for name in ENVIRONMENTS:
        key = f"mi_nerfattack/{name}-v0"
        if key not in gymnasium.registry:
            gymnasium.register(
                key, "mi_nerfattack.deploy.gym:make_gym", kwargs={"name": name}
            )


register()
