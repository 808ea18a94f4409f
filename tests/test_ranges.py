"""Ranges of numbers as types, and what an error says where."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.evaluate import EvaluateSettings
from mi_nerfattack.evaluation.field_and_scene import CompareOptions
from mi_nerfattack.ranges import Acute, Count, Finite, Fraction, Natural, checked
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.training.train import TrainSettings


@dataclass(frozen=True)
@checked("sizes")
class Sizes:
    count: Count | None = None
    part: Fraction = 0.5
    angle: Acute = 1.0
    offset: Finite = 0.0
    frames: Mapping[str, Natural] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        if self.name == "none":
            raise InputError("sizes.name: none")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "sizes.count: 0; must be a whole number of at least 1"),
        ({"count": 2.0}, "sizes.count: 2.0; must be a whole number"),
        ({"count": "3"}, "sizes.count: '3'; must be a whole number"),
        ({"count": True}, "sizes.count: True; must be a whole number"),
        ({"part": 1}, r"sizes.part: 1; must be a finite number in \(0, 1\)"),
        ({"part": math.nan}, "sizes.part: nan; must"),
        ({"angle": 1.6}, r"sizes.angle: 1.6; must .* in \(0, 1.570796327\), radians"),
        ({"offset": -math.inf}, "sizes.offset: -inf; must be a finite number$"),
        ({"frames": {"a": -1}}, "sizes.frames: {'a': -1}; must .* of at least 0"),
        ({"name": "none"}, "sizes.name: none"),
    ],
)
def test_what_is_outside_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        Sizes(**change)


@pytest.mark.parametrize(
    ("make", "change"),
    [
        (CollectSettings, {"object_share": 1.5}),
        (CompareOptions, {"near_m": math.inf}),
        (EvaluateSettings, {"objects": -1}),
        (TrainSettings, {"learning_rate": 0.0}),
    ],
)
def test_settings_out_of_range_are_named(make, change):
    with pytest.raises(InputError, match=rf"{next(iter(change))}\b.*; "):
        make(**change)


def test_numbers_of_numpy_are_numbers():
    sizes = Sizes(count=np.int64(2), part=np.float32(0.25), frames={"a": 0})
    assert sizes.count == 2 and sizes.part == 0.25


@pytest.mark.parametrize(
    ("message", "where", "remedy"),
    [
        ("a.toml: x: 3; at most 2", "a.toml", "at most 2"),
        ("a.toml: x; y: 3; at most 2", "a.toml", "at most 2"),
        ("a.toml: no frames", "a.toml", ""),
        ("--fps; give one", "--fps; give one", "give one"),
    ],
)
def test_a_message_has_a_place_and_a_remedy(message, where, remedy):
    error = InputError(message)
    assert (str(error), error.where, error.remedy) == (message, where, remedy)


def test_the_middle_of_a_long_message_is_left_out():
    error = InputError("a.toml: " + 9000 * "x" + "; write it again")
    assert len(str(error)) < 8000 and "(1524 characters)" in str(error)
    assert (error.where, error.remedy) == ("a.toml", "write it again")
