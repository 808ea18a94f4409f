"""Interrupts: raised, held back while things are half done, and heeded in any case."""

from __future__ import annotations

import select
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Seconds in which code outside Python must come back to it after a signal.
GRACE_S = 5.0

Handler = Callable[[int, FrameType | None], object]


@contextmanager
def raised_interrupts(end: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt, in the main thread alone.

    Python runs a handler between two of its own instructions, and a library may never
    come back to it, as a TorchScript program that loops for ever. A thread waits
    `GRACE_S` for that, and ends the process.

    Args:
        end: what that thread calls.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = threading.Event()

    def interrupt(number: int, frame: FrameType | None) -> None:
        heard.set()
        raise KeyboardInterrupt

    receiver, sender = socket.socketpair()  # Python writes the number of each signal
    sender.setblocking(False)
    watch = threading.Thread(target=_watch, args=(receiver, heard, end), daemon=True)
    watch.start()
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    written = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(written)
        for number, handler in before.items():
            signal.signal(number, handler)
        sender.close()
        watch.join()
        receiver.close()


def _watch(
    arrived: socket.socket, heard: threading.Event, end: Callable[[], None]
) -> None:
    """Read the numbers of signals until nobody writes them any longer."""
    while numbers := arrived.recv(1 << 12):
        if set(SIGNALS).isdisjoint(numbers):
            continue
        if not heard.wait(GRACE_S):
            end()
        heard.clear()
        if select.select([arrived], [], [], 0)[0]:
            arrived.recv(1 << 12)  # of the same number, which Python tells once


@contextmanager
def _between(
    handle: Callable[[Handler, int, FrameType | None], None],
) -> Iterator[None]:
    """Let signals come to a function before their handlers in Python.

    In the main thread alone, where they arrive.

    Args:
        handle: called with the handler, the signal's number and the frame.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[int, Handler] = {}
    for number in SIGNALS:
        handler = signal.getsignal(number)
        if callable(handler):
            before[number] = handler
    for number, handler in before.items():
        signal.signal(number, partial(handle, handler))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def noticed_interrupts() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM arrive, and raise at the end what the code has caught.

    For code of others, which may save its state and return.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM came, even if the code has caught it.
    """
    came: list[int] = []

    def notice(handler: Handler, number: int, frame: FrameType | None) -> None:
        came.append(number)
        handler(number, frame)

    with _between(notice):
        yield
    if came:
        raise KeyboardInterrupt


@contextmanager
def held_interrupts(*, all_of_them: bool = False) -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C and SIGTERM back; what is yielded raises them.

    A second signal is held back only with `all_of_them`, for what soon ends and
    cannot be left half done. Only signals with a handler in Python that raises
    KeyboardInterrupt are held, and only in the main thread, where they arrive.

    Yields:
        a function without arguments, to be called where an interruption leaves
        nothing half done.

    Raises:
        KeyboardInterrupt: from the function yielded, or at the end, if one came.
    """
    came: list[int] = []

    def check() -> None:
        if came:
            came.clear()
            raise KeyboardInterrupt

    def hold(handler: Handler, number: int, frame: FrameType | None) -> None:
        try:
            handler(number, frame)
        except KeyboardInterrupt:
            if came and not all_of_them:
                raise
            came.append(number)

    with _between(hold):
        yield check
    check()
