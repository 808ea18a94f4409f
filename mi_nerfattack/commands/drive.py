"""``mi-nerfattack car drive``: a real car, or one in the simulated room."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mi_nerfattack.commands.shared.options import Settings
from mi_nerfattack.commands.shared.policy_file import PolicyFile, read_camera
from mi_nerfattack.commands.shared.terminal import Result, confirm, say
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.car.drive.config import DriveConfig
    from mi_nerfattack.car.drive.loop import DriveLoop, DriveSettings
    from mi_nerfattack.car.drive.rig import Rig, Trained
    from mi_nerfattack.car.drive.safety.judge import Stop
    from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
    from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
class DriveCommand:
    """Let a policy drive a car along a route, as long as a button is held.

    Whatever is old, lost, outside the fence or out of range brakes the car, centres its
    wheels and ends the drive; so does letting the button go. docs/car/reference.md
    lists the keys of CONFIG: devices, route, fence and limits.
    """

    config: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[CONFIG.toml]")
    ] = None
    """TOML file, whose paths start from its folder."""
    settings: Settings = ()
    """Set a key of CONFIG: tracker=vicon:192.168.0.2, speed_ms=0.5."""
    policy: str | None = None
    """TOML file with [policy] and the [camera] of training, a policy's file, expert (by
    the tracked pose), or the URL of car serve, http://HOST:PORT."""
    output: Path | None = None
    """New file for the log (.mcap); runs/drives/TIME.mcap by default."""
    simulated: tyro.conf.FlagCreatePairsOff[bool] = False
    """Drive in the rendered room, without devices, as fast as it renders."""
    on_block: tyro.conf.FlagCreatePairsOff[bool] = False
    """Let the wheels turn in the air: recordings may replace camera and tracker. Undo
    what CONFIG says by --set on_block=false."""
    dry_run: bool = False
    """Ask every device for five seconds, in which you hold the button and let it go;
    nothing moves."""
    json: bool = False
    """End with one line of JSON: how the drive ended, its log and its figures, or what
    --dry-run found."""

    def run(self) -> Result:
        """Read, open, state, arm, drive and sum up."""
        from mi_nerfattack.car.drive.config import read_config

        options = {
            "policy": self.policy,
            "log": None if self.output is None else str(self.output),
            "simulated": self.simulated or None,
            "on_block": self.on_block or None,
        }
        config = read_config(self.config, options, self.settings)
        config, trained = self._trained(config)
        config.check()
        route = config.read_route()
        settings = config.settings(route)
        say(_statement(config, route, settings))
        with _open_rig(config, route, trained) as rig:
            say(_sight(rig.devices.camera.camera, rig.mount))
            if self.dry_run:
                return _dry_run(rig, settings)
            stop, loop, written = _drive(rig, config, settings)
        measured = loop.measures.figures(route)
        figures = None if measured is None else dataclasses.asdict(measured)
        document = {
            "end": stop.cause.value,
            "message": stop.message,
            "braked": loop.was_braked,
            **written,
            "figures": figures,
        }

        def show() -> None:
            if figures is not None:
                say(_summary(figures))

        if (error := _raised(stop)) is not None:
            show()
            raise error
        return Result(document, show, 0 if stop.cause.is_planned else 1)

    def _trained(self, config: DriveConfig) -> tuple[DriveConfig, Trained]:
        """Return the drive with the unit and the car of its policy, and the policy."""
        from mi_nerfattack.car.drive.config import EXPERT, PERIOD_S, SCHEMES
        from mi_nerfattack.car.drive.rig import Trained

        name = config.policy
        if name is None:
            raise InputError(
                f"--policy: none; give a file, {EXPERT}, or http://HOST:PORT"
            )
        is_local = name != EXPERT and not name.startswith(SCHEMES)
        file = PolicyFile.read(name) if is_local else None
        rig = file and file.rig
        if config.camera_file is not None:
            rig = read_camera(config.camera_file)
        policy, unit, wheelbase_m = None, "rad" if name == EXPERT else None, None
        if file is not None:
            from mi_nerfattack import variant

            variant.ensure()
            policy = file.section.build(file.views)
            period_s = PERIOD_S if file.vehicle is None else file.vehicle.dt_s
            if not math.isclose(period_s, PERIOD_S):
                raise InputError(
                    f"{name}: vehicle.dt_s: {period_s:g}; the car gets a control each "
                    f"{PERIOD_S:g} s: take a policy of this control period"
                )
            unit, wheelbase_m = file.control()
        config = config.driven_by(unit, wheelbase_m)
        if rig is None:
            return config, Trained(policy)
        rig.require_one(f"{name}", "the car has one: take a policy of one")
        mount = rig.mounts[0]
        if config.camera_file is None and file is not None and file.vehicle is not None:
            mount = file.vehicle.car().from_axle(mount)
        return config, Trained(policy, rig.cameras[0], mount)


