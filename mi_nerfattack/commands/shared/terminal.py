"""Talking with whoever sits at the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console


def console(stderr: bool = False) -> Console:
    """Return the terminal, for text and tables in which brackets mean themselves."""
    from rich.console import Console  # slow to import

    return Console(stderr=stderr, markup=False)


def say(text: str) -> None:
    """Show a line at once, through a pipe, too."""
    print(text, flush=True)


def ask(question: str) -> str:
    """Return the answer to a question, without spaces around it.

    Raises:
        InputError: nobody can answer.
    """
    try:
        return input(f"{question}: ").strip()
    except EOFError as err:
        raise InputError(f"{question}: nobody answers; run it in a terminal") from err


def confirm(question: str) -> bool:
    """Ask whether something may be done; no, unless it is said."""
    return ask(f"{question} [y/N]").lower() in ("y", "yes")
