"""The control loop of a real car: ask, judge, send, write down."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mi_nerfattack.car.devices import (
    AbstractCamera,
    AbstractEnable,
    AbstractMotor,
    AbstractPilot,
    AbstractTracker,
    Clock,
    Command,
    Decision,
    Frame,
    MotorValues,
    TrackedPose,
)
from mi_nerfattack.car.drive.log import FATAL, INFO, DriveLog, Measures
from mi_nerfattack.car.drive.safety.judge import Cause, Judge, Rounds, Stop, asked
from mi_nerfattack.car.drive.safety.limits import Limits, Steering
from mi_nerfattack.car.drive.safety.speeds import Speeds
from mi_nerfattack.ranges import Positive, Seconds, checked

_NEWEST_S = 0.1  # of the speed by which a heading rate becomes an angle
_EARLY = 0.25  # of a period that a frame may come before it is due
_BRAKE_EVERY_S, _BRAKE_FOR_S = 0.05, 1.0


@dataclass(frozen=True)
class Devices:
    """What the loop asks and commands; see `car.devices`."""

    camera: AbstractCamera
    tracker: AbstractTracker
    motor: AbstractMotor
    pilot: AbstractPilot
    enable: AbstractEnable


@dataclass(frozen=True)
@checked("drive")
class DriveSettings:
    """What is driven, and how.

    Args:
        body: the tracker's name of the car.
        speed_ms: to be kept, within the limits.
        judge: of ages, place and controls.
        limits: of commands.
        steering: of the policy's control.
        duration_s: after which the drive ends.
        poll_s: between two rounds of the loop.
        is_tracked: whether the tracker sees the car drive; not with its wheels lifted.
    """

    body: str
    speed_ms: Positive
    judge: Judge
    limits: Limits
    steering: Steering
    duration_s: float = float("inf")
    poll_s: Seconds = 0.01
    is_tracked: bool = True


@dataclass(frozen=True)
class _Readings:
    """What the devices said in one round."""

    now_s: float
    frame: Frame | None
    pose: TrackedPose | None
    values: MotorValues | None
    decision: Decision | None
    is_held: bool


class DriveLoop:
    """Drives until a check fails, the time is up or the person lets go.

    Once per control period, the loop gives the newest frame to the pilot. The loop
    sends a command only when the pilot has decided on a new frame, because a command
    is the only sign of life that the motor controller gets. The loop checks all other
    devices in every round. However the drive ends, the loop first brakes the car and
    centres its wheels.

    Args:
        devices: the motor must be armed.
        settings: of the drive.
        log: of the drive; not closed here.
        rounds: clock of the rounds; see `suspended_clock`.
        clock: monotonic, seconds.
        sleep: waits for seconds.
        tell: shows a line to the person who drives.

    Attributes:
        measures: of the drive so far.
        was_braked: whether a brake was sent at its end.
    """

    def __init__(
        self,
        devices: Devices,
        settings: DriveSettings,
        log: DriveLog,
        rounds: Clock,
        clock: Clock,
        sleep: Callable[[float], None],
        tell: Callable[[str], None],
    ) -> None:
        self._devices, self._settings, self._log = devices, settings, log
        self._rounds = Rounds(settings.judge.ages.loop_s, rounds)
        self._clock, self._sleep, self._tell = clock, sleep, tell
        self.measures, self.was_braked = Measures(), False
        self._notes: list[Callable[[], None]] = []
        self._due_s = -np.inf  # of the next frame for the pilot
        self._pose_index: int | None = None
        self._values_s: float | None = None
        self._speeds = Speeds(settings.is_tracked)
        self._submitted = self._decided = -1  # last frame decided on, and sent for
        self._longest_s = 0.0  # round since the last command
        self._allowed, self._sent_s = Command(0.0, 0.0), clock()
        self._first_command_s: float | None = None

    def run(self, interrupted: Callable[[], None]) -> Stop:
        """Wait for the enable, drive, and stop.

        Args:
            interrupted: called in every round; raises KeyboardInterrupt where the
                drive is to end.

        Returns:
            Why it ended.
        """
        try:
            try:
                self._wait(interrupted)
                ending = self._drive(interrupted)
            finally:
                self._brake()
        except Stop as stop:
            ending = stop
        except KeyboardInterrupt:
            ending = Stop(Cause.INTERRUPTED, "by a signal, as Ctrl-C is")
        except Exception as error:
            ending = Stop(Cause.EXCEPTION, f"{type(error).__name__}: {error}")
            ending.__cause__ = error
        self._come_to_rest(ending)
        return ending

    def _wait(self, interrupted: Callable[[], None]) -> None:
        """Wait until the enable is pressed anew, and nothing speaks against driving."""
        was_released, last_kind, is_checked = False, None, False
        self._rounds.begin()
        while True:
            interrupted()
            readings = self._look()
            was_late = self._rounds.begin() > self._rounds.limit_s
            self._notes.clear()  # how the car stands and waits is not written
            problem = self._problem(readings)
            stays = problem is None and not was_late
            was_released = not readings.is_held or (was_released and stays)
            is_checked = is_checked and readings.is_held and stays
            if problem is not None:
                state = f"not ready: {problem}"
            elif not was_released:
                state = "ready: release the enable button, then hold it"
            elif not readings.is_held:
                state = "ready: hold the enable button to drive"
            elif not is_checked:  # which takes time: judge all once more afterwards
                asked(Cause.MOTOR_LOST, self._devices.motor.check)
                is_checked = True
                self._rounds.begin()
                continue
            else:
                self._say(INFO, "start", "the enable is held")
                # what is decided on the frames up to here has a memory of the wait
                self._devices.pilot.reset()
                self._decided = self._submitted
                return
            kind = state if problem is None else problem.cause
            if kind != last_kind:
                self._say(INFO, "waiting", state)
            last_kind = kind
            self._pause()

    def _drive(self, interrupted: Callable[[], None]) -> Stop:
        """Drive until the person who drives ends it, or raise what does."""
        end_s = self._clock() + self._settings.duration_s
        self._sent_s = self._clock()
        self._speeds = Speeds(self._settings.is_tracked)
        self._rounds.begin()
        while True:
            self._come_round()
            interrupted()
            readings = self._look()
            decision = readings.decision
            is_new = decision is not None and decision.frame_index > self._decided
            self._judge(readings, is_new)
            if readings.now_s >= end_s:
                return Stop(Cause.TIME_UP, f"{self._settings.duration_s:g} s")
            if decision is not None and is_new:
                self._send(decision, readings)
            self._pause()

    def _come_round(self) -> None:
        """Begin a round, unless it comes too late."""
        self._longest_s = max(self._longest_s, self._rounds.check())
        self._rounds.begin()

    def _look(self) -> _Readings:
        """Ask all devices, and give the pilot a frame that is due."""
        devices = self._devices
        frame = asked(Cause.CAMERA_LOST, devices.camera.newest)
        look = partial(devices.tracker.newest, self._settings.body)
        pose = asked(Cause.TRACKER_LOST, look)
        values = asked(Cause.MOTOR_LOST, devices.motor.read)
        self._note(pose, values)
        self._speeds.add(pose, values)
        if frame is not None and self._is_due(frame):
            self._submitted = frame.index
            asked(Cause.PILOT_LOST, partial(devices.pilot.submit, frame))
            self._notes.append(partial(self._log.frame, frame))
        decision = asked(Cause.PILOT_LOST, devices.pilot.newest)
        held = devices.enable.is_held()
        return _Readings(
            now_s=self._clock(),
            frame=frame,
            pose=pose,
            values=values,
            decision=decision,
            is_held=held,
        )

    def _is_due(self, frame: Frame) -> bool:
        period = self._settings.judge.period_s
        if frame.time_s < self._due_s - _EARLY * period:
            return False
        in_step = frame.time_s < self._due_s + 0.5 * period
        self._due_s = (self._due_s if in_step else frame.time_s) + period
        return True

    def _note(self, pose: TrackedPose | None, values: MotorValues | None) -> None:
        """Note what is new, to be written when there is time."""
        if pose is not None and pose.index != self._pose_index:
            self._pose_index = pose.index
            if np.isfinite(pose.body_to_world).all():
                self._notes.append(partial(self._log.pose, pose))
        if values is not None and values.time_s != self._values_s:
            self._values_s = values.time_s
            self._notes.append(partial(self._log.motor, values))

    def _check(self, readings: _Readings, first_command_s: float | None) -> None:
        """Judge all that must be right, driving or not."""
        judge, settings = self._settings.judge, self._settings
        judge.frame(readings.frame, readings.now_s)
        judge.pose(readings.pose, readings.now_s, self._devices.tracker, settings.body)
        judge.motor(readings.values, first_command_s)

    def _judge(self, readings: _Readings, is_new: bool) -> None:
        """Judge all that must be right to drive on.

        Args:
            readings: in this round.
            is_new: whether its decision is about to be sent.
        """
        self._rounds.check()
        if not readings.is_held:
            raise Stop(Cause.RELEASED, "or its device is gone")
        self._check(readings, self._first_command_s)
        self._speeds.check()
        self._settings.judge.decision(readings.decision, readings.now_s, is_new)

    def _problem(self, readings: _Readings) -> Stop | None:
        """Return what speaks against driving."""
        try:
            self._check(readings, None)
            self._settings.judge.decision(readings.decision, readings.now_s, False)
        except Stop as stop:
            return stop
        return None

    def _send(self, decision: Decision, readings: _Readings) -> None:
        """Send what a new decision asks for, as far as the limits allow."""
        settings = self._settings
        angle = settings.steering.angle(decision.control, self._speed(readings))
        request = Command(settings.speed_ms, angle)
        elapsed = min(self._clock() - self._sent_s, 2 * settings.judge.period_s)
        allowed = settings.limits.apply(request, self._allowed, elapsed)
        held = self._devices.enable.is_held()
        now = self._clock()
        # again, for this thread may have stood still since it asked
        self._judge(replace(readings, is_held=held, now_s=now), True)
        sent = asked(Cause.MOTOR_LOST, partial(self._devices.motor.send, allowed))
        self._speeds.command(self._clock(), allowed.speed_ms)
        # not what was sent: a motor that brakes below its slowest turns never starts
        self._allowed = allowed
        self._sent_s, self._decided = self._clock(), decision.frame_index
        if self._first_command_s is None:
            self._first_command_s = self._sent_s
        pose, frame = readings.pose, readings.frame
        assert pose is not None and frame is not None
        self.measures.add(self._sent_s, decision, pose)
        log, sent_s = self._log, self._sent_s
        self._notes.append(partial(log.command, sent_s, decision, request, sent))
        ages = {
            "frame_s": now - frame.time_s,
            "pose_s": now - pose.time_s,
            "decision_s": now - decision.frame_time_s,
            "loop_s": self._longest_s,
        }
        self._notes.append(partial(log.ages, now, **ages))
        self._longest_s = 0.0

    def _speed(self, readings: _Readings) -> float:
        """Return how fast the car drives, as nearly as is known."""
        tracked = self._speeds.tracked(_NEWEST_S)
        if tracked is None and readings.values is not None:
            tracked = readings.values.speed_ms
        return self._allowed.speed_ms if tracked is None else abs(tracked)

    def _pause(self) -> None:
        """Write what was noted, and wait for the next round."""
        notes, self._notes = self._notes, []
        for note in notes:
            note()
        self._sleep(self._settings.poll_s)

    def _brake(self) -> str | None:
        """Brake, and return why it cannot be sent; the car then brakes by itself."""
        try:
            self._devices.motor.brake()
        except Exception as error:  # nothing that goes wrong here may hide the cause
            return f"{type(error).__name__}: {error}"
        return None

    def _come_to_rest(self, stop: Stop) -> None:
        """Write why, and brake on for a while; nothing of this fails."""
        level = INFO if stop.cause.is_planned else FATAL
        say = self._log.say
        self._notes.append(partial(say, level, stop.cause.value, stop.message))
        now, last_problem = self._clock(), None
        end, due = now + _BRAKE_FOR_S, now
        while (now := self._clock()) < end:
            if now >= due:
                due, problem = now + _BRAKE_EVERY_S, self._brake()
                if problem is None:
                    self.was_braked = True
                    self._notes.append(partial(self._log.brake, now))
                with suppress(Exception):  # what fails, and why, is told already
                    if problem not in (None, last_problem):
                        self._say(FATAL, "brake not sent", problem)
                last_problem = problem
            with suppress(Exception):
                self._look_on()
            self._write_what_can_be()
            self._sleep(self._settings.poll_s)

    def _write_what_can_be(self) -> None:
        for note in self._notes:
            with suppress(Exception):
                note()
        self._notes.clear()

    def _look_on(self) -> None:
        """Ask the devices that tell how the car comes to rest."""
        pose = self._devices.tracker.newest(self._settings.body)
        self._note(pose, None)
        self._note(None, self._devices.motor.read())

    def _say(self, level: int, name: str, message: str) -> None:
        self._tell(message)
        self._notes.append(partial(self._log.say, level, name, message))
