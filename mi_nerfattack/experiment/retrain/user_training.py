"""Training by a command or a Python function of yours, on frames that are there."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

from mi_nerfattack.backend.interrupts import noticed_interrupts
from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.experiment.retrain.shown_process import ending, run_shown
from mi_nerfattack.io import files
from mi_nerfattack.io.locks import exclusive
from mi_nerfattack.io.resumable import json_digest
from mi_nerfattack.scenario.user_code import (
    helper_files,
    load_function,
    module_files,
)
from mi_nerfattack.training.dataset import SHARDS

#: What may stand between braces in a command, and what it becomes.
PLACEHOLDERS = {
    "data": "folder of the frames",
    "out": "file to write",
    "policy": "file of the attacked policy",
    "seed": "--seed",
    "threads": "number of --workers",
}
_NEEDED = ("data", "out")
_BRACES = re.compile(r"\{(\w*)\}")


@dataclass(frozen=True)
class TrainingOrder:
    """What a training is given.

    Attributes:
        data: folder of the frames.
        out: file to write.
        policy: file of the attacked policy; None of a server.
        seed: of its random numbers.
        threads: that it may use.
    """

    data: Path
    out: Path
    policy: Path | None
    seed: int
    threads: int


class AbstractUserTraining(ABC):
    """A training that is not ours; `option` is the one that names it."""

    option: ClassVar[str]

    @property
    @abstractmethod
    def text(self) -> str:
        """As the option says it."""

    @abstractmethod
    def check(self, order: TrainingOrder) -> None:
        """Raise `InputError` for what can be known to fail; costs no time."""

    @abstractmethod
    def code(self) -> dict[str, str]:
        """Return checksums of the files that it names, by name."""

    @abstractmethod
    def run(self, order: TrainingOrder, lock: int | None) -> None:
        """Train.

        Args:
            order: what it is given.
            lock: descriptor that keeps other processes out as long as it is open.

        Raises:
            InputError: it fails.
        """


@dataclass(frozen=True)
class CommandTraining(AbstractUserTraining):
    """A command of a shell, which runs without one.

    Args:
        command: words with `PLACEHOLDERS`, quoted as in a shell.
    """

    command: str
    option: ClassVar[str] = "--command"

    @property
    def text(self) -> str:
        """The command."""
        return self.command

    @property
    def _words(self) -> list[str]:
        try:
            return shlex.split(self.command)
        except ValueError as err:
            raise InputError(
                f"{self.option}: {self.command}: {err}; quote as in a shell"
            ) from err

    def check(self, order: TrainingOrder) -> None:
        """Check placeholders, and whether there is such a program."""
        words = self._words
        named = {name for word in words for name in _BRACES.findall(word)}
        unknown, missing = named - set(PLACEHOLDERS), set(_NEEDED) - named
        if unknown or missing:
            lists = {"unknown": unknown, "missing": missing}
            wrong = "; ".join(
                f"{kind} {' '.join(f'{{{name}}}' for name in sorted(names))}"
                for kind, names in lists.items()
                if names
            )
            known = ", ".join(f"{{{k}}} ({v})" for k, v in PLACEHOLDERS.items())
            raise InputError(
                f"{self.option}: {self.command}: {wrong}; allowed: {known}"
            )
        if "policy" in named and order.policy is None:
            raise InputError(
                f"{self.option}: {{policy}}: the attacked policy is a server, without "
                "a file; leave it out"
            )
        program = self._filled(order)[0]
        if shutil.which(program) is None:
            raise InputError(
                f"{self.option}: {program}: is no program here; check name and PATH"
            )

    def _filled(self, order: TrainingOrder) -> list[str]:
        return [
            _BRACES.sub(lambda match: str(getattr(order, match[1])), word)
            for word in self._words
        ]

    def code(self) -> dict[str, str]:
        """Return checksums of files among its words, and of what Python imports."""
        words = self._words
        modules = [name for option, name in pairwise(words) if option == "-m"]
        words += [value for word in words if (value := word.partition("=")[2])]
        named = {word: Path(word) for word in words if os.path.isfile(word)}
        for path in [path for path in named.values() if path.suffix == ".py"]:
            named |= helper_files(path)
        for name in modules:
            named |= module_files(name)
        return _checksums(named)

    def run(self, order: TrainingOrder, lock: int | None) -> None:
        """Run it, show its output on standard error, and pass an interrupt on."""
        words, threads = self._filled(order), str(order.threads)
        # without the latter, output that is no terminal's comes late
        own = {"OMP_NUM_THREADS": threads} | os.environ | {"PYTHONUNBUFFERED": "1"}
        status, last = run_shown(words, own, () if lock is None else (lock,))
        if status:
            raise InputError(
                f"{self.option}: {shlex.join(words)} {ending(status)}:\n{last}\n"
                "correct it, and give the same command again; the frames in "
                f"{order.data} are kept"
            )


@dataclass(frozen=True)
class ModuleTraining(AbstractUserTraining):
    """A Python function ``train(data: Path, out: Path, seed: int)``, called here.

    Args:
        name: ``FILE.py:NAME``.
        trusted: whether the user has said so.
    """

    name: str
    trusted: bool
    option: ClassVar[str] = "--module"

    @property
    def text(self) -> str:
        """The name."""
        return self.name

    @property
    def _file_and_function(self) -> tuple[Path, str]:
        file, _, function = self.name.rpartition(":")
        if not file.endswith(".py") or not function.isidentifier():
            raise InputError(
                f"{self.option}: {self.name}; must have the form FILE.py:NAME"
            )
        return Path(file), function

    def check(self, order: TrainingOrder) -> None:
        """Run the file, if that is allowed, and find the function."""
        file, function = self._file_and_function
        if not self.trusted:
            raise InputError(
                f"{self.option}: {self.name}: is code and runs with all rights of your "
                "account; if you trust who wrote it, add --trust-code"
            )
        load_function(file, function)

    def code(self) -> dict[str, str]:
        """Return checksums of the file, and of those in its folder that it imports."""
        file, _ = self._file_and_function
        return _checksums({file.name: file} | helper_files(file))

    def run(self, order: TrainingOrder, lock: int | None) -> None:
        """Call the function; what it makes of an interrupt does not count."""
        try:
            with noticed_interrupts():
                file, function = self._file_and_function
                load_function(file, function)(order.data, order.out, order.seed)
        except SystemExit as err:
            raise InputError(
                f"{self.option}: {self.name}: ends the program ({err.code}); let it "
                "return when it has written its file, or raise an exception"
            ) from err
        except Exception as err:  # a user's training raises whatever it likes
            if is_interrupt(err) or isinstance(err, InputError):
                raise
            raise InputError(
                f"{self.option}: {self.name}: raised {type(err).__name__}: {err}; "
                "correct it, and give the same command again (--debug shows where)"
            ) from err


def chosen_training(
    command: str | None, module: str | None, trusted: bool
) -> AbstractUserTraining | None:
    """Return the training that options name; None where they name none.

    Raises:
        InputError: they name two, or trust no code.
    """
    if trusted and module is None:
        raise InputError("--trust-code: has no effect without --module; leave it out")
    if command is not None and module is not None:
        raise InputError("--module: stands beside --command; give one of them")
    if command is not None:
        return CommandTraining(command)
    return None if module is None else ModuleTraining(module, trusted)


def _checksums(named: Mapping[str, Path]) -> dict[str, str]:
    """Return checksums by name; absolute paths tell about the machine alone."""
    checksums: dict[str, str] = {}
    for name, path in named.items():
        short = Path(name).name if os.path.isabs(name) else name
        key = short if short not in checksums else f"{short} {len(checksums)}"
        checksums[key] = files.sha256(path)
    return checksums


def train_once(
    training: AbstractUserTraining,
    order: TrainingOrder,
    shards: Sequence[Path],
    check: Callable[[], str],
) -> dict[str, Any]:
    """Train, unless the same training on the same frames was done.

    `DONE`, a file next to the written policy, records the training. Other files in the
    folder stay, so a training may keep checkpoints there.

    Args:
        training: what to do.
        order: what it is given; `out` is removed before.
        shards: the frames.
        check: reads what was written; returns a digest of its content.

    Returns:
        what decided about the training.

    Raises:
        InputError: another process works in the folder; it holds other frames, too;
            the training fails, or writes nothing that can be used.
    """
    asked = {path.resolve() for path in shards}
    if others := {path.resolve() for path in order.data.rglob(SHARDS)} - asked:
        raise InputError(
            f"{min(others)}: is of other --frames, and the training would read it; "
            "choose another --data, or remove the file"
        )
    folder = files.make_folder(order.out.parent)
    identity = {
        training.option.lstrip("-"): training.text,
        "seed": order.seed,
        "code": training.code(),
        "frames_sha256": json_digest([files.sha256(path) for path in shards]),
    }
    with exclusive(folder) as lock:
        if _is_done(folder, order.out.name, identity, check=check):
            return identity
        for path in (folder / DONE, order.out):
            with files.reported(path):
                path.unlink(missing_ok=True)
        training.run(order, lock)
        if not order.out.is_file():
            raise InputError(
                f"{training.option}: {training.text}: ended without an error, but "
                f"wrote no {order.out}; write the new policy there"
            )
        try:
            digest = check()
        except InputError as err:
            raise InputError(
                f"{training.option}: {training.text}: wrote what cannot be used: {err}"
            ) from err
        record = {"about": identity, "file": order.out.name, "policy": digest}
        files.write_json(folder / DONE, record)
    return identity


#: What was trained, beside the policy that came of it.
DONE = "done.json"


def _is_done(
    folder: Path, name: str, identity: Mapping[str, Any], check: Callable[[], str]
) -> bool:
    """Whether a training was done, and the file that came of it is still there.

    Raises:
        InputError: it is there, but `check` refuses it, which may be for another
            reason, such as a server that is down; nothing is removed.
    """
    try:
        record = files.read_json(folder / DONE)
    except InputError:  # nothing was done yet
        return False
    known = isinstance(record, dict) and (record.get("about"), record.get("file"))
    if known != (identity, name) or not (folder / name).is_file():
        return False
    try:
        return record["policy"] == check()
    except InputError as err:
        raise InputError(
            f"{folder / name}: was trained and cannot be used: {err}; correct the "
            f"cause, or remove {folder / DONE} to train again"
        ) from err
