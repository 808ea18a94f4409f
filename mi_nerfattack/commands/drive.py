"""``mi-nerfattack car drive``: a real car, or one in the simulated room."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mi_nerfattack.commands.shared.evaluate_options import PolicyOptions
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.shared.terminal import confirm, say
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
    from mi_nerfattack.robot.drive.config import DriveConfig
    from mi_nerfattack.robot.drive.loop import DriveLoop, DriveSettings
    from mi_nerfattack.robot.drive.rig import Rig, Trained
    from mi_nerfattack.robot.drive.safety.judge import Stop
    from mi_nerfattack.vehicle.route.route import Route


@dataclass(frozen=True)
class DriveCommand:
    """Let a policy drive a car along a route, as long as a button is held.

    Whatever is old, lost, outside the fence or out of range brakes the car, centres its
    wheels and ends the drive; so does letting the button go. Options are keys of CONFIG
    with underscores, and come before it.
    """

    config: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[CONFIG.toml]")
    ] = None
    """What is said below, as a file; its paths start from its folder."""
    policy: str | None = None
    """File as for evaluate, expert (by the tracked pose), or remote:HOST:PORT of
    car serve. A TOML file with [policy] may also have the [camera] of training."""
    control_unit: str | None = None
    """Of the policy: rad, a steering angle (default), or rad/s."""
    key: str | None = None
    """File with the key of a remote policy."""
    jpeg_quality: int | None = None
    """Send frames to a remote policy as JPEG, 1 to 95; by default as they are."""
    routes_file: str | None = None
    """Routes, JSON; the bundled room's by default."""
    route: str | None = None
    """Name of the route: square."""
    speed_ms: float | None = None
    """Metres per second; the route's by default."""
    duration_s: float | None = None
    """Seconds after which the drive ends: 600."""
    camera: str | None = None
    """zed:/dev/video0 (default) or v4l:/dev/videoN; with --on-block video:FILE, too."""
    camera_file: str | None = None
    """TOML file with the [camera] of training, for expert and remote policies; that of
    the policy's own file by default."""
    zed_calibration: str | None = None
    """SN<serial>.conf of the ZED; the only one of its settings by default."""
    zed_mode: str | None = None
    """VGA (default), HD720, HD1080, HD2K."""
    overlay: str | None = None
    """Finished run of attack: its box stands in every frame that the policy gets and
    the log has, by the tracked pose, before all else."""
    tracker: str | None = None
    """vicon:HOST[:PORT], this computer's address in the tracker's network, or
    motioncapture:KIND:HOST; with --on-block replay:FILE, too. To be given."""
    tracker_sender: str | None = None
    """Address of VICON's computer, by default that of the first that sends."""
    rotation: str | None = None
    """VICON's convention: euler (default) or rotation-vector."""
    body: str | None = None
    """The tracker's name of the car: racecar. Its origin is the middle of the rear
    axle, on the floor; x ahead, y left, z up."""
    port: str | None = None
    """Serial port of the VESC: /dev/ttyACM0."""
    calibration: str | None = None
    """File of calibrate; that of a RACECAR/J by default."""
    enable: str | None = None
    """Joystick with the button to hold: /dev/input/js0."""
    button: int | None = None
    """Its number, from 0: 5."""
    silence_s: float | None = None
    """Seconds without any event of the joystick after which the button counts as let
    go; for wireless ones that send all the time. Never by default."""
    fence: str | None = None
    """TOML file with points_m = [[x, y], ...] that the car's outline stays inside of;
    by default the rectangle around the route and --margin-m."""
    margin_m: float | None = None
    """Of that rectangle: 0.5."""
    max_speed_ms: float | None = None
    """Limit: 1.5."""
    max_steering_rad: float | None = None
    """Limit: 0.34."""
    max_acceleration_ms2: float | None = None
    """Limit: 1.0."""
    max_steering_rate: float | None = None
    """Limit, radians per second: 3.2."""
    wheelbase_m: float | None = None
    """Of the car: 0.325."""
    length_m: float | None = None
    """Of the car: 0.45."""
    width_m: float | None = None
    """Of the car: 0.296."""
    log: str | None = None
    """New file for the log (.mcap); runs/drives/TIME.mcap by default."""
    on_block: bool = False
    """Let recordings stand for camera and tracker: with the wheels lifted, alone."""
    simulated: bool = False
    """Drive in the rendered room, with none of the devices, as fast as it renders."""
    spp: int | None = None
    """Samples per pixel of the simulated camera: 4."""
    check: bool = False
    """Ask every device for five seconds, in which the button is to be held and let go;
    drive nothing."""
    json: bool = False
    """End with one line of JSON: how the drive ended, its log and its figures, or what
    --check found."""
    options: Annotated[
        PolicyOptions, tyro.conf.OmitArgPrefixes, tyro.conf.arg(name="policy")
    ] = PolicyOptions()
    """How the policy is called."""

    def run(self) -> Result:
        """Read, open, state, arm, drive and sum up."""
        from mi_nerfattack import variant
        from mi_nerfattack.robot.drive.config import read_config
        from mi_nerfattack.robot.drive.rig import open_rig

        config = read_config(self.config, self._given())
        variant.ensure()
        route = config.read_route()
        settings = config.settings(route)
        trained = self._trained(config)
        config.check()
        say(_statement(config, route, settings))
        with open_rig(config, route, trained, confirm) as rig:
            say(_sight(rig.devices.camera.camera, rig.mount))
            if self.check:
                return _check(rig, settings)
            stop, loop, written = _drive(rig, config, settings)
        found = loop.measures.figures(route)
        figures = None if found is None else dataclasses.asdict(found)
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

    def _given(self) -> dict[str, Any]:
        """Return the options of the drive that are on the command line."""
        own = ("config", "check", "json", "options")
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {
            name: value
            for name, value in values.items()
            if name not in own and value is not None and value is not False
        }

    def _trained(self, config: DriveConfig) -> Trained:
        from mi_nerfattack.robot.drive.config import EXPERT, REMOTE
        from mi_nerfattack.robot.drive.rig import Trained

        name = config.policy
        if name is None:
            raise InputError(
                f"--policy: none; give a file, {EXPERT}, or {REMOTE}HOST:PORT"
            )
        is_here = name != EXPERT and not name.startswith(REMOTE)
        policy = self.options.section(name).build() if is_here else None
        file = config.camera_file or (name if is_here else None)
        return Trained(policy, *(PolicyFile.read(file).camera or (None, None)))


