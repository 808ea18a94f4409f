"""A car and its policy on one computer, over the loopback."""

from __future__ import annotations

import json
import threading
import time
from contextlib import ExitStack, closing, contextmanager

import numpy as np
import pytest
from helpers.loopback import free_port
from helpers.waiting import wait_for

from mi_nerfattack.errors import InputError
from mi_nerfattack.robot.devices import (
    Decision,
    DeviceLostError,
    Frame,
)
from mi_nerfattack.robot.remote import frames
from mi_nerfattack.robot.remote import server as remote_server
from mi_nerfattack.robot.remote.link import TO_POLICY, ZenohLink
from mi_nerfattack.robot.remote.pilot import RemotePilot
from mi_nerfattack.robot.remote.sealed import Endpoint, Kind, Message, Sealer, draw_id
from mi_nerfattack.robot.remote.server import PolicyServer

zenoh = pytest.importorskip("zenoh")

KEY = b"0123456789abcdef"
AHEAD_S = 1234.5
PATIENT_S = 30.0  # nothing is lost on a machine that is only slow


def other_clock() -> float:
    return time.monotonic() + AHEAD_S


class Bright:
    """Decides by the first pixel, when it may; 255 is too bright."""

    def __init__(self, gate: threading.Event | None = None) -> None:
        self.gate = gate
        self.seen: list[int] = []

    def __call__(self, image: np.ndarray) -> float:
        self.seen.append(int(image[0, 0, 0]))
        if self.gate is not None:
            assert self.gate.wait(PATIENT_S)
        if self.seen[-1] == 255:
            raise ValueError("too bright")
        return self.seen[-1] / 100


def free_endpoint() -> Endpoint:
    return Endpoint("127.0.0.1", free_port())


def frame(index: int, value: int, time_s: float = 0.0) -> Frame:
    return Frame(np.full((4, 6, 3), value, np.uint8), time_s, index)


@contextmanager
def serving(endpoint, key=KEY, gate=None):
    """Serve in a thread; gives the server, its notices and what decides."""
    made: list[Bright] = []
    notices: list[str] = []

    def make() -> Bright:
        made.append(Bright(gate))
        return made[-1]

    server = PolicyServer(endpoint, key, make, notices.append, other_clock, PATIENT_S)
    over = threading.Event()
    thread = threading.Thread(target=server.run, args=(over.is_set,))
    thread.start()
    try:
        yield server, notices, made
    finally:
        over.set()
        thread.join()
        server.close()


def await_decision(pilot: RemotePilot, index: int) -> Decision:
    """Wait for what is decided of a frame."""
    wait_for(lambda: (d := pilot.newest()) and d.frame_index == index)
    decision = pilot.newest()
    assert decision is not None
    return decision


def connected(endpoint, key=KEY, **more) -> RemotePilot:
    about = {"lost_s": PATIENT_S, "connect_s": PATIENT_S} | more
    return RemotePilot(endpoint, key, **about)