def _open_rig(
    config: DriveConfig, route: Route, trained: Trained
) -> AbstractContextManager[Rig]:
    """Open the car's devices, or those of the rehearsal, which need Mitsuba."""
    from mi_nerfattack.car.drive.rig import open_rig

    overlaid = None
    if config.simulated or config.overlay is not None:
        from mi_nerfattack import variant

        variant.ensure()
    if config.overlay is not None:
        from mi_nerfattack.props.overlaid import overlaid_by

        overlaid = overlaid_by(Path(config.overlay), config.body)
    if config.simulated:
        from mi_nerfattack.props.rehearsal import open_rehearsal

        return open_rehearsal(config, route, trained, overlaid=overlaid)
    return open_rig(config, route, trained, confirm=confirm, overlaid=overlaid)


_UNBRAKED = (
    "no brake could be sent; the motor controller brakes by its own timeout, and the "
    "wheels stay as they are"
)


def _statement(config: DriveConfig, route: Route, settings: DriveSettings) -> str:
    """Say all that matters before anything moves."""
    ages, limits = settings.judge.ages, settings.limits
    corners = " ".join(f"({x:.2f}, {y:.2f})" for x, y in settings.judge.fence.points)
    where = "the simulated room" if config.simulated else config.camera
    is_cut = (config.speed_ms or 0.0) > route.speed_ms
    cut = f", cut from {config.speed_ms} by max_speed_ms" if is_cut else ""
    lines = [
        f"Policy     {config.policy}, control in {config.control_unit}",
        f"Route      {route.name}, {route.length:.1f} m, at {route.speed_ms:g} m/s"
        f"{cut}",
        f"Fence      {corners}, m",
        f"Limits     {limits.speed_ms:g} m/s, {limits.acceleration_ms2:g} m/s2, "
        f"{limits.steering_rad:g} rad, {limits.steering_rate:g} rad/s",
        f"Ages       frame {ages.frame_s:g} s, pose {ages.pose_s:g} s, loop "
        f"{ages.loop_s:g} s",
        f"Camera     {where}",
    ]
    if config.overlay is not None:
        lines.append(f"Overlay    the attacked box of {config.overlay}")
    if not config.simulated:
        lines += [
            f"Tracker    {config.tracker} from {config.tracker_sender or 'any'}, body "
            f"{config.body!r}, {config.rotation}",
            f"Motor      {config.port}, {config.calibration}",
            f"Enable     {config.enable}, button {config.button}",
        ]
    return "\n".join(lines)


def _sight(camera: Camera, mount: CameraMount | None) -> str:
    """Say what frames show, and from where."""
    bent = " ".join(f"{value:g}" for value in camera.distortion[:4])
    where = "not known; camera_file says it"
    if mount is not None:
        where = (
            f"{mount.forward_m:g} m ahead of the rear axle, {mount.height_m:g} m high, "
            f"{mount.pitch_deg:g} degrees down"
        )
        if mount.left_m or mount.yaw_deg:
            where += f", {mount.left_m:g} m and {mount.yaw_deg:g} degrees to the left"
    return (
        f"Frames     {camera.width} x {camera.height} px, fx {camera.fx:.2f}, fy "
        f"{camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}, distortion {bent}\n"
        f"Mount      {where}"
    )


def _drive(
    rig: Rig, config: DriveConfig, settings: DriveSettings
) -> tuple[Stop, DriveLoop, dict[str, Any]]:
    """Arm, and run the loop with its log; returns what that holds."""
    import time
    from contextlib import closing
    from datetime import datetime

    import mi_nerfattack
    from mi_nerfattack.backend.interrupts import held_interrupts
    from mi_nerfattack.car.drive.log import DriveLog
    from mi_nerfattack.car.drive.loop import DriveLoop

    path = config.log_path(datetime.now())
    metadata = {key: str(value) for key, value in config.model_dump().items()}
    metadata["version"] = mi_nerfattack.__version__
    devices, clock = rig.devices, rig.clock
    camera = devices.camera.camera
    log = DriveLog(path, camera, clock, wall_ns=time.time_ns(), description=metadata)
    say(f"Log        {path}")
    loop = DriveLoop(
        devices,
        settings,
        log,
        rounds=rig.rounds,
        clock=clock,
        sleep=rig.sleep,
        tell=say,
    )
    with closing(log):
        try:
            if config.simulated:
                devices.motor.arm()
            else:
                _arm(rig)
            say("Armed.")
            with held_interrupts() as interrupted, _hangups():
                stop = loop.run(interrupted)
                end = "braked, wheels centred" if loop.was_braked else _UNBRAKED
                say(f"{stop}: {end}")  # before an interrupt that came meanwhile
        finally:
            if not loop.measures.rows:
                log.discard()
                say(f"{path}: removed, for no command was sent")
    log_record = {"log": None, "messages": {}}
    if loop.measures.rows:
        log_record = {"log": str(path), "messages": dict(log.counts)}
        written = ", ".join(f"{n} {topic}" for topic, n in log.counts.items())
        say(f"{path}: {written}")
    return stop, loop, log_record


