"""The receiver, over UDP on loopback."""

from __future__ import annotations

import sys
import time

import pytest
from support.devices.car import Sender, datagrams
from support.faults.injected import wait_for

from mi_nerfattack.car.devices import DeviceLostError
from mi_nerfattack.car.tracker import vicon
from mi_nerfattack.car.tracker.vicon import ViconTracker
from mi_nerfattack.errors import InputError


@pytest.fixture
def tracker():
    receiver = ViconTracker(port=0)
    yield receiver
    receiver.close()


@pytest.fixture
def sender(tracker):
    transmitter = Sender(tracker.address)
    yield transmitter
    transmitter.close()


def car(frame: int) -> bytes:
    return datagrams(frame, [("car", [1000.0 + frame, 0, 0], [0, 0, 0])])[0]


def test_a_pose_comes_with_the_time_of_its_arrival(tracker, sender):
    assert tracker.newest("car") is None
    assert tracker.address[0] == "127.0.0.1"
    assert "no datagram" in tracker.explain("car")
    before = time.monotonic()
    sender.send(b"nonsense")
    sender.send(car(7))
    wait_for(lambda: tracker.newest("car"))
    pose = tracker.newest("car")
    assert pose.index == 7
    assert pose.body_to_world[0, 3] == pytest.approx(1.007)
    assert before - 0.01 <= pose.time_s <= time.monotonic()
    assert tracker.rotation("car").tolist() == [0, 0, 0]
    assert "not 'van'" in tracker.explain("van")


class Clocks:
    """This computer's clocks, ahead by what a test says."""

    def __init__(self) -> None:
        self.ahead_s, self.wall_ahead_s = 0.0, 0.0

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s

    def time(self) -> float:
        return time.time() + self.ahead_s + self.wall_ahead_s


@pytest.fixture
def clocks(monkeypatch):
    stand_in = Clocks()
    monkeypatch.setattr(vicon, "time", stand_in)
    return stand_in


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel notes no arrival")
def test_what_waited_is_not_new(clocks):
    tracker = ViconTracker(port=0, clock=clocks.monotonic)
    sender = Sender(tracker.address)
    with tracker._lock:  # as if the process were busy
        sender.send(car(1))
        sender.send(car(2))
        sent_s = clocks.monotonic()
        clocks.ahead_s = 1000.0
    wait_for(lambda: (pose := tracker.newest("car")) and pose.index == 2)
    assert tracker.newest("car").time_s == pytest.approx(sent_s, abs=100)
    sender.close()
    tracker.close()


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel notes no arrival")
@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_what_waited_while_the_clock_was_set_is_left_out(
    clocks, tracker, sender, monkeypatch, step_s
):
    taken, take = [], tracker._stream.take

    def record(raw: bytes, time_s: float) -> bool:
        taken.append(raw)
        return take(raw, time_s)

    monkeypatch.setattr(tracker._stream, "take", record)
    with tracker._lock:  # as if the process were busy
        for frame in (1, 2, 3):
            sender.send(car(frame))
        clocks.wall_ahead_s = step_s
    wait_for(lambda: sender.send(car(4)) or car(4) in taken)
    assert car(2) not in taken
    assert car(3) not in taken


def test_another_computer_is_not_listened_to(tracker, sender):
    sender.send(car(1))
    wait_for(lambda: tracker.newest("car"))
    other = Sender(tracker.address, "127.0.0.2")
    other.send(car(50))
    sender.send(car(2))
    wait_for(lambda: tracker.newest("car").index > 1)
    assert tracker.newest("car").index == 2
    assert "127.0.0.2" in tracker.explain("car")
    other.close()


def test_a_chosen_computer_alone_is_listened_to():
    tracker = ViconTracker(port=0, sender="127.0.0.2")
    for source, frame in (("127.0.0.1", 9), ("127.0.0.2", 3)):
        sender = Sender(tracker.address, source)
        sender.send(car(frame))
        sender.close()
    wait_for(lambda: tracker.newest("car"))
    assert tracker.newest("car").index == 3
    tracker.close()


def test_a_closed_or_broken_receiver_is_lost(tracker):
    tracker._socket.close()
    wait_for(lambda: not tracker._thread.is_alive())
    with pytest.raises(DeviceLostError, match="receiving failed"):
        tracker.newest("car")
    closed = ViconTracker(port=0)
    closed.close()
    with pytest.raises(DeviceLostError, match="closed"):
        closed.newest("car")


def test_addresses_that_are_not_ours_are_refused(tracker):
    for host, port, message in (
        ("", 0, "VICON: "),
        ("192.0.2.1", 0, "VICON: "),
        ("no such host", 0, "VICON: "),
        ("127.0.0.1", tracker.address[1], "no other program"),
        ("127.0.0.1", 70000, "port 70000"),
    ):
        with pytest.raises(InputError, match=message):
            ViconTracker(host, port)
