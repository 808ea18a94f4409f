"""The exceptions that a user can cause; everything else is a mistake of ours."""

from __future__ import annotations


class NerfAttackError(Exception):
    """Report a problem that the user can do something about.

    The command line prints the message without a traceback and exits with code 2.
    A message reads ``<file or parameter>: <what is wrong, with the value>;
    <what is allowed or what to do>``.
    """


class InputError(NerfAttackError, ValueError):
    """Report a file, key, value, unit or shape that cannot be used."""


class SetupError(NerfAttackError, RuntimeError):
    """Report a machine or an installation that cannot do what is asked."""
