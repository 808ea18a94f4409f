"""The command line: arguments, exit codes and messages, no logic.

Exit codes: 0 done, 1 a command's own negative answer, 2 usage or input,
130 interrupted, 141 nobody reads the output. docs/reference/commands.md lists them for
users.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import errno
import inspect
import operator
import os
import shlex
import sys
import textwrap
import traceback
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Annotated, Any, get_type_hints

import docstring_parser
import tyro

import mi_nerfattack
from mi_nerfattack.backend.interrupts import raised_interrupts
from mi_nerfattack.commands import (
    PACKAGES,
    THEMES,
    Command,
    Commands,
    Group,
    each,
    flat,
)
from mi_nerfattack.commands.shared.terminal import stdout_to_stderr
from mi_nerfattack.errors import InputError, NerfAttackError, is_interrupt
from mi_nerfattack.extras import require

PROG, PACKAGE = "mi-nerfattack", "mi_nerfattack"
EXIT_INPUT = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_DESCRIPTION = "Find, measure and repair failures of image-based driving policies."
_HINT = (
    "--debug, anywhere, shows the traceback of an error; --version prints the version."
)
_STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)


def main(
    argv: Sequence[str] | None = None,
    themes: Mapping[str, Commands] = THEMES,
    prog: str = PROG,
) -> int:
    """Run one sub-command and return the exit code.

    Args:
        argv: the arguments without the program's name; None takes the process's.
        themes: what can be run, by name, by theme.
        prog: the program's name, for its help.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [item for item in arguments if item != "--debug"]
    try:
        with raised_interrupts(_end):
            code = _run(arguments, themes, prog)
            if sys.stdout is not None:  # closed before we started
                sys.stdout.flush()
            return code
    except NerfAttackError as err:
        return _fail(f"error: {err}", EXIT_INPUT, debug)
    except KeyboardInterrupt as err:
        message = f"interrupted{err if isinstance(err, _Interrupted) else ''}"
        return _fail(message, EXIT_INTERRUPTED, debug)
    except MemoryError as err:
        advice = "give fewer or smaller images, cells or views"
        return _fail(f"error: not enough memory: {err}; {advice}", EXIT_INPUT, debug)
    except BrokenPipeError:
        _drop_output()
        return EXIT_BROKEN_PIPE
    except ModuleNotFoundError as err:
        if (err.name or PACKAGE).startswith(PACKAGE):
            raise
        advice = f"pip install {PROG}, without --no-deps, installs what it lacks"
        return _fail(
            f"error: {err.name}: is not installed; {advice}", EXIT_INPUT, debug
        )
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


class _Interrupted(KeyboardInterrupt):
    """What ended a command that goes on when it is given again, and how to."""


def _run(arguments: list[str], themes: Mapping[str, Commands], prog: str) -> int:
    if arguments == ["--version"]:
        print(f"{prog} {mi_nerfattack.__version__}")
        return 0
    commands = flat(themes)
    _check_name(arguments, commands)
    description, level, level_arguments = _DESCRIPTION, prog, arguments
    if arguments and isinstance(group := commands.get(arguments[0]), Group):
        description, level = group.description, f"{prog} {arguments[0]}"
        themes, level_arguments = {"": group.commands}, arguments[1:]
    if level_arguments in ([], ["-h"], ["--help"]):
        print(
            _overview(themes, description, level),
            file=sys.stdout if level_arguments else sys.stderr,
        )
        return 0 if level_arguments else EXIT_INPUT
    try:
        with _FIELDS:
            kinds = _one_of(commands)
            command = tyro.cli(kinds, prog=prog, args=arguments, config=_STYLE)
    except SystemExit as stop:  # help printed, or wrong usage reported
        code = stop.code or 0
        return code if isinstance(code, int) else EXIT_INPUT
    try:
        _check_packages(command, commands)
        return _tell(command)
    except SystemExit as stop:
        if not isinstance(stop.__context__, BrokenPipeError):
            raise
        raise stop.__context__ from None  # rich ends the process by itself
    except BaseException as err:
        if not (is_interrupt(err) and getattr(command, "continues", False)):
            raise
        anew = getattr(command, "anew", ())
        words = shlex.join([word for word in arguments if word not in anew])
        again = f"{prog} {words}"
        raise _Interrupted(f"; to go on, give it again:\n{again}") from err