_UNBRAKED = (
    "no brake could be sent; the motor controller brakes by its own timeout, and the "
    "wheels stay as they are"
)


def _statement(config: DriveConfig, route: Route, settings: DriveSettings) -> str:
    """Say all that matters before anything moves."""
    ages, limits = settings.judge.ages, settings.limits
    corners = " ".join(f"({x:.2f}, {y:.2f})" for x, y in settings.judge.fence.points)
    where = "the simulated room" if config.simulated else config.camera
    sent = f", frames as JPEG of quality {config.jpeg_quality}"
    is_cut = (config.speed_ms or 0.0) > route.speed_ms
    cut = f", cut from {config.speed_ms} by --max-speed-ms" if is_cut else ""
    lines = [
        f"Policy     {config.policy}, control in {config.control_unit}"
        f"{sent if config.jpeg_quality else ''}",
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
            f"Motor      {config.port}, {config.calibration or 'as a RACECAR/J'}",
            f"Enable     {config.enable}, button {config.button}",
        ]
    return "\n".join(lines)


def _sight(camera: Camera, mount: CameraMount | None) -> str:
    """Say what frames show, and from where."""
    bent = " ".join(f"{value:g}" for value in camera.distortion)
    where = "not known; --camera-file says it"
    if mount is not None:
        where = (
            f"{mount.forward_m:g} m ahead of the rear axle, {mount.height_m:g} m high, "
            f"{mount.pitch_deg:g} degrees down"
        )
    return (
        f"Frames     {camera.width} x {camera.height} px, fx {camera.fx:.2f}, fy "
        f"{camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}, distortion {bent}\n"
        f"Mount      {where}"
    )


