"""The command line: arguments, exit codes and messages, no logic.

Exit codes: 0 done, 1 a command's own negative answer, 2 usage or input,
130 interrupted.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Mapping, Sequence

import tyro

import mi_nerfattack
from mi_nerfattack.backend.interrupts import raised_interrupts
from mi_nerfattack.commands import COMMANDS, Command
from mi_nerfattack.errors import NerfAttackError, is_interrupt

PROG = "mi-nerfattack"
EXIT_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_DESCRIPTION = (
    "Find, measure and repair failures of image-based driving policies.\n\n"
    "--debug, anywhere, shows the traceback of an error; --version prints the version."
)


def main(
    argv: Sequence[str] | None = None,
    commands: Mapping[str, type[Command]] = COMMANDS,
    prog: str = PROG,
) -> int:
    """Run one sub-command and return the exit code.

    Args:
        argv: the arguments without the program's name; None takes the process's.
        commands: what can be run, by name.
        prog: the program's name, for its help.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [item for item in arguments if item != "--debug"]
    try:
        with raised_interrupts(_end):
            code = _run(arguments, commands, prog)
            if sys.stdout is not None:  # closed before we started
                sys.stdout.flush()
            return code
    except NerfAttackError as err:
        return _fail(f"error: {err}", EXIT_INPUT, debug)
    except KeyboardInterrupt:
        return _fail("interrupted", EXIT_INTERRUPTED, debug)
    except MemoryError as err:
        advice = "give fewer or smaller images, cells or views"
        return _fail(f"error: not enough memory: {err}; {advice}", EXIT_INPUT, debug)
    except BrokenPipeError:
        _drop_output()
        return EXIT_BROKEN_PIPE
    except OSError as err:
        if err.filename is not None:  # no name of a file, as one that is too long
            return _fail(
                f"error: {err.filename}: {err.strerror}; check the path",
                EXIT_INPUT,
                debug,
            )
        if err.errno not in _NO_ROOM:  # `files` tells all others
            raise
        _drop_output()
        return _fail(
            f"error: standard output: {err.strerror}; write it to another disk",
            EXIT_INPUT,
            debug,
        )
    except Exception as err:
        # Dr.Jit, recording a loop, and modules, being imported, wrap what is raised
        if not is_interrupt(err):
            raise
        return _fail("interrupted", EXIT_INTERRUPTED, debug)


def _run(arguments: list[str], commands: Mapping[str, type[Command]], prog: str) -> int:
    if arguments == ["--version"]:
        print(f"{prog} {mi_nerfattack.__version__}")
        return 0
    try:
        command = tyro.extras.subcommand_cli_from_dict(
            dict(commands),
            prog=prog,
            description=_DESCRIPTION,
            args=arguments,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    except SystemExit as stop:  # help printed, or wrong usage reported
        return stop.code if isinstance(stop.code, int) else EXIT_INPUT
    try:
        return command.run()
    except SystemExit as stop:
        if not isinstance(stop.__context__, BrokenPipeError):
            raise
        raise stop.__context__ from None  # rich ends the process by itself


def _drop_output() -> None:
    """Let nowhere take what the interpreter flushes once more at its end."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    shown = "".join(
        c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in message
    )
    print(f"{PROG}: {shown}", file=sys.stderr)  # files and servers name things
    return code


def _end() -> None:
    """End the process at once, for a library that does not come back to Python."""
    os.write(2, f"{PROG}: interrupted, in the midst of a computation\n".encode())
    os._exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    sys.exit(main())
