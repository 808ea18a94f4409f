"""What ``mi-nerfattack car drive`` is told, on the command line or by a TOML file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from mi_nerfattack.deploy.car import SMALL_CAR, Car
from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.ranges import Acute, Count, NonNegative, Positive, Seconds, Whole
from mi_nerfattack.robot.drive.loop import DriveSettings
from mi_nerfattack.robot.drive.safety.fence import Fence
from mi_nerfattack.robot.drive.safety.judge import Ages, Judge
from mi_nerfattack.robot.drive.safety.limits import Limits, Steering
from mi_nerfattack.robot.vesc.calibration import Calibration, read_calibration
from mi_nerfattack.scenario.section import Section, read_section
from mi_nerfattack.vehicle.route.route import Route

_PATHS = (
    "routes_file",
    "calibration",
    "fence",
    "log",
    "zed_calibration",
    "key",
    "camera_file",
    "overlay",
)
_RECORDINGS = {"camera": "video:", "tracker": "replay:"}  # before a path
_OUT_OF_RANGE = 2.0  # of the largest steering: a control beyond it is nonsense
PERIOD_S = 0.1
EXPERT, REMOTE = "expert", "remote:"


class DriveConfig(Section):
    """A drive, all but its policy; keys of the file, and options.

    Attributes:
        policy: file, as for `evaluate`; "expert", which follows the route by the
            tracked pose; or "remote:HOST:PORT", a policy that `car serve` serves.
        control_unit: of the policy: "rad" of a steering angle, or "rad/s".
        key: file of the key that both computers share.
        jpeg_quality: of frames to a remote policy; None sends them as they are.
        route: name in `routes_file`, which is the bundled room's by default.
        speed_ms: to be kept; the route's by default.
        duration_s: after which the drive ends.
        camera: see `robot.camera.open`.
        camera_file: TOML file with the section [camera] of training.
        zed_calibration, zed_mode: of a ZED.
        overlay: finished run of `attack` whose box is pasted into every frame.
        tracker: see `robot.tracker.open`; none by default, for it listens in a network.
        tracker_sender: address of VICON's computer, the first that sends by default.
        rotation: VICON's convention.
        body: the tracker's name of the car.
        port: of the VESC.
        calibration: its file; that of a RACECAR/J by default.
        enable: joystick.
        button: its number.
        silence_s: after which without any event it counts as let go.
        fence: file; the rectangle around the route and `margin_m` by default.
        max_speed_ms, max_steering_rad, max_acceleration_ms2, max_steering_rate: limits.
        wheelbase_m, length_m, width_m: of the car.
        log: file; of the time of day by default.
        on_block: recordings may stand for camera and tracker, while wheels are lifted.
        simulated: in the rendered room, with none of the devices.
        spp: samples per pixel of its camera.
    """

    policy: str | None = None
    control_unit: Literal["rad", "rad/s"] = "rad"
    key: str | None = None
    jpeg_quality: Annotated[int, Field(ge=1, le=95)] | None = None
    routes_file: str | None = None
    route: str = "square"
    speed_ms: Positive | None = None
    duration_s: Seconds = 600.0
    camera: str = "zed:/dev/video0"
    camera_file: str | None = None
    zed_calibration: str | None = None
    zed_mode: str = "VGA"
    overlay: str | None = None
    tracker: str | None = None
    tracker_sender: str | None = None
    rotation: Literal["euler", "rotation-vector"] = "euler"
    body: Annotated[str, Field(min_length=1)] = "racecar"
    port: str = "/dev/ttyACM0"
    calibration: str | None = None
    enable: str = "/dev/input/js0"
    button: Whole = 5
    silence_s: Seconds | None = None
    fence: str | None = None
    margin_m: NonNegative = 0.5
    max_speed_ms: Positive = 1.5
    max_steering_rad: Acute = 0.34
    max_acceleration_ms2: Positive = 1.0
    max_steering_rate: Positive = 3.2
    wheelbase_m: Positive = SMALL_CAR.wheelbase
    length_m: Positive = SMALL_CAR.length
    width_m: Positive = SMALL_CAR.width
    log: str | None = None
    on_block: bool = False
    simulated: bool = False
    spp: Count = 4

    @property
    def car(self) -> Car:
        """The car's size, and how far it steers."""
        return Car(
            wheelbase=self.wheelbase_m,
            length=self.length_m,
            width=self.width_m,
            max_steer=self.max_steering_rad,
            control_unit="rad",
            max_control=self.max_steering_rad,
        )

    def check(self) -> None:
        """Refuse what would drive a car by something else than it seems.

        Raises:
            InputError: no tracker; a recording with a real motor; or an expert whose
                control would be taken in another unit.
        """
        if self.policy == EXPERT and self.control_unit != "rad":
            raise InputError(
                f"--control-unit {self.control_unit}: the expert steers in rad; leave "
                "it out"
            )
        if self.simulated:
            return
        if self.tracker is None:
            raise InputError(
                "--tracker: none; give vicon:ADDRESS, this computer's in the network "
                "of the tracker (and --tracker-sender), or motioncapture:KIND:HOST"
            )
        words = {"camera": self.camera, "tracker": self.tracker}
        is_recorded = any(
            words[key].startswith(kind) for key, kind in _RECORDINGS.items()
        )
        if is_recorded and not self.on_block:
            raise InputError(
                f"--camera {self.camera}, --tracker {self.tracker}: a recording does "
                "not see where the car is; give --on-block with the wheels lifted, or "
                "--simulated"
            )

    def read_route(self) -> Route:
        """Read the route, at the speed that is driven."""
        path = self.routes_file or bundled_place("room").routes
        found = Route.from_file(path, self.route)
        speed = self.speed_ms or found.speed_ms
        return Route(
            found.name,
            found.goal,
            found.points,
            found.lane_width_m,
            min(speed, self.max_speed_ms),
            found.closed,
        )

    def settings(self, route: Route) -> DriveSettings:
        """Return what the loop is told.

        Raises:
            InputError: the fence or the calibration cannot be read, or the motor cannot
                turn as slowly as this.
        """
        if not self.simulated:
            slowest = self.scales.erpm_least / self.scales.erpm_per_ms
            if route.speed_ms < slowest:
                raise InputError(
                    f"speed_ms: {route.speed_ms:g}; the motor controller holds "
                    f"{slowest:.2g} m/s at least (erpm_least of its calibration)"
                )
        fence = (
            Fence.around(route, self.margin_m)
            if self.fence is None
            else Fence.from_file(self.fence)
        )
        most = self.max_steering_rad
        if self.control_unit == "rad/s":
            most = route.speed_ms * math.tan(most) / self.wheelbase_m
        limits = Limits(
            self.max_speed_ms,
            self.max_steering_rad,
            self.max_acceleration_ms2,
            self.max_steering_rate,
        )
        return DriveSettings(
            body=self.body,
            speed_ms=route.speed_ms,
            judge=Judge(Ages(), fence, self.car, _OUT_OF_RANGE * most, PERIOD_S),
            limits=limits,
            steering=Steering(self.control_unit, self.wheelbase_m),
            duration_s=self.duration_s,
        )

    @cached_property
    def scales(self) -> Calibration:
        """The motor's calibration, read once.

        Raises:
            InputError: it cannot be read, or is of a car with another wheelbase.
        """
        if self.calibration is None:
            return Calibration()
        scales = read_calibration(self.calibration)
        if scales.wheelbase_m not in (None, self.wheelbase_m):
            raise InputError(
                f"{self.calibration}: its steering was measured with a wheelbase of "
                f"{scales.wheelbase_m:g} m, and wheelbase_m is {self.wheelbase_m:g}; "
                "give the car's to both"
            )
        return scales

    def log_path(self, now: datetime) -> Path:
        """Return the file for the log."""
        default = Path("runs/drives") / f"{now:%Y%m%d-%H%M%S}.mcap"
        return default if self.log is None else Path(self.log)


def read_config(path: Path | None, given: Mapping[str, Any]) -> DriveConfig:
    """Read a configuration.

    Args:
        path: TOML file, whose paths start from its folder; None without one.
        given: on the command line; these come first.

    Raises:
        InputError: the file cannot be read, or a value is not usable.
    """
    values: dict[str, Any] = {}
    if path is not None:
        values = files.read_toml(path)
        for key in _PATHS:
            if isinstance(value := values.get(key), str):
                values[key] = str(path.parent / value)
        for key, kind in _RECORDINGS.items():
            if isinstance(value := values.get(key), str) and value.startswith(kind):
                values[key] = f"{kind}{path.parent / value.removeprefix(kind)}"
        policy = values.get("policy")
        if isinstance(policy, str) and (path.parent / policy).is_file():
            values["policy"] = str(path.parent / policy)
    name = "drive" if path is None else str(path)
    return read_section(name, DriveConfig, {**values, **given}, Path())
