"""A process of a user: its output shown as it comes, an interrupt passed on."""

from __future__ import annotations

import codecs
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress

from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.io import files

_LAST_LINES, _LAST_CHARACTERS = 12, 4000
#: Seconds that an interrupted process has to save what it wants to.
GRACE_S = 10.0


def run_shown(
    words: Sequence[str], environment: Mapping[str, str], inherited: Sequence[int]
) -> tuple[int, str]:
    """Run a process, and show its output on standard error.

    An interrupt is passed on to the process and its children, which are killed after
    `GRACE_S`.

    Args:
        words: program and arguments.
        environment: variables of the process.
        inherited: descriptors that stay open in it, also when this process is killed.

    Returns:
        its exit status, negative for a signal; and its last lines, indented.

    Raises:
        InputError: it cannot be started.
        KeyboardInterrupt: once the process has ended.
    """
    process = output = None
    try:
        with held_interrupts(), files.reported(words[0]):
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,  # Ctrl-C is for us; we pass it on
                pass_fds=inherited,
            )
            output = _Output(process)
        return process.wait(), output.last()
    except BaseException:
        if process is not None:
            _interrupt(process)
        raise
    finally:
        if output is not None:
            output.end()


class _Output:
    """Shows the output of a process as it comes, and keeps its end."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        self._stream, self._text = process.stdout, ""
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        decode = codecs.getincrementaldecoder("utf-8")("replace").decode
        with self._stream:
            while raw := os.read(self._stream.fileno(), 1 << 16):
                text = decode(raw)
                self._text = (self._text + text)[-_LAST_CHARACTERS:]
                if sys.stderr is not None:
                    sys.stderr.write(text)
                    sys.stderr.flush()

    def end(self) -> None:
        """Wait for the end, which a child that goes on in the background delays."""
        self._thread.join(1.0)

    def last(self) -> str:
        """Return the last lines, once there are no more."""
        self.end()
        lines = [line for line in self._text.splitlines() if line.strip()]
        return "\n".join(f"  {line}" for line in lines[-_LAST_LINES:]) or "  (nothing)"


def _interrupt(process: subprocess.Popen[bytes]) -> None:
    """Send Ctrl-C to a process and its children, and kill them if it is no use."""
    try:
        _send(process, signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_S)
    finally:
        _send(process, getattr(signal, "SIGKILL", signal.SIGTERM))
        process.wait()


def _send(process: subprocess.Popen[bytes], number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        if os.name == "posix":
            os.killpg(process.pid, number)  # its own group, also after its end
        else:
            process.terminate()


def ending(status: int) -> str:
    """Say how a process ended."""
    if status < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-status).name}"
    return f"ended with exit status {status}"
