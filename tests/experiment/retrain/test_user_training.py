"""Trainings of a user: what they get, how they end, and when they are done again."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from support.faults.refusals import refusals

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.retrain import shown_process
from mi_nerfattack.experiment.retrain.user_training import (
    CommandTraining,
    ModuleTraining,
    TrainingOrder,
    chosen_training,
    train_once,
)
from mi_nerfattack.io import locks

WRITES = """
import os, sys
from pathlib import Path
data, out, policy, seed, threads = sys.argv[1:]
log = Path(data, "log")
log.write_text((log.read_text() if log.exists() else "") + "run ")
print("half a line", end="\\r")
print(policy, seed, threads, os.environ["OMP_NUM_THREADS"])
Path(out).write_text(seed)
"""
ALL = "{data} {out} {policy} {seed} {threads}"
SAVES = """
import os, sys, time
from pathlib import Path
out = Path(sys.argv[2])
try:
    out.with_name("pid").write_text(str(os.getpid()))
    out.with_name("ready").touch()
    time.sleep(60)
except KeyboardInterrupt:
    out.with_name("checkpoint").touch()
"""
DEAF = SAVES.replace("try:", "import signal; signal.signal(2, signal.SIG_IGN)\ntry:")


def order_in(folder: Path, **changes: object) -> TrainingOrder:
    """Return an order for a training, in folders that are there."""
    data, out = folder / "round_0", folder / "trained" / "policy.txt"
    for path in (data, out.parent):
        path.mkdir(exist_ok=True)
    (data / "shard").write_text("frames")
    order = TrainingOrder(data, out, folder / "old.txt", 3, 2)
    return dataclasses.replace(order, **changes)


def command(folder: Path, code: str, words: str = "{data} {out}") -> CommandTraining:
    (folder / "mine.py").write_text(code)
    return CommandTraining(f"'{sys.executable}' '{folder / 'mine.py'}' {words}")


def train(training, order: TrainingOrder) -> dict:
    training.check(order)
    shards = [order.data / "shard"]
    return train_once(training, order, shards, order.out.read_text)


def runs(order: TrainingOrder) -> int:
    return (order.data / "log").read_text().count("run")


def test_a_command_gets_what_it_names_and_is_heard_at_once(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    order = order_in(tmp_path)
    train(command(tmp_path, WRITES, ALL), order)
    assert order.out.read_text() == "3"
    shown = capsys.readouterr().err
    assert shown == f"half a line\r{tmp_path / 'old.txt'} 3 2 2\n"
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    train(command(tmp_path, WRITES, ALL), dataclasses.replace(order, seed=4))
    assert capsys.readouterr().err.endswith(" 4 2 7\n")


def test_what_was_trained_is_trained_again_where_something_differs(tmp_path):
    order, training = order_in(tmp_path), command(tmp_path, WRITES, ALL)
    identity = train(training, order)
    assert train(training, order) == identity and runs(order) == 1
    assert list(identity["code"]) == [Path(sys.executable).name, "mine.py"]
    train(training, dataclasses.replace(order, threads=1))
    assert runs(order) == 1  # the number of threads decides nothing
    changes = [
        lambda: (order.data / "shard").write_text("other frames"),
        lambda: (tmp_path / "helper.py").write_text("A = 1"),
        lambda: (tmp_path / "helper.py").write_text("A = 2"),
        lambda: order.out.write_text("damaged"),
    ]
    training = command(tmp_path, f"import helper\n{WRITES}", ALL)
    (tmp_path / "helper.py").write_text("A = 0")
    train(training, order)
    for number, change in enumerate(changes, 3):
        change()
        train(training, order)
        assert runs(order) == number
        assert order.out.read_text() == "3"
    train(training, dataclasses.replace(order, seed=9))
    assert runs(order) == 7


def test_what_was_trained_is_kept_where_it_cannot_be_checked(tmp_path):
    """For example, because a server is down."""
    order, training = order_in(tmp_path), command(tmp_path, WRITES, ALL)
    train(training, order)

    def check() -> str:
        raise InputError("url: no answer")

    shards = [order.data / "shard"]
    with pytest.raises(InputError, match="no answer; correct the cause, or"):
        train_once(training, order, shards, check)
    train(training, order)
    assert runs(order) == 1 and order.out.read_text() == "3"


def test_frames_that_were_not_asked_for_are_refused(tmp_path):
    """A training reads all frames of the folder."""
    order, training = order_in(tmp_path), command(tmp_path, WRITES, ALL)
    other = order.data / "mitsuba" / "shard_0.safetensors"
    other.parent.mkdir()
    other.touch()
    with pytest.raises(InputError, match=r"shard_0.safetensors: is of other --frames"):
        train(training, order)
    train_once(training, order, [order.data / "shard", other], order.out.read_text)


def test_a_module_is_called_here(tmp_path):
    (tmp_path / "mine.py").write_text(
        "def train(data, out, seed):\n    out.write_text(f'{data.name} {seed}')\n"
    )
    order = order_in(tmp_path)
    training = ModuleTraining(f"{tmp_path / 'mine.py'}:train", trusted=True)
    identity = train(training, order)
    assert order.out.read_text() == "round_0 3"
    assert identity["module"] == training.name and list(identity["code"]) == ["mine.py"]


def test_a_module_that_catches_an_interrupt_has_not_trained(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import os, signal, sys\n"
        "def saves(data, out, seed):\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "        for _ in range(10**6): pass\n"
        "    except KeyboardInterrupt:\n"
        "        out.write_text('half')\n"
        "def ends(data, out, seed): sys.exit(0)\n"
    )
    order, file = order_in(tmp_path), tmp_path / "mine.py"
    with pytest.raises(KeyboardInterrupt):
        train(ModuleTraining(f"{file}:saves", trusted=True), order)
    assert not order.out.with_name("done.json").exists()
    with pytest.raises(InputError, match="ends the program"):
        train(ModuleTraining(f"{file}:ends", trusted=True), order)


def test_files_of_one_name_both_count(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "c.toml").write_text(name)
    words = f"{tmp_path}/a/c.toml {tmp_path}/b/c.toml {{data}} {{out}}"
    training = command(tmp_path, WRITES, words)
    before = training.code()
    (tmp_path / "a" / "c.toml").write_text("other")
    assert training.code() != before
    assert len(before) == 4  # Python, the script, and both


def test_modules_of_the_current_folder_count(tmp_path, monkeypatch):
    """``python -m mine.train`` runs a module, its packages, and what they import."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for name, text in (
        *(("__init__", ""), ("train", "from mine import loss\nfrom . import data")),
        *(("loss", "import json"), ("data", ""), ("unused", ""), ("__main__", "")),
    ):
        (tmp_path / "mine" / f"{name}.py").write_text(text)
    names = ["mine", "mine.data", "mine.loss", "mine.train"]
    code = CommandTraining("python -m mine.train {data} {out}").code()
    assert sorted(code) == names
    assert sorted(CommandTraining("python -m mine").code()) == ["mine", "mine.__main__"]
    assert CommandTraining("python -m json.tool -m").code() == {}
    (tmp_path / "mine" / "data.py").write_text("A = 1")
    assert CommandTraining("python -m mine.train {data} {out}").code() != code


