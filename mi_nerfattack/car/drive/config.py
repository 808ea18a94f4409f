"""The settings of ``mi-nerfattack car drive``: the command line or a TOML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from mi_nerfattack.car.drive.loop import DriveSettings
from mi_nerfattack.car.drive.safety.fence import Fence
from mi_nerfattack.car.drive.safety.judge import Ages, Judge
from mi_nerfattack.car.drive.safety.limits import Limits, Steering
from mi_nerfattack.car.vesc.calibration import Calibration, read_calibration
from mi_nerfattack.deploy.car import SMALL_CAR, Car
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.overrides import set_keys
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.ranges import Acute, Count, Natural, NonNegative, Positive, Seconds
from mi_nerfattack.scenario.section import Section, read_section
from mi_nerfattack.scenes import BUNDLED, bundled
from mi_nerfattack.vehicle.route.route import Route
from mi_nerfattack.vehicle.steering import heading_rate

_PATHS = (
    "routes_file",
    "calibration",
    "fence",
    "log",
    "zed_calibration",
    "token_file",
    "camera_file",
    "overlay",
)
_RECORDINGS = {"camera": "video:", "tracker": "replay:"}  # before a path
_OUT_OF_RANGE = 2.0  # of the largest steering: a control beyond it is nonsense
PERIOD_S = 0.1
EXPERT, SCHEMES, RACECAR_J = "expert", ("http://", "https://"), "racecar-j"


class DriveConfig(Section):
    """A drive, all but its policy; docs/car/reference.md lists the keys."""

    policy: str | None = None
    control_unit: Literal["rad", "rad/s"] = "rad"
    token_file: str | None = None
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
    button: Natural = 5
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

    def driven_by(self, unit: str | None, wheelbase_m: float | None) -> DriveConfig:
        """Return the drive of a policy.

        Args:
            unit: of the control that the policy gives; None where its file does not
                say.
            wheelbase_m: of the car that the policy's steering angles are for; None
                where its file does not say.

        Raises:
            InputError: a key has another value than the policy's file, or neither of
                them gives the unit.
        """
        policy_values = {"control_unit": unit, "wheelbase_m": wheelbase_m}
        said = {key: value for key, value in policy_values.items() if value is not None}
        for key, value in said.items():
            if key in self.model_fields_set and getattr(self, key) != value:
                raise InputError(
                    f"{key}: {getattr(self, key)!r}, and {self.policy} says {value!r}; "
                    "leave it out, or take another policy"
                )
        if unit is None and "control_unit" not in self.model_fields_set:
            raise InputError(
                f"control_unit: nobody says in which unit {self.policy} steers; give "
                "rad (a steering angle) or rad/s, or a TOML file with [vehicle]"
            )
        return self.model_copy(update=said)

    def check(self) -> None:
        """Refuse what would drive a car by something else than it seems.

        Raises:
            InputError: no tracker, no calibration, a recording with a real motor, or a
                token without a server.
        """
        if self.token_file is not None and not f"{self.policy}".startswith(SCHEMES):
            raise InputError(
                f"token_file: {self.token_file}, and policy {self.policy} is no URL; "
                "leave it out, or write policy.token_file into the policy's TOML file"
            )
        if self.simulated:
            return
        if self.tracker is None:
            raise InputError(
                "tracker: none; give vicon:ADDRESS, this computer's in the network "
                "of the tracker (and tracker_sender), or motioncapture:KIND:HOST"
            )
        if self.calibration is None:
            raise InputError(
                "calibration: none; give the file of car calibrate, or "
                f"{RACECAR_J} for the scales of that car"
            )
        words = {"camera": self.camera, "tracker": self.tracker}
        is_recorded = any(
            words[key].startswith(kind) for key, kind in _RECORDINGS.items()
        )
        if is_recorded and not self.on_block:
            raise InputError(
                f"camera {self.camera}, tracker {self.tracker}: a recording does "
                "not see where the car is; give --on-block with the wheels lifted, or "
                "--simulated"
            )

    def read_route(self) -> Route:
        """Read the route, at the speed that is driven."""
        path = self.routes_file or bundled("room/routes.json")
        route = Route.from_file(path, self.route)
        speed = self.speed_ms or route.speed_ms
        return Route(
            name=route.name,
            goal=route.goal,
            points=route.points,
            lane_width_m=route.lane_width_m,
            speed_ms=min(speed, self.max_speed_ms),
            closed=route.closed,
        )

    def settings(self, route: Route) -> DriveSettings:
        """Return the settings of the loop that drives the car.

        Raises:
            InputError: the fence or the calibration cannot be read, or the motor does
                not turn as slowly or as fast as the route's speed needs.
        """
        battery_least_v = 0.0
        if not self.simulated:
            scales, battery_least_v = self.scales, self.scales.battery_least_v
            if not scales.slowest_ms <= route.speed_ms <= scales.fastest_ms:
                raise InputError(
                    f"speed_ms: {route.speed_ms:g}; the motor controller holds "
                    f"{scales.slowest_ms:.2g} to {scales.fastest_ms:.2g} m/s "
                    "(erpm_least and erpm_most of its calibration)"
                )
        fence = (
            Fence.around(route, self.margin_m)
            if self.fence is None
            else Fence.from_file(self.fence)
        )
        most = self.max_steering_rad
        if self.control_unit == "rad/s":
            most = heading_rate(most, route.speed_ms, self.wheelbase_m)
        limits = Limits(
            speed_ms=self.max_speed_ms,
            steering_rad=self.max_steering_rad,
            acceleration_ms2=self.max_acceleration_ms2,
            steering_rate=self.max_steering_rate,
        )
        return DriveSettings(
            body=self.body,
            speed_ms=route.speed_ms,
            judge=Judge(
                ages=Ages(),
                fence=fence,
                car=self.car,
                max_control=_OUT_OF_RANGE * most,
                period_s=PERIOD_S,
                battery_least_v=battery_least_v,
            ),
            limits=limits,
            steering=Steering(self.control_unit, self.wheelbase_m),
            duration_s=self.duration_s,
            is_tracked=not self.on_block,
        )

    @cached_property
    def scales(self) -> Calibration:
        """The motor's calibration, read once.

        Raises:
            InputError: it cannot be read, or is of a car with another wheelbase.
        """
        if self.calibration in (None, RACECAR_J):
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


def read_config(
    path: Path | None, options: Mapping[str, Any], settings: Sequence[str] = ()
) -> DriveConfig:
    """Read a configuration.

    Args:
        path: TOML file, whose paths start from its folder; None without one.
        options: of the command line; these come first, None is not given.
        settings: keys that replace those of the file, see `overrides.set_keys`; their
            paths start from the working folder.

    Raises:
        InputError: the file cannot be read, or a value is not usable.
    """
    values: dict[str, Any] = {}
    if path is not None:
        values = files.read_toml(path)
        for key in _PATHS:
            if isinstance(value := values.get(key), str) and value != RACECAR_J:
                values[key] = str(path.parent / value)
        for key, kind in _RECORDINGS.items():
            if isinstance(value := values.get(key), str) and value.startswith(kind):
                values[key] = f"{kind}{path.parent / value.removeprefix(kind)}"
        policy = values.get("policy")
        elsewhere = (*SCHEMES, BUNDLED)
        if isinstance(policy, str) and not policy.startswith(elsewhere):
            values["policy"] = policy if policy == EXPERT else str(path.parent / policy)
    name = "drive" if path is None else str(path)
    chosen = {key: value for key, value in options.items() if value is not None}
    replaced = parse_toml(name, set_keys(name, "", settings))
    for key in replaced.keys() & chosen.keys():
        raise InputError(
            f"--set {key}: --{key} gives it, too; leave one out. The keys of a policy "
            "stand in its TOML file: give that as --policy"
        )
    values |= replaced | chosen
    return read_section(name, DriveConfig, values, folder=Path())
