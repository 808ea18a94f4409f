"""The receiver, over UDP on loopback."""

from __future__ import annotations

import sys
import time

import pytest
from helpers.vicon_sender import Sender, datagrams
from helpers.waiting import wait_for

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import DeviceLostError
from mi_nerfattack.robot.tracker.vicon import ViconTracker


@pytest.fixture
def tracker():
    found = ViconTracker(port=0)
    yield found
    found.close()


@pytest.fixture
def sender(tracker):
    found = Sender(tracker.address)
    yield found
    found.close()


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


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel notes no arrival")
def test_what_waited_is_not_new(tracker, sender):
    with tracker._lock:  # as if the process were busy
        sender.send(car(1))
        before = time.monotonic()
        sender.send(car(2))
        after = time.monotonic()
        time.sleep(0.2)
    wait_for(lambda: (pose := tracker.newest("car")) and pose.index == 2)
    # the wall clock and this one are not read at one moment
    assert before - 0.02 < tracker.newest("car").time_s < after + 0.02


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


def test_a_closed_receiver_is_lost(tracker):
    tracker.close()
    with pytest.raises(DeviceLostError, match="closed"):
        tracker.newest("car")


def test_a_broken_socket_is_lost(tracker):
    tracker._socket.close()
    wait_for(lambda: not tracker._thread.is_alive())
    with pytest.raises(DeviceLostError, match="receiving failed"):
        tracker.newest("car")


@pytest.mark.parametrize("host", ["", "192.0.2.1", "no such host"])
def test_addresses_that_are_not_ours_are_refused(host):
    with pytest.raises(InputError, match="VICON: "):
        ViconTracker(host, 0)


def test_a_port_that_is_taken_is_refused(tracker):
    with pytest.raises(InputError, match="no other program"):
        ViconTracker(port=tracker.address[1])
    with pytest.raises(InputError, match="port 70000"):
        ViconTracker(port=70000)
