"""The stand-in for CARLA against the real client's classes, where it is installed."""

from __future__ import annotations

import dataclasses
import inspect
import re

import pytest
from helpers import carla_stand_in as stand_in


def parameters(function) -> list[str]:
    """Names of the parameters in the docstring of a function of the client."""
    signature = function.__doc__.strip().splitlines()[0].split(" -> ")[0]
    return re.findall(r"\(\w+\)(\w+)", signature)[1:]


MIMICS = [
    item
    for item in vars(stand_in).values()
    if inspect.isclass(item) and item.__module__.startswith("helpers.carla_stand_in")
    if item is not stand_in.Server
]


@pytest.mark.parametrize("mimic", MIMICS, ids=lambda item: item.__name__)
def test_the_stand_in_has_nothing_that_the_client_has_not(carla, mimic):
    real = getattr(carla, mimic.__name__)
    names = set(vars(mimic))
    if dataclasses.is_dataclass(mimic):
        names |= {item.name for item in dataclasses.fields(mimic)}
    names = {name for name in names if not name.startswith("_")}
    assert names <= set(dir(real))
    for name, value in vars(mimic).items():
        if not inspect.isfunction(value) or name.startswith("_"):
            continue
        ours = list(inspect.signature(value).parameters)[1:]
        theirs = parameters(getattr(real, name))
        assert len(ours) <= len(theirs), name
        for mine, other in zip(ours, theirs, strict=False):
            assert (
                re.fullmatch(r"arg\d+", other)
                or name == "apply_settings"
                or (mine == other)
            ), f"{mimic.__name__}.{name}: {mine} is called {other}"


@pytest.mark.parametrize(
    "name", ["Location", "Rotation", "VehicleControl", "WorldSettings"]
)
def test_the_stand_in_makes_values_as_the_client_does(carla, name):
    real, mimic = getattr(carla, name)(), getattr(stand_in, name)()
    for item in dataclasses.fields(mimic):
        value = getattr(mimic, item.name)
        assert getattr(real, item.name) == pytest.approx(value), item.name
        setattr(real, item.name, value)  # all of them can be written, too