FAILS = "import sys\nfor k in range(40): print('line', k)\nsys.exit(7)"


def test_a_command_that_fails_says_how_and_is_run_again(tmp_path):
    order = order_in(tmp_path)
    with pytest.raises(InputError, match="ended with exit status 7") as refused:
        train(command(tmp_path, FAILS), order)
    lines = str(refused.value).splitlines()
    assert [f"  line {k}" for k in range(28, 40)] == lines[1:-1]
    with pytest.raises(InputError, match="was ended by SIGKILL:\n  .nothing"):
        train(command(tmp_path, "import os; os.kill(os.getpid(), 9)"), order)
    assert (order.data / "shard").exists() and not order.out.exists()
    train(command(tmp_path, WRITES, ALL), order)


def failing(code: str, function: bool = False):
    """Return a call of a training that ends without a policy."""

    def call(folder: Path) -> None:
        order = order_in(folder)
        order.out.write_text("of an earlier training")
        if function:
            (folder / "mine.py").write_text(f"def train(data, out, seed): {code}\n")
            train(ModuleTraining(f"{folder / 'mine.py'}:train", True), order)
        else:
            train(command(folder, code), order)

    return call


NO_TEXT = "import sys; open(sys.argv[2], 'wb').write(b'\\xff')"


def unread(folder: Path) -> None:
    order, training = order_in(folder), command(folder, NO_TEXT)

    def check() -> str:
        raise InputError(f"{order.out}: is no policy")

    train_once(training, order, [], check)


