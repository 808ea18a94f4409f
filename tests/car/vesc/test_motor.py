"""A car that must stop by itself, against a stand-in that was written without us."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
import serial
from support.devices import vesc_host
from support.devices.controller import StandIn
from support.faults.injected import wait_for

from mi_nerfattack.car.devices import Command, DeviceLostError, MotorValues
from mi_nerfattack.car.vesc import timeout
from mi_nerfattack.car.vesc.calibration import Calibration
from mi_nerfattack.car.vesc.guided import drive_arc
from mi_nerfattack.car.vesc.link import WRITE_S, SerialLink
from mi_nerfattack.car.vesc.motor import VescMotor
from mi_nerfattack.errors import InputError


@pytest.fixture
def start(tmp_path):
    """Return what starts a stand-in with options of its command line."""
    started = []

    def start(*options: str) -> StandIn:
        started.append(StandIn(tmp_path / f"{len(started)}.jsonl", *options))
        return started[-1]

    yield start
    for stand_in in started:
        stand_in.close()


@pytest.fixture
def opened(start, request):
    """A car of some options, and its motor, which is not armed."""
    car = start(*getattr(request, "param", ()))
    with closing(VescMotor(car.port)) as motor:
        yield car, motor


def drive_to_speed(motor: VescMotor, car: StandIn) -> None:
    """Drive straight on until a command finds the car at 1 m/s."""

    def commands() -> list[dict[str, Any]]:
        return [line for line in car.log() if line["event"] == "command 8"]

    def is_fast() -> bool:
        before = len(commands())
        motor.send(Command(1.0, 0.0))
        wait_for(lambda: len(commands()) > before)
        return commands()[-1]["speed_ms"] > 0.97

    wait_for(is_fast)


def read_until(
    motor: VescMotor, condition: Callable[[MotorValues], object]
) -> MotorValues:
    """Read until values are as wanted."""
    readings: list[MotorValues] = []

    def is_met() -> object:
        values = motor.read()
        readings[:] = [] if values is None else [values]
        return values is not None and condition(values)

    wait_for(is_met)
    return readings[0]


def check_stopped(car: StandIn) -> None:
    """Check that the car braked at its timeout, and stopped within half a metre."""
    lines = car.wait_for(speed_ms=0.0, timed_out=True)
    last, end = lines[0], lines[-1]
    assert last["event"] == "command 8" and last["speed_ms"] > 0.95
    assert end["way_m"] - last["way_m"] < 0.5
    (fired,) = [line for line in lines if line["event"] == "timeout"]
    assert fired["time_s"] - last["time_s"] <= 0.25 + 0.02
    assert fired["mode"] == "brake"


def test_a_car_that_nobody_commands_stops(opened):
    car, motor = opened
    assert motor.firmware.minor == 5
    with pytest.raises(InputError, match="not armed"):
        motor.send(Command(1.0, 0.0))
    motor.arm()
    assert max(line["speed_ms"] for line in car.log()) == pytest.approx(0.5, abs=0.02)
    events = [line["event"] for line in car.log()]
    assert events.count("memory") == 1 and "flash" not in events
    drive_to_speed(motor, car)
    check_stopped(car)  # though its values are asked for
    values = read_until(motor, lambda values: values.has_timed_out)
    assert not values.is_killed
    assert values.input_voltage_v == 15.8 and values.fault_name == "none"


@pytest.mark.parametrize(
    "opened", [("--timeout-ms", "250", "--brake-a", "20")], indirect=True
)
def test_what_is_sent(opened):
    car, motor = opened
    motor.arm()
    assert "memory" not in [line["event"] for line in car.log()]  # it was right
    sent = motor.send(Command(0.3, 0.1))
    assert sent.speed_ms == pytest.approx(1384 / 4614)
    assert sent.steering_rad == pytest.approx((0.409 - 0.5304) / -1.2135)
    car.wait_for_line(servo=0.409, mode="rpm")
    assert motor.send(Command(0.05, 0.1)).speed_ms == 0.0
    car.wait_for_line(servo=0.409, mode="brake", event="command 7")
    with pytest.raises(InputError, match="finite"):
        motor.send(Command(0.1, float("nan")))
    motor.brake()
    assert car.wait_for(servo=0.53)[-1]["mode"] == "brake"
    car.tell("fault 2")
    values = read_until(motor, lambda values: values.fault)
    assert (values.fault, values.fault_name) == (2, "under voltage")
    car.tell("kill")
    read_until(motor, lambda values: values.is_killed)
    car.tell("mute")
    with pytest.raises(DeviceLostError, match=r"no answer for 0\.\d\d s"):
        read_until(motor, lambda values: False)
    with pytest.raises(InputError, match="not armed"):
        motor.send(Command(1.0, 0.0))


def test_a_controller_that_started_anew_is_noticed_before_it_moves(opened):
    """It was pushed farther than it had counted before: its values look as ever."""
    car, motor = opened
    motor.arm()
    motor.check()
    read_until(motor, lambda values: True)
    car.tell("restart")
    car.tell("push 20")
    car.wait_for_line(event="told push")
    read_until(motor, lambda values: (motor.values.tachometer or 0) > 5000)
    with pytest.raises(DeviceLostError, match="anew, and forgotten its timeout"):
        drive_arc(motor, Command(0.5, 0.0), 1.5, lambda: None)
    with pytest.raises(InputError, match="not armed"):
        motor.send(Command(0.5, 0.0))
    later = [line["event"] for line in car.log()]
    assert "command 8" not in later[later.index("told restart") :]


def test_nothing_moves_by_opening_and_closing(start):
    car = start()
    with closing(VescMotor(car.port)) as motor:
        assert read_until(motor, lambda values: True).fet_temperature_c == 31.2
    time.sleep(0.1)
    assert all(line["servo"] == 0.5 for line in car.log())
    assert not any("command" in line["event"] for line in car.log())


def test_a_pulled_plug(opened):
    car, motor = opened
    motor.arm()
    drive_to_speed(motor, car)
    car.tell("unplug")
    with pytest.raises(DeviceLostError, match="check its cable"):
        wait_for(lambda: motor.send(Command(1.0, 0.0)) is None)
    with pytest.raises(DeviceLostError):
        motor.read()
    check_stopped(car)


@pytest.mark.parametrize("error", [serial.SerialException, termios.error, TypeError])
def test_a_brake_is_sent_where_nothing_is_heard(opened, monkeypatch, error):
    car, motor = opened

    def read(*_):
        raise error("reads no more")

    def is_lost() -> bool:
        try:
            return motor.read() is not None
        except DeviceLostError as lost:
            return "reads no more; check its cable" in str(lost)

    monkeypatch.setattr(serial.Serial, "read", read)
    wait_for(is_lost)
    motor.brake()
    car.wait_for_line(event="command 7", mode="brake")


@pytest.fixture
def line():
    """A link, and the descriptor of its other end, which nobody reads."""
    far, near = os.openpty()
    with closing(SerialLink(os.ttyname(near))) as link:
        yield link, far
    os.close(near)
    os.close(far)


def test_a_pause_of_the_computer_is_no_fault_of_the_port(line, monkeypatch):
    link, far = line
    write = os.write

    def pause(descriptor: int, data: bytes) -> int:
        count = write(descriptor, data)
        time.sleep(2 * WRITE_S)
        return count

    monkeypatch.setattr(os, "write", pause)
    link.send(b"abc")
    assert b"abc" in os.read(far, 100)


def test_a_port_that_is_closed_is_read_no_more(line, monkeypatch):
    (link, _), reads = line, threading.Event()

    def read(*_):
        reads.set()
        time.sleep(0.1)
        return b""

    monkeypatch.setattr(serial.Serial, "read", read)
    assert reads.wait(10)
    link.close()
    assert f"VESC {link.port}" not in {thread.name for thread in threading.enumerate()}
    link.close()


def test_a_port_that_takes_nothing_is_lost(line):
    link, _ = line
    with pytest.raises(DeviceLostError, match="takes nothing for 0.1 s; check its"):
        for _ in range(10_000):
            link.send(bytes(250))


@pytest.fixture
def host(start):
    """A program of its own that drives a car, and the car."""
    car = start()
    command = [sys.executable, vesc_host.__file__, car.port]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        yield process, car
        process.kill()


def wait_until_driving(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert select.select([process.stdout], [], [], 60)[0], "it never drives"
    assert process.stdout.readline() == "driving\n"


def test_a_killed_program(host):
    process, car = host
    wait_until_driving(process)
    process.send_signal(signal.SIGKILL)
    check_stopped(car)


@pytest.mark.slow
def test_a_stopped_and_a_hung_program(host):
    process, car = host
    wait_until_driving(process)
    process.send_signal(signal.SIGSTOP)
    check_stopped(car)
    process.send_signal(signal.SIGCONT)
    wait_until_driving(process)
    process.stdin.write("hang\n")
    process.stdin.flush()
    check_stopped(car)
    process.stdin.write("go on\n")
    process.stdin.flush()
    wait_until_driving(process)


REFUSED = [
    ("--flaw locked", "timeout stays 1000 ms with 0 A .* VESC Tool"),
    ("--flaw scribbling", "more of its configuration"),
    ("--flaw deaf", "no answer to SET_APPCONF_NO_STORE"),
    ("--flaw endless", "300 ms after the last command it does not"),
    ("--flaw coasting", "the wheels turn on at"),
    ("--flaw stiff", "never shows a quarter of 20 A; raise"),
    ("--flaw dumb", "6.05 on 410 does not say whether its"),
    ("--firmware 5.03", "5.03 on 410 keeps its timeout of 1000 ms"),
    ("--firmware 3.57", r"3\.57 .* known of 3\.58 to 7\.x alone"),
    ("--firmware 8.00", r"8\.00 .* cannot be armed"),
    ("--config-bytes 14", "configuration of 14 bytes"),
]
SLOW = ("--flaw deaf", "--flaw coasting", "--flaw stiff")
ROWS = [
    pytest.param(row[0].split(), row[1], marks=[pytest.mark.slow] * (row[0] in SLOW))
    for row in REFUSED
]


@pytest.mark.parametrize(("opened", "message"), ROWS, indirect=["opened"])
def test_what_is_not_armed(opened, message):
    car, motor = opened
    with pytest.raises(InputError, match=message):
        motor.arm()
    with pytest.raises(InputError, match="not armed"):
        motor.send(Command(1.0, 0.0))
    car.wait_for_line(event="command 7")  # it brakes, as well as it can


def test_a_computer_that_is_too_busy_proves_no_timeout(opened, monkeypatch):
    _, motor = opened
    monkeypatch.setattr(timeout, "_LATE_S", -1.0)  # no answer is early enough
    monkeypatch.setattr(timeout, "_TRIES", 1)
    with pytest.raises(InputError, match="this computer was too busy, 1 times"):
        motor.arm()


class LetGoError(Exception):
    """What a check raises."""


@pytest.mark.parametrize("event", ["command 8", "timeout"])
def test_arming_ends_as_soon_as_its_check_says_so(opened, event):
    (car, motor), events = opened, []

    def check() -> None:
        if any(line["event"] == event for line in car.log()):
            events.append(event)
            raise LetGoError

    with pytest.raises(LetGoError):
        motor.arm(check)
    assert len(events) == 1  # asked no more, since nothing moves
    with pytest.raises(InputError, match="not armed"):
        motor.send(Command(1.0, 0.0))
    car.wait_for(event="", mode="brake", speed_ms=0.0, servo=0.53)


def test_a_kill_switch_proves_no_timeout(opened):
    car, motor = opened

    def check() -> None:
        if car.log()[-1]["mode"] == "rpm":
            car.tell("kill")

    with pytest.raises(InputError, match="kill switch is pressed; let it go"):
        motor.arm(check)


@pytest.mark.slow
def test_flash_is_written_once_and_after_a_question(start):
    car = start("--firmware", "5.03")
    asked = []

    def confirm(question: str) -> bool:
        asked.append(question)
        return True

    with closing(VescMotor(car.port, Calibration(timeout_ms=200), confirm)) as motor:
        motor.arm()
        motor.arm()
    (question,) = asked
    assert "1000 ms with 0 A. Write 200 ms with 20 A to its flash" in question
    assert [line["event"] for line in car.log()].count("flash") == 1


def test_ports_that_are_none(start, tmp_path):
    with pytest.raises(InputError, match="gone: .* ports: "):
        VescMotor(str(tmp_path / "gone"))
    car = start("--firmware", "3.39")
    with pytest.raises(InputError, match=r"firmware 3\.39"):
        VescMotor(car.port)
    with (
        closing(SerialLink(car.port)),
        pytest.raises(InputError, match="other programs"),
    ):
        VescMotor(car.port)
    car.tell("mute")

    def answers_not() -> bool:  # once it has heard that it is mute
        try:
            VescMotor(car.port)
        except DeviceLostError as error:
            return "no answer to FW_VERSION" in str(error)
        except InputError:
            return False
        raise AssertionError("opened")

    wait_for(answers_not)
