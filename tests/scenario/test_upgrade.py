"""Files of the first form: rewritten with their comments, and refused with lines."""

from __future__ import annotations

import pytest
from support.files.runs import HEAD, write_named_files

from mi_nerfattack import cli
from mi_nerfattack.errors import InputError
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.upgrade import (
    upgraded,
    upgraded_environment,
    upgraded_text,
)

OLD = """\
# a scenario
name = "test" # of mine
[objective] # two terms
# the first
kind = "heading" # h
rounding_deg = 2
at = "end"
reduction = "cvar"
cvar_fraction = 0.5

[[objective.terms]] # the second
weights = "last"
last_s = 2.0
at = "all_times"
[attack]
# why so many
max_iterations = 4 # few
jitter = true
fixed_m = [
    [[0, 0, 0], [1, 1, 1]], # a box
]
adjoint = "checkpointed"
segment = 8

[vehicle] # a car
model = "bicycle"
[[deployment]]
environment = "mujoco"
spp = 2
"""
NEW = """\
# a scenario
name = "test" # of mine
[objective] # two terms

[[objective.term]]
# the first
kind = "heading" # h
rounding_deg = 2

[objective.term.weights]
kind = "end"

[objective.reduction]
kind = "cvar"
fraction = 0.5

[[objective.term]] # the second

[objective.term.weights]
kind = "last"
last_s = 2.0

[attack]
jitter = true

[attack.method]
# why so many
max_iterations = 4 # few

[attack.freedom]
fixed_m = [
    [[0, 0, 0], [1, 1, 1]], # a box
]

[attack.adjoint]
kind = "checkpointed"
segment = 8

[vehicle] # a car
kind = "bicycle"
[[deployment]]
kind = "mujoco"
spp = 2
"""


def test_tables_are_rewritten_with_their_comments():
    assert upgraded_text("a.toml", OLD) == NEW
    assert upgraded_text("a.toml", NEW) == NEW
    assert upgraded(parse_toml("a", OLD)) == parse_toml("a", NEW)


METHODS = '[[methods]]\nname = "a"\n'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('attack.method = "blocks"', 'attack.method.kind = "blocks"'),
        (
            'attack = { parameters = "pose", poses = 2 } # why',
            'attack = { freedom = { kind = "pose" }, poses = 2 } # why',
        ),
        (
            '[policy]\nfile = "a.pt"\ngoal = "one_hot"\ngoals = 3',
            '[policy]\nfile = "a.pt"\n\n[policy.goal]\nkind = "one_hot"\ncount = 3',
        ),
        (
            f"{METHODS}set.attack.max_iterations = 3",
            f"{METHODS}set.attack.method.max_iterations = 3",
        ),
        (
            f'{METHODS}set.attack = {{ method = "random", frames = 3 }}',
            f'{METHODS}set.attack = {{ method = {{ kind = "random", frames = 3 }} }}',
        ),
        (
            "[[methods]]\n[methods.set.attack]\nlinf = 0.5\n[[routes]]",
            "[[methods]]\n[methods.set.attack.freedom]\nlinf = 0.5\n\n[[routes]]",
        ),
        # of today, or unknown
        ('[attack]\nmethod = { kind = "blocks" }\nattached = true', None),
        ('[attack.method]\nkind = "cma_es"\nvariant = "separable"', None),
        ('[objective]\nreduction.kind = "worst"\n[[objective.term]]', None),
        ('[baseline]\nkind = "blobs"\n[policy]\nkind = "onnx"', None),
        ("[attack]\nmax_iteratons = 3", None),
    ],
)
def test_every_shape_of_toml_is_rewritten_or_stays(old, new):
    assert upgraded_text("a.toml", f"{old}\n") == f"{new or old}\n"


def test_what_no_line_can_say_is_told_as_a_whole():
    mixed = '[attack]\nmax_iterations = 3\n[attack.method]\nkind = "gradient"\n'
    with pytest.raises(InputError, match=r'(?s)only you.*max_iterations = 3\nkind = "'):
        upgraded_text("a.toml", mixed)
    alone = '[[objective.terms]]\nkind = "heading"\n'  # beside the default
    with pytest.raises(InputError, match=r"(?s)only you.*term\]\]\n\[\[objective.term"):
        upgraded_text("a.toml", alone)


def test_the_reader_names_the_command_which_does_it(tmp_path, capsys):
    write_named_files(tmp_path)
    path = tmp_path / "scenario.toml"
    path.write_text(HEAD + "[drive]\nhorizon = 4\n" + OLD.partition("mine\n")[2])
    with pytest.raises(InputError) as refused:
        load_scenario(path)
    message = str(refused.value)
    assert message.startswith(f"{path}: is of an older form; 'mi-nerfattack upgrade")
    for line in ("-cvar_fraction = 0.5", "+fraction = 0.5", "+[attack.method]"):
        assert line in message.splitlines()
    assert cli.main(["upgrade", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: rewritten\n"
    scenario, text = load_scenario(path)
    assert scenario.attack.method.max_iterations == 4
    assert [term.kind for term in scenario.objective.term] == ["heading", "cross_track"]
    assert cli.main(["upgrade", str(path)]) == 0
    assert "is of the form of today" in capsys.readouterr().out
    assert path.read_text() == text


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("deployment", "", "mitsuba"),
        ("deployment", '[[deployment]]\nenvironment = "mujoco"', "mujoco"),
        ("deployment", '[deployment]\nkind = "mujoco_gl"', "mujoco_gl"),
        ("deployment", '[deployment]\nname = "deployment"', "deployment"),
        ("deployment", '[[deployment]]\n[[deployment]]\nname = "deployment"', ""),
        ("surrogate", "", ""),
        ("lit", '[deployment]\nname = "lit"', ""),
    ],
)
def test_an_only_environment_was_once_called_deployment(name, text, expected):
    environment = upgraded_environment(name, parse_toml("old.toml", text))
    assert environment == (expected or name)
