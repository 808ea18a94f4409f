"""Keys of TOML documents that ``--set`` gives."""

from __future__ import annotations

from functools import reduce
from operator import getitem

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.io.overrides import find_setting, set_keys
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenes import bundled

TEXT = """\
seed = 1  # of all
[policy]
file = "a.pt2"
[[objects]]
id = "ball"
position_m = [1, 2, 3]
[drive]
runs = 2
[policy.preprocess]
resize_px = [4, 2]
"""


@pytest.mark.parametrize(
    ("settings", "keys", "value"),
    [
        (["seed=7"], ["seed"], 7),
        (["policy.file=b.pt"], ["policy", "file"], "b.pt"),
        (["policy.file='b c.pt'"], ["policy", "file"], "b c.pt"),
        (["policy.file=../b.py:Net"], ["policy", "file"], "../b.py:Net"),
        (["policy.trust_code=true"], ["policy", "trust_code"], True),
        (["policy.preprocess.mean=[0.5]"], ["policy", "preprocess", "mean"], [0.5]),
        (["objects.0.position_m.2=9.5"], ["objects", 0, "position_m", 2], 9.5),
        (["camera.width=80"], ["camera"], {"width": 80}),
        (["scene.a.b=1", "scene.a.c=2"], ["scene"], {"a": {"b": 1, "c": 2}}),
        (["drive={ runs = 3 }"], ["drive"], {"runs": 3}),
        ([], ["seed"], 1),
    ],
)
def test_a_key_is_set_and_the_others_stay(settings, keys, value):
    text = set_keys("a.toml", TEXT, settings)
    expected = parse_toml("a.toml", TEXT)
    *path, last = keys
    reduce(getitem, path, expected)[last] = value
    assert parse_toml("a.toml", text) == expected
    assert "# of all" in text


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("seed", "KEY=VALUE"),
        ("=1", "KEY=VALUE"),
        ("a b=1", "KEY=VALUE"),
        ("seed=", "TOML"),
        ("seed=[1", "TOML"),
        ("seed=1\nother = 2", "TOML"),
        ("seed.deep=1", "'deep'"),
        ("objects.1.id=x", "no 1 there"),
        ("objects.id=x", "no 'id'"),
        ("objects.0.position_m.3=1", "no 3 there"),
        ("5=1", "5 is no key"),
        ("drive.runs=2", "twice"),
    ],
)
def test_what_cannot_be_set_names_the_option(setting, message):
    with pytest.raises(InputError, match=message) as err:
        set_keys("a.toml", TEXT, ["drive.runs=1", setting])
    assert str(err.value).startswith(f"--set {setting}")


def test_the_setting_that_gave_a_value_is_found():
    settings = ["seed=1", "objects.0.position_m=[0]", "policy.file=x"]
    assert find_setting(settings, ("seed",)) == "seed=1"
    assert find_setting(settings, ("objects", 0, "position_m", 2)) == settings[1]
    assert find_setting(settings, ("objects", 1, "position_m")) is None
    assert find_setting(settings, ("policy",)) is None


def test_a_wrong_value_is_told_with_the_option():
    with pytest.raises(InputError, match="^--set seed=-1: seed: "):
        load_scenario(bundled("demo.toml"), settings=["seed=-1"])
    scenario, text = load_scenario(bundled("demo.toml"), settings=["seed=77"])
    assert scenario.seed == 77 and parse_toml("a", text)["seed"] == 77
