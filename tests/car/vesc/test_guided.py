"""A car's calibration by drives that somebody measures."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
from contextlib import closing, nullcontext
from threading import Timer

import pytest
from support.devices.car import Pad
from support.devices.controller import StandIn
from support.devices.vesc import ERPM_PER_MS
from support.faults.injected import wait_for

from mi_nerfattack import cli
from mi_nerfattack.car.devices import AbstractEnable, Command
from mi_nerfattack.car.drive.safety import enable
from mi_nerfattack.car.vesc import guided
from mi_nerfattack.car.vesc.calibration import (
    Calibration,
    read_calibration,
    write_calibration,
)
from mi_nerfattack.car.vesc.guided import (
    DRIVES,
    Arc,
    drive_arc,
    fit_arcs,
    read_arcs,
    write_arcs,
)
from mi_nerfattack.car.vesc.motor import VescMotor
from mi_nerfattack.commands.calibrate import _ask_for_arc
from mi_nerfattack.errors import InputError

WHEELBASE_M, CENTRE, PER_RAD = 0.3, 0.47, 1.1


def end_of_arc(way_m: float, servo: float) -> tuple[float, float]:
    """Return where a car of this file comes to, ahead and to the left."""
    curvature = math.tan((servo - CENTRE) / PER_RAD) / WHEELBASE_M
    if abs(curvature) < 1e-9:
        return way_m, 0.0
    turned = way_m * curvature
    return math.sin(turned) / curvature, (1 - math.cos(turned)) / curvature


def made_arcs(*servos: float) -> list[Arc]:
    ways = [1.5 + 0.1 * i for i in range(len(servos))]
    return [
        Arc(servo, round(way * 480), *end_of_arc(way, servo))
        for way, servo in zip(ways, servos, strict=True)
    ]


def test_arcs_tell_the_scales():
    arcs = made_arcs(CENTRE, 0.7, 0.25)
    before = Calibration(timeout_ms=200)
    fitted, away_rad, spread = fit_arcs(arcs, WHEELBASE_M, before)
    scales = {"erpm_per_ms": 4800.0, "servo_per_rad": PER_RAD, "servo_centre": CENTRE}
    assert fitted == before.changed(scales | {"wheelbase_m": WHEELBASE_M})
    assert away_rad < 1e-9 and spread < 1e-9
    crooked = Arc(arcs[2].servo, arcs[2].steps, *end_of_arc(1.7, 0.31))
    _, away_rad, _ = fit_arcs([*arcs[:2], crooked], WHEELBASE_M, before)
    assert away_rad > 0.01


@pytest.mark.parametrize(
    ("arcs", "message"),
    [
        (made_arcs(0.5, 0.5), "Enable Servo Output"),
        ([Arc(0.5, 30, 0.05, 0.0), *made_arcs(0.3, 0.7)], "0.05 m forward .* farther"),
        ([Arc(0.5, 0, 1.5, 0.0), *made_arcs(0.3, 0.7)], "in 0 steps"),
        ([Arc(0.1, 700, 1.0, 0.4), Arc(0.9, 700, 1, 0.4001)], "tell no scale"),
        ([Arc(0.9, 700, 1.0, 0.4), Arc(0.901, 700, 1.0, -0.4)], "the servo hardly"),
    ],
)
def test_measurements_that_are_not_plausible(arcs, message):
    with pytest.raises(InputError, match=message):
        fit_arcs(arcs, WHEELBASE_M, Calibration())


def test_an_arc_is_asked_for_until_it_is_right(monkeypatch, capsys):
    answers = iter(["0.01", "0", "1.5", "0,1", "n", "1.4", "-0.1", ""])
    monkeypatch.setattr("builtins.input", lambda prompt: next(answers))
    assert _ask_for_arc(0.5, 700) == Arc(0.5, 700, 1.4, -0.1)
    assert "0.01 m forward and 0 m left" in capsys.readouterr().out


def test_what_was_measured_is_kept_until_it_is_fitted(tmp_path, capsys):
    output, arcs_path = tmp_path / "car.toml", tmp_path / "car.toml.arcs.json"
    arcs = dict(zip(DRIVES, made_arcs(CENTRE, 0.7, 0.25), strict=True))
    command = [*"car calibrate /dev/none --enable /dev/none -o".split(), str(output)]
    command += ["--wheelbase-m", str(WHEELBASE_M)]
    assert read_arcs(arcs_path) == {}
    write_arcs(arcs_path, {"straight": arcs["straight"]})
    assert cli.main(command) == 2  # the others are to be driven
    printed = capsys.readouterr()
    assert f"{arcs_path} has straight; remove it" in printed.out
    assert "/dev/none: does not exist" in printed.err
    write_arcs(arcs_path, dict.fromkeys(DRIVES, arcs["straight"]))
    assert cli.main(command) == 2
    assert f"; {arcs_path} has what was measured: take out" in capsys.readouterr().err
    assert read_arcs(arcs_path) == dict.fromkeys(DRIVES, arcs["straight"])
    write_arcs(arcs_path, arcs)
    assert cli.main(command) == 0
    assert read_calibration(output).servo_per_rad == PER_RAD and not arcs_path.exists()
    arcs_path.write_text('{"sideways": {}}')
    with pytest.raises(InputError, match="sideways.*'straight', 'to the left'"):
        read_arcs(arcs_path)
    write_arcs(arcs_path, {"straight": Arc(0.5, 0, 1.5, 0.0)})
    with pytest.raises(InputError, match="arcs.json: straight: .* in 0 steps"):
        read_arcs(arcs_path)


@pytest.fixture
def armed(tmp_path, request):
    """A car, perhaps with a flaw, and its armed motor."""
    flaw = ["--flaw", request.param] if hasattr(request, "param") else []
    with (
        StandIn(tmp_path / "log", *flaw) as car,
        closing(VescMotor(car.port)) as motor,
    ):
        motor.arm()
        yield car, motor


def test_what_a_check_raises_brakes_a_drive(armed):
    car, motor = armed
    start_m = car.wait_for(speed_ms=0.0)[-1]["way_m"]

    def check() -> None:
        if car.log()[-1]["way_m"] > start_m + 0.1:
            raise enable.ReleasedError("let go")

    with pytest.raises(enable.ReleasedError):
        drive_arc(motor, Command(0.5, 0.0), 1.5, check)
    lines = car.wait_for(speed_ms=0.0)
    assert lines[0]["event"] == "command 7"
    assert lines[-1]["way_m"] < start_m + 1.4
    car.tell("kill")
    with pytest.raises(InputError, match="kill switch is pressed; mend it"):
        drive_arc(motor, Command(0.5, 0.0), 1.5, lambda: None)


def test_an_arc_gives_what_the_servo_and_the_motor_did(armed):
    car, motor = armed
    start_m = car.wait_for(speed_ms=0.0)[-1]["way_m"]
    servo, steps = drive_arc(motor, Command(0.5, 0.1), 0.2, lambda: None)
    assert servo == pytest.approx(0.409)  # 0.5304 - 1.2135 * 0.1, in thousandths
    assert any(line["servo"] == servo for line in car.log())
    way_m = car.wait_for(speed_ms=0.0)[-1]["way_m"] - start_m
    assert 0.2 <= way_m == pytest.approx(steps / (ERPM_PER_MS / 10), abs=0.005)


def test_no_arc_is_driven_while_another_program_feeds_the_controller(armed):
    car, motor = armed
    before = len(car.log())
    car.tell("feed")
    with pytest.raises(InputError, match="another program feeds it"):
        drive_arc(motor, Command(0.5, 0.0), 1.5, lambda: None)
    assert not any(line["event"] == "command 8" for line in car.log()[before:])


@pytest.mark.parametrize(
    ("armed", "message"),
    [
        ("uncounted", r"its tachometer says 0\.\d+ m, its ERPM"),
        ("unmeasured", "its motor does not turn, or is not measured: 0 ERPM"),
    ],
    indirect=["armed"],
)
def test_a_motor_that_is_not_measured_does_not_drive_on(armed, message):
    car, motor = armed
    start_m = car.wait_for(speed_ms=0.0)[-1]["way_m"]
    with pytest.raises(InputError, match=message):
        drive_arc(motor, Command(0.5, 0.0), 1.5, lambda: None)
    assert 0.1 < car.wait_for(speed_ms=0.0)[-1]["way_m"] - start_m < 0.8


@pytest.fixture
def watched(monkeypatch):
    """What looks at an arc of 1.5 m at 0.5 m/s, and its time."""
    now = [0.0]
    monkeypatch.setattr(guided, "suspended_clock", lambda: now[0])
    return guided._Watch(Calibration(), 0.5, 1.5), now


@pytest.mark.parametrize(
    ("steps", "erpm", "passed_s", "message"),
    [
        (690, 2307, 3.0, None),  # as commanded
        (400, 1200, 4.4, None),  # slowly
        (400, 1000, 4.6, "of 1.5 m after the time for 2.25 m; drive faster"),
        (230, 2307, 2.0, "its tachometer says 0.40 m, its ERPM 0.80 m"),
        (0, 0, 0.45, None),
        (0, 90, 0.6, "does not turn, or is not measured: 90 ERPM for 0.5 s"),
    ],
)
def test_what_ends_an_arc(watched, steps, erpm, passed_s, message):
    watch, now = watched
    refused = pytest.raises(InputError, match=message)
    with nullcontext() if message is None else refused:
        while now[0] < passed_s:
            now[0] = min(now[0] + 0.05, passed_s)
            watch.check(round(steps * now[0] / passed_s), erpm)
    assert guided.room_m(1.5, 0.5) == 2.75  # and half a metre a second for a second


def test_an_arc_does_not_go_on_after_the_computer_was_suspended(watched):
    watch, now = watched
    now[0] = 0.05
    watch.check(10, 2307)
    now[0] += 60.0
    with pytest.raises(InputError, match="stood still for 60.00 s, in which"):
        watch.check(10, 2307)


class Person(AbstractEnable):
    """Answers the questions as somebody with a tape would, and holds the button.

    Of the first drive it is let go.
    """

    def __init__(self, car: StandIn) -> None:
        self.car, self.start_m, self.asked = car, 0.0, []
        self.was_asked, self.lets_go = True, True

    def is_held(self) -> bool:
        if self.was_asked:
            self.was_asked = False
            return False
        is_driving = self.car.log()[-1]["way_m"] > self.start_m + 0.1
        if self.lets_go and is_driving and "Drive" in self.asked[-1]:
            self.lets_go = False
            return False
        return True

    def close(self) -> None:
        """Nothing is held."""

    def __call__(self, prompt: str) -> str:
        self.asked.append(prompt)
        self.was_asked = True
        now = self.car.wait_for(speed_ms=0.0)[-1]  # one marks where a car stands
        if prompt.startswith("How"):
            driven = [line for line in self.car.log() if line["event"] == "command 8"]
            place = end_of_arc(now["way_m"] - self.start_m, driven[-1]["servo"])
            return f"{place['left' in prompt]:.4f}"
        self.start_m = now["way_m"]
        return ""


@pytest.mark.slow
def test_a_calibration_from_beginning_to_end(tmp_path, monkeypatch, capsys):
    """From scales that are wrong by a tenth and more to those of the car."""
    begin, output = tmp_path / "begin.toml", tmp_path / "car.toml"
    write_calibration(begin, Calibration(erpm_per_ms=4000.0, servo_per_rad=1.4))
    with StandIn(tmp_path / "log") as car:
        person = Person(car)
        monkeypatch.setattr("builtins.input", person)
        monkeypatch.setattr(enable, "JoystickEnable", lambda *_, silence_s: person)
        arguments = ["car", "calibrate", car.port, "-o", str(output), "--speed-ms", "1"]
        arguments += ["--calibration", str(begin), "--wheelbase-m", str(WHEELBASE_M)]
        assert cli.main([*arguments, "--json"]) == 0
    calibration = read_calibration(output)
    assert calibration.erpm_per_ms == pytest.approx(ERPM_PER_MS, rel=0.003)
    assert calibration.servo_per_rad == pytest.approx(PER_RAD, rel=0.005)
    assert calibration.servo_centre == pytest.approx(CENTRE, abs=0.002)
    assert calibration.wheelbase_m == WHEELBASE_M
    assert len(person.asked) == 1 + 1 + 3 * 4
    printed, shown = capsys.readouterr()
    assert "Armed: without commands it brakes after 250 ms with 20 A." in shown
    assert "Braked: the enable button was let go" in shown
    assert not (tmp_path / "car.toml.arcs.json").exists()
    document = json.loads(printed)
    assert document["calibration"] == calibration.model_dump(mode="json")
    assert document["before"]["erpm_per_ms"] == 4000 and document["length_spread"] >= 0


@pytest.mark.slow
def test_ctrl_c_brakes(tmp_path):
    output, pipe = tmp_path / "car.toml", subprocess.PIPE
    with (
        StandIn(tmp_path / "log") as car,
        closing(Pad(tmp_path / "js0")) as pad,
    ):
        command = [sys.executable, *"-m mi_nerfattack.cli car calibrate -o".split()]
        command += [str(output), car.port, "--enable", str(tmp_path / "js0")]
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
            assert process.stdin is not None and process.stdout is not None
            ending = Timer(120.0, process.kill)
            ending.start()
            for awaited in "Release", "Armed", "Release":
                if awaited == "Release":
                    pad.press(False)
                    process.stdin.write("\n")
                    process.stdin.flush()
                while awaited not in process.stdout.readline():
                    assert process.poll() is None
                pad.press(True)
            # past the proof, which brakes, and on its way
            wait_for(lambda: car.wait_for(mode="rpm")[-1]["way_m"] > 0.6)
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 130
            ending.cancel()
        assert car.wait_for(speed_ms=0.0)[0]["event"] == "command 7"
    assert not output.exists()


def test_nothing_moves_before_somebody_answers(tmp_path, monkeypatch, capsys):
    output = tmp_path / "car.toml"

    def answer(prompt: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", answer)
    pad = str(tmp_path / "js0")
    with StandIn(tmp_path / "log") as car, closing(Pad(tmp_path / "js0")):
        command = ["car", "calibrate", car.port, "-o", str(output), "--enable"]
        assert cli.main([*command, f"{pad}7"]) == 2
        assert "js07: does not exist" in capsys.readouterr().err
        assert cli.main([*command, pad]) == 2
        assert "run it in a terminal" in capsys.readouterr().err
        assert "command 8" not in {line["event"] for line in car.log()}