def _drive(
    rig: Rig, config: DriveConfig, settings: DriveSettings
) -> tuple[Stop, DriveLoop, dict[str, Any]]:
    """Arm, and run the loop with its watchdog and its log; returns what that holds."""
    import time
    from contextlib import closing
    from datetime import datetime

    import mi_nerfattack
    from mi_nerfattack.backend.interrupts import held_interrupts
    from mi_nerfattack.robot.drive.log import DriveLog
    from mi_nerfattack.robot.drive.loop import DriveLoop
    from mi_nerfattack.robot.drive.safety.watchdog import Watchdog

    path = config.log_path(datetime.now())
    about = {key: str(value) for key, value in config.model_dump().items()}
    about["version"] = mi_nerfattack.__version__
    devices, clock = rig.devices, rig.clock
    camera = devices.camera.camera
    log = DriveLog(path, camera, clock, time.time_ns(), about)
    say(f"Log        {path}")
    watchdog = Watchdog(devices.motor.brake, settings.judge.ages.loop_s, rig.rounds)
    loop = DriveLoop(devices, settings, log, watchdog, clock, rig.sleep, say)
    with closing(log), closing(watchdog):
        try:
            if not config.simulated:
                watchdog.start()  # the simulated room's time stands still meanwhile
                _arm(rig)
            else:
                devices.motor.arm()
            say("Armed.")
            with held_interrupts() as interrupted, _hangups():
                stop = loop.run(interrupted)
                end = "braked, wheels centred" if loop.was_braked else _UNBRAKED
                say(f"{stop}: {end}")  # before an interrupt that came meanwhile
        finally:
            if not loop.measures.rows:
                log.discard()
                say(f"{path}: removed, for no command was sent")
    about_log = {"log": None, "messages": {}}
    if loop.measures.rows:
        about_log = {"log": str(path), "messages": dict(log.counts)}
        written = ", ".join(f"{n} {topic}" for topic, n in log.counts.items())
        say(f"{path}: {written}")
    return stop, loop, about_log


def _arm(rig: Rig) -> None:
    """Wait for the enable, and arm as long as it is held."""
    from mi_nerfattack.robot.drive.safety.enable import check_held, wait_for_press

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


def _check(rig: Rig, settings: DriveSettings) -> Result:
    """Ask every device for five seconds, and say what speaks against driving."""
    from mi_nerfattack.robot.drive.safety.judge import Cause, Stop, asked

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
    found, held = dict.fromkeys(asks, ""), set()
    say("Hold the enable button once within five seconds, and let it go.")
    while rig.clock() < end:
        held.add(devices.enable.is_held())
        for name, ask in asks.items():
            try:
                ask()
                found[name] = ""
            except Stop as stop:
                found[name] = str(stop)
        rig.sleep(settings.poll_s)
    how = "always" if True in held else "never"
    ill = f"it was {how} held; is it the right button?"
    found["enable"] = "" if len(held) == 2 else ill
    told = [f"{name:10} {problem or 'ready'}" for name, problem in found.items()]
    document = {name: problem or None for name, problem in found.items()}
    return Result(
        {"refused": document},
        lambda: print(*told, sep="\n"),
        1 if any(found.values()) else 0,
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
    from mi_nerfattack.robot.drive.safety.judge import Cause

    if stop.cause is Cause.INTERRUPTED:
        return KeyboardInterrupt()
    return stop.__cause__ if stop.cause is Cause.EXCEPTION else None
