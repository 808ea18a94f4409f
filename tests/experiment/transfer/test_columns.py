"""Environments and conditions of a transfer."""

from __future__ import annotations

import pytest
from support.faults.refusals import refused_at

from mi_nerfattack.experiment.transfer.columns import make_columns, parse_condition


@pytest.mark.parametrize(
    "label",
    [
        "day",
        "evening,exposure:+0.5,noise:0.03",
        "exposure:-1",
        "blur:1,dropped:0.2,late:1,latency:2,placement:0.1,turn:5,pitch:1",
    ],
)
def test_labels_read_back(label):
    condition = parse_condition(label)
    assert condition.label == label
    assert parse_condition(condition.label) == condition


@pytest.mark.parametrize(
    ("environment", "conditions", "spp", "where", "value"),
    [
        ("moon", ["day"], 1, "--environments", "'moon'"),
        ("surrogate_built_in", ["day"], 1, "--environments", "surrogate"),
        ("mujoco", ["day", "day"], 1, "--conditions", "day day"),
        ("mujoco", ["night"], 1, "--conditions", "'night'"),
        ("mujoco", ["late:0.5"], 1, "--conditions", "late: "),
        ("mujoco", ["dropped:2"], 1, "--conditions", "dropped_share: 2.0"),
        ("mujoco", ["blur:1,blur:2"], 1, "--conditions", "'blur:2'"),
        ("surrogate", ["evening"], 1, "--conditions", "the surrogate"),
        ("mujoco", ["day"], 0, "spp", "0"),
    ],
)
def test_what_is_no_column_is_refused(environment, conditions, spp, where, value):
    with refused_at(where, value):
        make_columns([environment], conditions, spp)
