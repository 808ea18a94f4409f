"""The exceptions that a user can cause; everything else is a mistake of ours."""

from __future__ import annotations

_LONGEST, _HEAD, _TAIL = 8000, 6000, 1500  # characters of a message


class NerfAttackError(Exception):
    """Report a problem that the user can do something about.

    The command line prints the message without a traceback and exits with code 2.
    A message reads ``<file or parameter>: <what is wrong, with the value>;
    <what is allowed or what to do>``. Where it quotes much of a file, its middle is
    left out.

    Attributes:
        where: the file or parameter.
        remedy: what is allowed, or what to do; empty where the message says neither.
    """

    def __init__(self, message: str) -> None:
        if len(message) > _LONGEST:
            left_out = f" ... ({len(message) - _HEAD - _TAIL} characters) ... "
            message = message[:_HEAD] + left_out + message[-_TAIL:]
        super().__init__(message)
        self.where: str = message.partition(": ")[0]
        _, separator, last = message.rpartition("; ")
        self.remedy: str = separator and last


class InputError(NerfAttackError, ValueError):
    """Report a file, key, value, unit or shape that cannot be used."""


class RefusedError(InputError):
    """Report work that was looked at and refused, and would be each time."""


class SetupError(NerfAttackError, RuntimeError):
    """Report a machine or an installation that cannot do what is asked."""


def is_interrupt(error: BaseException | None) -> bool:
    """Tell Ctrl-C and SIGTERM, also where Dr.Jit has wrapped them."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def is_of_disk(error: BaseException | None) -> bool:
    """Tell an error that no other scenario mends, such as a full disk."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__
    return error is not None
