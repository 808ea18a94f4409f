"""A car's devices, opened as they are told, or those of the simulated room."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from mi_nerfattack.deploy.place import bundled_place
from mi_nerfattack.errors import InputError
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.robot.attacked import read_box
from mi_nerfattack.robot.camera.open import ZedOptions, open_camera
from mi_nerfattack.robot.camera.overlaid import OverlaidCamera
from mi_nerfattack.robot.devices import (
    AbstractCamera,
    AbstractPilot,
    AbstractTracker,
    Clock,
)
from mi_nerfattack.robot.drive.config import PERIOD_S, REMOTE, DriveConfig
from mi_nerfattack.robot.drive.loop import Devices
from mi_nerfattack.robot.drive.pilot import (
    Control,
    LocalPilot,
    expert_control,
    policy_control,
)
from mi_nerfattack.robot.drive.room import (
    SimulatedEnable,
    SimulatedMotor,
    SimulatedPilot,
    SimulatedRoom,
    SimulatedTracker,
    simulated_camera,
)
from mi_nerfattack.robot.drive.safety.enable import JoystickEnable
from mi_nerfattack.robot.drive.safety.watchdog import suspended_clock
from mi_nerfattack.robot.overlay import Overlay
from mi_nerfattack.robot.remote.pilot import RemotePilot
from mi_nerfattack.robot.remote.sealed import Endpoint, read_key
from mi_nerfattack.robot.tracker.open import open_tracker
from mi_nerfattack.robot.vesc.motor import VescMotor
from mi_nerfattack.vehicle.expert.choose import expert_for
from mi_nerfattack.vehicle.route.route import Route

_LAG_S = 0.1  # of the car's steering, which the expert reckons with


@dataclass(frozen=True)
class Rig:
    """Open devices, and their time.

    Attributes:
        devices: all of them.
        clock: of them.
        sleep: lets time pass.
        rounds: clock of the loop's rounds, for the watchdog.
        mount: of the camera; None where nobody says.
    """

    devices: Devices
    clock: Clock
    sleep: Callable[[float], None]
    rounds: Clock
    mount: CameraMount | None = None


@dataclass(frozen=True)
class Trained:
    """A policy, and what it was trained with; None where nobody says.

    Args:
        policy: that decides here; None of the expert and of a remote one.
        camera: its intrinsics.
        mount: its place on the car.
    """

    policy: AbstractPolicy | None = None
    camera: Camera | None = None
    mount: CameraMount | None = None


@contextmanager
def open_rig(
    config: DriveConfig,
    route: Route,
    trained: Trained,
    confirm: Callable[[str], bool],
) -> Iterator[Rig]:
    """Open the devices one after the other, and close all at the end.

    Nothing moves by this.

    Args:
        config: what to open.
        route: that is driven.
        trained: what decides.
        confirm: asked before the flash memory of an old motor controller is written.

    Raises:
        InputError: a device cannot be opened; the message names it.
        DeviceLostError: it does not answer.
        SetupError: a package is not installed.
    """
    with ExitStack() as stack:
        if config.simulated:
            yield _simulated(stack, config, route, trained)
        else:
            yield _real(stack, config, route, trained, confirm)


def _real(
    stack: ExitStack,
    config: DriveConfig,
    route: Route,
    trained: Trained,
    confirm: Callable[[str], bool],
) -> Rig:
    mount = trained.mount or bundled_place("room").mount
    clock, scales = time.monotonic, config.scales

    def path(name: str | None) -> Path | None:
        return None if name is None else Path(name)

    camera = trained.camera
    size = None if camera is None else (camera.width, camera.height)
    zed = ZedOptions(path(config.zed_calibration), config.zed_mode, size)
    if not config.camera.startswith("zed:"):
        zed = None
    seen = open_camera(config.camera, camera, zed, clock=clock)
    stack.callback(seen.close)
    assert config.tracker is not None  # see `DriveConfig.check`
    tracker = open_tracker(
        config.tracker, mount, config.rotation, config.tracker_sender, clock
    )
    stack.callback(tracker.close)
    seen = _overlaid(config, seen, tracker, mount)
    enable = JoystickEnable(config.enable, config.button, clock, config.silence_s)
    stack.callback(enable.close)
    pilot = _pilot(config, route, trained.policy, tracker, clock)
    stack.callback(pilot.close)
    motor = VescMotor(config.port, scales, confirm)
    stack.callback(motor.close)
    devices = Devices(seen, tracker, motor, pilot, enable)
    return Rig(devices, clock, time.sleep, suspended_clock, trained.mount)


def _overlaid(
    config: DriveConfig,
    camera: AbstractCamera,
    tracker: AbstractTracker,
    mount: CameraMount,
) -> AbstractCamera:
    """Return the camera with the attacked box in its frames, if there is one."""
    if config.overlay is None:
        return camera
    box, _ = read_box(Path(config.overlay))
    overlay = Overlay(box, camera.camera, keyed=False)
    return OverlaidCamera(camera, overlay, tracker, config.body, mount)


def _pilot(
    config: DriveConfig,
    route: Route,
    policy: AbstractPolicy | None,
    tracker: AbstractTracker,
    clock: Clock,
) -> AbstractPilot:
    name = config.policy or ""
    if name.startswith(REMOTE):
        endpoint = Endpoint.parse(name.removeprefix(REMOTE))
        key = read_key(None if config.key is None else Path(config.key), endpoint)
        return RemotePilot(endpoint, key, config.jpeg_quality, clock)
    return LocalPilot(_control(config, route, policy, tracker), clock)


def _control(
    config: DriveConfig,
    route: Route,
    policy: AbstractPolicy | None,
    tracker: AbstractTracker,
) -> Control:
    if policy is not None:
        control = policy_control(policy, route.goal)
        return lambda frame: control(frame.image)
    car = config.car
    expert = expert_for(
        car.control_unit, route, PERIOD_S, car.max_control, car.wheelbase, _LAG_S
    )
    return expert_control(expert, tracker, config.body)


def _simulated(
    stack: ExitStack, config: DriveConfig, route: Route, trained: Trained
) -> Rig:
    if (config.policy or "").startswith(REMOTE):
        raise InputError(
            "--simulated: its time is not that of another computer; give a policy that "
            "decides here"
        )
    place = bundled_place("room")
    place = replace(
        place,
        camera=trained.camera or place.camera,
        mount=trained.mount or place.mount,
    )
    room = SimulatedRoom(config.car, route.pose_at(0.0))
    tracker, camera = SimulatedTracker(room), simulated_camera(room, place, config.spp)
    stack.callback(camera.close)
    seen = _overlaid(config, camera, tracker, place.mount)
    control = _control(config, route, trained.policy, tracker)
    pilot = SimulatedPilot(control, room)
    motor, enable = SimulatedMotor(room), SimulatedEnable(room)
    stack.callback(motor.close)
    devices = Devices(seen, tracker, motor, pilot, enable)
    return Rig(devices, room.clock, room.sleep, room.clock, place.mount)
