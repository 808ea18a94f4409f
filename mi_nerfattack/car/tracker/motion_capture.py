"""Motion capture systems by the `motioncapture` package, in a process of its own.

Its client waits for ever for a server that does not answer, in calls that nothing can
interrupt but the end of the process.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.car.devices import (
    AbstractTracker,
    Clock,
    DeviceLostError,
    TrackedPose,
)
from mi_nerfattack.car.tracker.newest import NewestPoses
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.system.processes import blocked_interrupts, safe_path

KINDS = ("vicon", "qualisys", "optitrack", "vrpn", "nokov", "fzmotion", "mock")
_START_S = 60.0  # for the process itself, on a busy computer
_UNIT = 1e-2  # how far a quaternion's length may be from 1
#: Position, metres, and quaternion x, y, z, w, by body.
_Bodies = dict[str, tuple[float, ...]]


class MotionCaptureTracker(AbstractTracker):
    """What the `motioncapture` package sees, through a process of its own.

    A pose's time is when the package returned its frame; its index counts the frames.

    Args:
        kind: one of `KINDS`, or another that the package has.
        hostname: of the system's server; the mock takes any.
        timeout_s: how long the server may take to answer, seconds.
        clock: of the times.

    Raises:
        SetupError: the package is not installed.
        InputError: it cannot connect, or not in time.
    """

    def __init__(
        self,
        kind: str,
        hostname: str,
        timeout_s: float = 10.0,
        clock: Clock = time.monotonic,
    ) -> None:
        _package()
        if not 0 < timeout_s < math.inf:
            raise InputError(f"timeout_s: {timeout_s}; positive and finite, seconds")
        self._where, self._clock = f"motioncapture: {kind} at {hostname}", clock
        self._poses, self._lock, self._frame = NewestPoses(), threading.Lock(), -1
        self._error = ""
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        arguments = (kind, {"hostname": hostname}, timeout_s, theirs)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        with safe_path(), blocked_interrupts():
            self._process.start()
        theirs.close()  # so that its end is noticed
        try:
            self._await(_START_S, f"its process did not start within {_START_S:g} s")
            self._await(
                timeout_s + 1,
                f"no answer within {timeout_s:g} s (its client would wait for ever); "
                "is its server on, and the firewall open?",
            )
        except BaseException:
            self._end()
            raise
        self._thread = threading.Thread(
            target=self._hear, name="motion-capture", daemon=True
        )
        self._thread.start()

    def newest(self, body: str) -> TrackedPose | None:
        """Return the newest pose of a body."""
        if self._error:
            raise DeviceLostError(f"{self._where}: {self._error}")
        with self._lock:
            return self._poses.newest(body)

    def explain(self, body: str) -> str:
        """Say why no new pose of a body comes."""
        if self._frame < 0:
            return f"{self._where}: connected, but no frame has come; is it live?"
        remedy = "tick or create it there, of that name"
        with self._lock:
            why = self._poses.explain(body, self._frame, remedy)
        return f"{self._where}: {why}"

    def close(self) -> None:
        """End the process."""
        self._error = self._error or "it is closed"
        self._process.kill()
        self._thread.join()
        self._end()

    def _end(self) -> None:
        self._process.kill()
        self._process.join()
        self._connection.close()

    def _await(self, timeout_s: float, late: str) -> None:
        """Wait for the next step of its start.

        Raises:
            InputError: it fails, or takes longer, for which `late` is the message.
        """
        if not self._connection.poll(timeout_s):
            raise InputError(f"{self._where}: {late}")
        try:
            kind, text = self._connection.recv()
        except (EOFError, OSError) as error:
            self._process.join()
            if self._process.exitcode == -_ALARM:
                raise InputError(f"{self._where}: {late}") from error
            raise InputError(f"{self._where}: {self._ended()}") from error
        if kind == "error":
            raise InputError(f"{self._where}: {text}")

    def _ended(self) -> str:
        self._process.join()
        return f"its process ended by itself (exit code {self._process.exitcode})"

    def _hear(self) -> None:
        try:
            while not self._error:
                self._take(*self._connection.recv())
        except (EOFError, OSError):
            self._error = self._error or self._ended()
        except Exception as error:  # a thread has nobody else to tell
            why = f"reading failed ({type(error).__name__}: {error})"
            self._error = self._error or why

    def _take(self, kind: str, content: Any) -> None:
        if kind == "error":
            self._error = self._error or content
            return
        taken_s, bodies = content
        # both processes share time.monotonic, though perhaps not our clock
        time_s = self._clock() - (time.monotonic() - taken_s)
        with self._lock:
            self._frame += 1
            for name, values in bodies.items():
                matrix = _matrix(values)
                if matrix is not None:
                    self._poses.update(name, matrix, time_s, self._frame)


def _package() -> Any:
    return load_extra("motioncapture", "a motion capture system")


def _matrix(values: tuple[float, ...]) -> np.ndarray | None:
    """Return the pose (4, 4) of a body; None where it is not seen."""
    pose = np.array(values, np.float64)
    length = float(np.linalg.norm(pose[3:]))
    if not (np.isfinite(pose).all() and abs(length - 1) < _UNIT):
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


_ALARM = 14  # SIGALRM, which Windows has not


def _serve(
    kind: str, options: Mapping[str, str], timeout_s: float, connection: Connection
) -> None:
    """Send what the package sees; runs in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one that started it decides
    try:
        package = _package()
        connection.send(("started", ""))
        if sys.platform != "win32":
            # ends this process though the client holds the interpreter meanwhile, and
            # even where nobody is left to kill it
            signal.setitimer(signal.ITIMER_REAL, timeout_s)
        system = package.connect(kind, dict(options))
        if sys.platform != "win32":
            signal.setitimer(signal.ITIMER_REAL, 0)
        connection.send(("connected", ""))
        threading.Thread(target=_end_with, args=(connection,), daemon=True).start()
        while True:
            system.waitForNextFrame()
            taken_s = time.monotonic()
            connection.send(("frame", (taken_s, _bodies(system))))
    except (BrokenPipeError, ConnectionResetError):
        pass  # nobody listens
    except Exception as error:
        with suppress(OSError):
            connection.send(("error", f"{type(error).__name__}: {error}"))


def _bodies(system: Any) -> _Bodies:
    bodies = {}
    for name, body in system.rigidBodies.items():
        turn = body.rotation
        numbers = (*body.position, turn.x, turn.y, turn.z, turn.w)
        bodies[str(name)] = tuple(map(float, numbers))
    return bodies


def _end_with(connection: Connection) -> None:
    """End this process, which may wait for a frame that never comes, with the other."""
    with suppress(EOFError, OSError):
        connection.recv()
    os._exit(0)