def _arm(rig: Rig) -> None:
    """Wait for the enable, and arm as long as it is held."""
    from mi_nerfattack.car.drive.safety.enable import check_held, wait_for_press

    enable = rig.devices.enable
    say("Lift the wheels off the floor: they turn for a second.")
    wait_for_press(enable, rig.sleep, say)
    rig.devices.motor.arm(partial(check_held, enable))


@contextmanager
def _hangups() -> Iterator[None]:
    """Let a terminal that is closed, as by the lid, end the drive like SIGTERM."""
    import signal

    number = getattr(signal, "SIGHUP", None)  # not on Windows
    if number is None:
        yield
        return
    before = signal.signal(number, lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(number, before)


def _dry_run(rig: Rig, settings: DriveSettings) -> Result:
    """Ask every device for five seconds, and say what speaks against driving."""
    from mi_nerfattack.car.drive.safety.judge import Cause, Stop, asked

    devices, judge = rig.devices, settings.judge
    body, end = settings.body, rig.clock() + 5.0

    def pose() -> None:
        newest = asked(Cause.TRACKER_LOST, lambda: devices.tracker.newest(body))
        judge.pose(newest, rig.clock(), devices.tracker, body)

    def frame() -> None:
        newest = asked(Cause.CAMERA_LOST, devices.camera.newest)
        judge.frame(newest, rig.clock())
        if newest is not None:
            asked(Cause.PILOT_LOST, lambda: devices.pilot.submit(newest))

    def decision() -> None:
        newest = asked(Cause.PILOT_LOST, devices.pilot.newest)
        judge.decision(newest, rig.clock(), False)

    def motor() -> None:
        judge.motor(asked(Cause.MOTOR_LOST, devices.motor.read))

    asks: dict[str, Callable[[], None]] = {
        "camera": frame,
        "tracker": pose,
        "motor": motor,
        "policy": decision,
    }
    problems, held = dict.fromkeys(asks, ""), set()
    say("Hold the enable button once within five seconds, and let it go.")
    while rig.clock() < end:
        held.add(devices.enable.is_held())
        for name, ask in asks.items():
            try:
                ask()
                problems[name] = ""
            except Stop as stop:
                problems[name] = str(stop)
        rig.sleep(settings.poll_s)
    frequency = "always" if True in held else "never"
    ill = f"it was {frequency} held; is it the right button?"
    problems["enable"] = "" if len(held) == 2 else ill
    lines = [f"{name:10} {problem or 'ready'}" for name, problem in problems.items()]
    document = {name: problem or None for name, problem in problems.items()}
    return Result(
        {"refused": document},
        lambda: print(*lines, sep="\n"),
        1 if any(problems.values()) else 0,
    )


def _summary(values: dict[str, float]) -> str:
    return (
        f"{values['laps']:.2f} laps in {values['duration_s']:.1f} s, "
        f"{values['commands']} commands\n"
        f"cross-track error: largest {values['largest_error_m']:.3f} m, mean "
        f"{values['mean_error_m']:.3f} m\n"
        f"period: {1e3 * values['period_s']:.1f} ms, standard deviation "
        f"{1e3 * values['period_jitter_s']:.1f} ms, longest "
        f"{1e3 * values['longest_period_s']:.1f} ms\n"
        f"frame to command: median {1e3 * values['latency_median_s']:.1f} ms, 99 % "
        f"within {1e3 * values['latency_99_s']:.1f} ms"
    )


def _raised(stop: Stop) -> BaseException | None:
    """Return what is raised as ever: a mistake of ours, and Ctrl-C."""
    from mi_nerfattack.car.drive.safety.judge import Cause

    if stop.cause is Cause.INTERRUPTED:
        return KeyboardInterrupt()
    return stop.__cause__ if stop.cause is Cause.EXCEPTION else None