test_a_training_without_a_policy_is_refused = refusals(
    (failing("print(1)"), r"wrote no .*policy.txt; write the new policy there"),
    (failing("import sys, os; os.mkdir(sys.argv[2])"), "wrote no "),
    (failing("pass", function=True), "wrote no "),
    (failing("1 / 0", function=True), "mine.py:train: raised ZeroDivisionError: "),
    (unread, "wrote what cannot be used: .*policy.txt: is no policy"),
)


def refused(training, **changes: object):
    return lambda folder: training.check(order_in(folder, **changes))


PYTHON = f"'{sys.executable}'"
test_what_cannot_train_is_refused_before_it_starts = refusals(
    (refused(CommandTraining("true {data}")), r"missing \{out\}; allowed: \{data\} "),
    (refused(CommandTraining("true {dat} {out}")), r"unknown \{dat\}; missing \{data"),
    (refused(CommandTraining("true {data} {out} {}")), r"unknown \{\}; allowed"),
    (refused(CommandTraining("")), r"missing \{data\} \{out\}"),
    (refused(CommandTraining("true '{data} {out}")), "No closing quotation; quote"),
    (refused(CommandTraining("no-such-program {data} {out}")), "is no program here"),
    (
        refused(CommandTraining(f"{PYTHON} {{data}} {{out}} {{policy}}"), policy=None),
        "the attacked policy is a server",
    ),
    (refused(ModuleTraining("mine:train", True)), "must have the form FILE.py:NAME"),
    (refused(ModuleTraining("mine.py:train", False)), "add --trust-code"),
    (refused(ModuleTraining("absent.py:train", True)), "absent.py: does not exist"),
    (lambda: chosen_training("a", "b.py:c", False), "--module: stands beside"),
    (lambda: chosen_training("a", None, True), "--trust-code: has no effect"),
)


def interrupted(folder: Path, code: str) -> TrainingOrder:
    """Interrupt a command once it works."""
    order = order_in(folder)

    def interrupt() -> None:
        while not order.out.with_name("ready").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        train(command(folder, code), order)
    return order


def test_an_interrupt_reaches_the_command_which_can_save(tmp_path):
    order = interrupted(tmp_path, SAVES)
    assert order.out.with_name("checkpoint").exists()
    train(command(tmp_path, WRITES, ALL), order)
    assert order.out.with_name("checkpoint").exists() and runs(order) == 1


def test_a_command_that_does_not_hear_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(shown_process, "GRACE_S", 0.2)
    order = interrupted(tmp_path, DEAF)
    with locks.exclusive(order.out.parent):  # nobody has it any longer
        assert not order.out.with_name("checkpoint").exists()


KILLED = """
import sys
from pathlib import Path
sys.path[:] = {path!r}
from tests.experiment.retrain.test_user_training import *
train(command(Path(sys.argv[1]), SAVES), order_in(Path(sys.argv[1])))
"""


def test_a_command_whose_program_was_killed_keeps_the_next_one_out(tmp_path):
    code = KILLED.format(path=sys.path)
    process = subprocess.Popen([sys.executable, "-c", code, tmp_path])
    order = order_in(tmp_path)
    while not order.out.with_name("ready").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    with pytest.raises(InputError, match="another process works in it"):
        train(command(tmp_path, WRITES, ALL), order)
    os.kill(int(order.out.with_name("pid").read_text()), signal.SIGKILL)
    locks.wait_for(order.out.parent)
    train(command(tmp_path, WRITES, ALL), order)