@contextmanager
def stranger(endpoint):
    """Give a session of zenoh's own that is connected to the server."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/{endpoint}"],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


def test_a_frame_that_cannot_be_sent_is_told(monkeypatch):
    endpoint = free_endpoint()

    def fail(*_: object) -> bytes:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr(frames, "pack_frame", fail)
    with serving(endpoint), closing(connected(endpoint)) as pilot:
        pilot.submit(frame(1, 7))
        wait_for(lambda: pilot._failure)
        with pytest.raises(DeviceLostError, match="sending failed .ZeroDivisionError"):
            pilot.newest()


def test_decisions_come_back(monkeypatch):
    """Of the frames that were sent, with their times, and clocks set right by one."""
    sent: list[bytes] = []
    send = ZenohLink.send
    monkeypatch.setattr(
        ZenohLink, "send", lambda link, raw: (sent.append(raw), send(link, raw))[1]
    )
    monkeypatch.setattr(remote_server, "_KEPT", 2)  # ages, not decisions
    endpoint = free_endpoint()
    with serving(endpoint) as (server, notices, made):
        with closing(connected(endpoint)) as pilot:
            assert pilot.newest() is None and pilot.delays is None
            for index, value in enumerate((20, 90, 50)):
                taken = time.monotonic()
                pilot.submit(frame(index, value, taken))
                decision = await_decision(pilot, index)
                assert pilot.delays is not None
                assert decision.control == pytest.approx(value / 100)
                assert decision.frame_time_s == taken <= decision.time_s
                delays, error = pilot.delays, pilot.delays.offset.error_s
                whole = delays.there_s + delays.deciding_s + delays.back_s
                assert whole == pytest.approx(decision.time_s - taken)
                assert min(delays.there_s, delays.back_s) >= -error - 1e-6
            assert abs(pilot.offset.ahead_s - AHEAD_S) <= pilot.offset.error_s + 1e-6
            assert made[0].seen == [20, 90, 50] and len(server.ages_s) == 2
            assert server.summary().startswith("3 decisions, on frames ")
            # what was recorded, and what is made up, moves nothing
            forged = Sealer(b"x" * 16).seal(
                Message(Kind.FRAME, draw_id(), draw_id(), 99, b"")
            )
            with stranger(endpoint) as session:
                for raw in [*sent, forged, b"", bytes(200)]:
                    session.put(TO_POLICY, raw)
                wait_for(lambda: server.refused >= 3)
                wait_for(lambda: any("without the right key" in n for n in notices))
            pilot.submit(frame(3, 70))
            await_decision(pilot, 3)
            assert made[0].seen == [20, 90, 50, 70] and len(made) == 1
            # one car at a time
            with pytest.raises(DeviceLostError, match="serves another car; end that"):
                connected(endpoint)
        with closing(connected(endpoint, jpeg_quality=90)) as pilot:  # the next car
            assert len(made) == 2
            pilot.submit(frame(0, 60))
            control = await_decision(pilot, 0).control
            assert control == pytest.approx(0.6, abs=0.03)
    assert "a car is there" in notices


def test_frames_that_wait_are_replaced(monkeypatch):
    monkeypatch.setattr("mi_nerfattack.robot.remote.pilot._AGAIN_S", PATIENT_S)
    endpoint, gate = free_endpoint(), threading.Event()
    with ExitStack() as stack:
        _, _, made = stack.enter_context(serving(endpoint, gate=gate))
        pilot = stack.enter_context(closing(connected(endpoint)))
        pilot.submit(frame(0, 10))
        wait_for(lambda: made[0].seen == [10])
        for index in range(1, 6):
            pilot.submit(frame(index, 10 * index))
        gate.set()
        assert await_decision(pilot, 5).control == pytest.approx(0.5)
        assert made[0].seen == [10, 50]


def test_another_key_is_not_heard():
    endpoint = free_endpoint()
    with serving(endpoint) as (server, _, made):
        for key in (b"", b"another key than there"):
            with pytest.raises(DeviceLostError, match="no answer within 0.3 s; .* key"):
                connected(endpoint, key, connect_s=0.3)
        assert server.refused and not made


def test_other_computers_need_a_key():
    for make in (RemotePilot, lambda *given: PolicyServer(*given, lambda: Bright())):
        with pytest.raises(InputError, match="without --key anybody there could steer"):
            make(Endpoint("0.0.0.0", free_port()), b"")


def test_a_policy_that_fails_is_told():
    endpoint = free_endpoint()
    with serving(endpoint) as (_, notices, made):
        with closing(connected(endpoint)) as pilot:

            def fails() -> bool:
                try:
                    pilot.submit(frame(1, 255))
                except DeviceLostError as error:
                    assert "policy failed (ValueError: too bright)" in str(error)
                    assert str(endpoint) in str(error)
                    return True
                return False

            wait_for(fails)
            with pytest.raises(DeviceLostError, match="too bright"):
                pilot.newest()
        with closing(connected(endpoint)) as pilot:  # a new one decides again
            pilot.submit(frame(1, 30))
            await_decision(pilot, 1)
        assert len(made) == 2 and any("too bright" in notice for notice in notices)


def test_a_link_that_is_lost():
    endpoint = free_endpoint()
    with pytest.raises(DeviceLostError, match="car serve' there, and look to"):
        connected(endpoint, connect_s=0.2)
    with serving(endpoint):
        with pytest.raises(InputError, match=f"--listen {endpoint}: .*in use"):
            ZenohLink(endpoint, True, lambda raw: None)
        pilot = connected(endpoint, lost_s=0.5)
    with closing(pilot):

        def is_lost() -> bool:
            try:
                pilot.newest()
            except DeviceLostError as error:
                assert "silent for" in str(error)
                return True
            return False

        wait_for(is_lost)
        with pytest.raises(DeviceLostError, match="silent for"):
            pilot.submit(frame(0, 0))
    pilot.close()