#: What all options of a name have in common, and their help where a command has none.
_ALIKE: Mapping[str, Any] = {
    "output": {"aliases": ["-o"]},
    "run_folder": {"metavar": "RUN"},
}
_TEXTS = {
    "json": "End with one line of JSON instead of sentences.",
    "run_folder": "Folder of a finished run of attack.",
}
_FIELDS = tyro.constructors.ConstructorRegistry()


@_FIELDS.struct_rule
def _fields(
    info: tyro.constructors.StructTypeInfo,
) -> tyro.constructors.StructConstructorSpec | None:
    """Show each option of a command as a paragraph, and no default of None or False."""
    kind, defaults = info.type, info.default
    if not getattr(kind, "__module__", "").startswith("mi_nerfattack.commands."):
        return None
    types, texts = get_type_hints(kind, include_extras=True), {}
    for level in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        for item in docstring_parser.parse_from_object(level).params:
            texts[item.arg_name] = " ".join((item.description or "").split())
    options = []
    for item in dataclasses.fields(kind):
        default = item.default
        if item.default_factory is not dataclasses.MISSING:
            default = item.default_factory()
        elif default is dataclasses.MISSING:
            default = tyro.MISSING
        default = getattr(defaults, item.name, default)
        alike = _ALIKE.get(item.name, {})
        shown = tyro.conf.arg(help_behavior_hint=_default, **alike)
        typed: Any = Annotated[types[item.name], shown]
        text = texts.get(item.name) or _TEXTS.get(item.name)
        options.append(
            tyro.constructors.StructFieldSpec(item.name, typed, default, text)
        )
    return tyro.constructors.StructConstructorSpec(kind, tuple(options))


def _default(value: str) -> str:
    return "" if value in ("", "None", "False") else f"(default: {value})"


def _one_of(commands: Commands) -> Any:
    """Return a type of which tyro makes one command, as the arguments say."""
    members = [
        Annotated[
            Any,
            tyro.conf.subcommand(
                name,
                constructor=_one_of(item.commands) if isinstance(item, Group) else item,
                description=item.description if isinstance(item, Group) else None,
            ),
        ]
        for name, item in commands.items()
    ]
    return reduce(operator.or_, members)


def _overview(themes: Mapping[str, Commands], description: str, prog: str) -> str:
    """Return the first help, also of a group: a sentence a command, by theme."""
    lines = [f"usage: {prog} COMMAND ...", "", description]
    for theme, commands in themes.items():
        lines += ["", *([theme] if len(commands) > 1 and theme else [])]
        for name, item in commands.items():
            text = (
                item.description
                if isinstance(item, Group)
                else inspect.getdoc(item) or ""
            )
            first = text.split("\n\n")[0].replace("\n", " ")
            lines += textwrap.wrap(
                first, 80, initial_indent=f"  {name:10}", subsequent_indent=" " * 12
            )
    lines += ["", f"{prog} COMMAND --help shows the options of a command.", _HINT]
    return "\n".join(lines)


def _tell(command: Command) -> int:
    """Run a command, print the figures that it returns, and return the exit code."""
    as_json = getattr(command, "json", False)
    with stdout_to_stderr() if as_json else contextlib.nullcontext():
        result = command.run()
    return result if isinstance(result, int) else result.tell(as_json)


def _check_packages(command: Command, commands: Commands) -> None:
    """Raise SetupError where an optional package that a command needs is missing."""
    words = next(words for words, kind in each(commands) if kind is type(command))
    require(" ".join(words), *PACKAGES.get(type(command), ()))


def _check_name(arguments: Sequence[str], commands: Commands, group: str = "") -> None:
    """Raise InputError of a word that is no command, with those that resemble it."""
    if not arguments or arguments[0].startswith("-"):
        return
    name, *group_arguments = arguments
    if name in commands:
        if isinstance(item := commands[name], Group):
            _check_name(group_arguments, item.commands, f"{name} ")
        return
    near = difflib.get_close_matches(name, commands)
    near = [f"{group}{one}" for one in near]
    near = near or [" ".join(one) for one, _ in each(commands) if one[-1] == name]
    one_of = f"one of {', '.join(commands)}"
    meant = f"did you mean {' or '.join(map(repr, near))}?" if near else one_of
    raise InputError(f"{group + name!r}: is no command; {meant}")


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
