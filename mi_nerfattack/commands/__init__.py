"""The sub-commands of ``mi-nerfattack``, one file each.

A command is a frozen dataclass: its fields are the arguments, their docstrings the
help, and ``run()`` does the work and returns the exit code. These modules are all
imported for ``--help``; import anything slow (torch, our own parts) inside run().
"""

from __future__ import annotations

from typing import Protocol

from mi_nerfattack.commands.doctor import Doctor


class Command(Protocol):
    """What the command line calls after it has parsed the arguments."""

    def run(self) -> int:
        """Do the work and return the exit code."""
        ...


COMMANDS: dict[str, type[Command]] = {"doctor": Doctor}

__all__ = ["COMMANDS", "Command"]
