"""A car's devices, opened as the settings of the drive name them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mi_nerfattack.car.camera.open import ZedOptions, open_camera
from mi_nerfattack.car.devices import (
    AbstractCamera,
    AbstractTracker,
    Clock,
)
from mi_nerfattack.car.drive.config import PERIOD_S, SCHEMES, DriveConfig
from mi_nerfattack.car.drive.loop import Devices
from mi_nerfattack.car.drive.pilot import (
    Control,
    LocalPilot,
    expert_control,
    http_control,
    policy_control,
)
from mi_nerfattack.car.drive.safety.enable import JoystickEnable
from mi_nerfattack.car.drive.safety.judge import suspended_clock
from mi_nerfattack.car.tracker.open import open_tracker
from mi_nerfattack.car.vesc.motor import VescMotor
from mi_nerfattack.deploy.car import SMALL_CAR_MOUNT
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.network import read_token
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.http.client import PolicyClient
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
from mi_nerfattack.vehicle.expert.choose import expert_for
from mi_nerfattack.vehicle.route.route import Route

#: Changes what a camera shows; gets it, the tracker, and its mount on the car.
Overlaid = Callable[[AbstractCamera, AbstractTracker, CameraMount], AbstractCamera]

_ANSWER_S = 5.0  # longest wait for a server; the ages stop the car long before
_LAG_S = 0.1  # of the car's steering, which the expert reckons with


@dataclass(frozen=True)
class Rig:
    """Open devices, and their time.

    Attributes:
        devices: all of them.
        clock: of them.
        sleep: lets time pass.
        rounds: clock of the loop's rounds.
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
        policy: that decides here; None of the expert and of one behind a URL.
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
    overlaid: Overlaid | None = None,
) -> Iterator[Rig]:
    """Open the devices one after the other, and close all at the end.

    Nothing moves by this.

    Args:
        config: what to open.
        route: that is driven.
        trained: what decides.
        confirm: asked before the flash memory of an old motor controller is written.
        overlaid: puts an attacked box into the frames; None for none.

    Raises:
        InputError: a device cannot be opened; the message names it.
        DeviceLostError: it does not answer.
        SetupError: a package is not installed.
    """
    if overlaid is not None and trained.mount is None:
        raise InputError(
            "overlay: nobody says where the camera is on the car; give camera_file, a "
            "TOML file with the [camera] of training"
        )
    mount, camera = trained.mount or SMALL_CAR_MOUNT, trained.camera
    clock, scales, zed = time.monotonic, config.scales, None
    if config.camera.startswith("zed:"):
        file = config.zed_calibration
        size = None if camera is None else (camera.width, camera.height)
        zed = ZedOptions(None if file is None else Path(file), config.zed_mode, size)
    assert config.tracker is not None  # see `DriveConfig.check`
    with ExitStack() as stack:
        camera_device = open_camera(config.camera, camera, zed, clock=clock)
        stack.callback(camera_device.close)
        tracker = open_tracker(
            config.tracker,
            mount,
            config.rotation,
            sender=config.tracker_sender,
            clock=clock,
        )
        stack.callback(tracker.close)
        if overlaid is not None:
            camera_device = overlaid(camera_device, tracker, mount)
        enable = JoystickEnable(
            config.enable, config.button, clock, silence_s=config.silence_s
        )
        stack.callback(enable.close)
        pilot = LocalPilot(
            begin_control(config, route, trained.policy, tracker=tracker), clock
        )
        stack.callback(pilot.close)
        motor = VescMotor(config.port, scales, confirm)
        stack.callback(motor.close)
        devices = Devices(camera_device, tracker, motor, pilot=pilot, enable=enable)
        yield Rig(devices, clock, time.sleep, suspended_clock, trained.mount)


def begin_control(
    config: DriveConfig,
    route: Route,
    policy: AbstractPolicy | None,
    tracker: AbstractTracker,
) -> Callable[[], Control]:
    """Return what begins to control without memory, see `LocalPilot`."""
    if policy is not None:

        def begin() -> Control:
            control = policy_control(policy, route.goal)
            return lambda frame: control(frame.image)

        return begin
    if config.policy is not None and config.policy.startswith(SCHEMES):
        token = "" if config.token_file is None else read_token(Path(config.token_file))
        client = PolicyClient(config.policy, token, _ANSWER_S, retries=0)
        return partial(http_control, client, route.goal)
    car = config.car
    expert = expert_for(
        car.control_unit,
        route,
        PERIOD_S,
        max_control=car.max_control,
        wheelbase=car.wheelbase,
        lag=_LAG_S,
    )
    return partial(expert_control, expert, tracker, config.body)
