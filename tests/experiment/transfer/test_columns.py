"""Environments and conditions of a transfer."""

from __future__ import annotations

import pytest

from mi_nerfattack.experiment.transfer.columns import parse_condition


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
