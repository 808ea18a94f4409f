"""The sequential test against figures worked out by hand."""

from __future__ import annotations

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation import sequential
from mi_nerfattack.evaluation.sequential import (
    SequentialTest,
    rate_interval,
    read_criteria,
)
from mi_nerfattack.io import files

TEXT = """\
case = "attack"
metric = "wheel_out_s"
at_least = 1.0
[test]
p0 = 0.25
p1 = 0.75
alpha = 0.1
beta = 0.1
"""


def walk() -> SequentialTest:
    """Each drive moves the ratio by a factor of 3, up or down; it ends at 9 or 1/9."""
    return SequentialTest(p0=0.25, p1=0.75, alpha=0.1, beta=0.1)


def test_a_walk_between_two_steps_up_and_down():
    """Gambler's ruin with q / p = 3: up in 1 / (1 + 9), drives 1.6 / 0.5."""
    bad, even, good = (walk().forecast(rate) for rate in (0.25, 0.5, 0.75))
    assert bad.accepted == pytest.approx(0.1) and bad.drives == pytest.approx(3.2)
    assert even.accepted == pytest.approx(0.5) and even.drives == pytest.approx(4)
    assert good.accepted == pytest.approx(0.9) and good.drives == pytest.approx(3.2)


def test_decisions_stand():
    on, accept, reject = "go on", "accept", "reject"
    assert walk().decisions([]) == []
    assert walk().decisions([True, True, False, False]) == [on, accept, accept, accept]
    assert walk().decisions([True, False, False, False]) == [on, on, on, reject]
    # log ratios of one success and one failure: ln 6 and ln 4/9; bounds ln 18, ln 2/19
    steep = SequentialTest(p0=0.1, p1=0.6, alpha=0.05, beta=0.1)
    assert steep.decisions([True, True]) == [on, accept]
    assert steep.decisions([False] * 3) == [on, on, reject]
    assert steep.decisions([True, False, True]) == [on, on, on]  # 16 < 18


def test_interval_at_any_time():
    """Rates of which 20 p^k (1 - p)^(n - k) exceeds the Beta function B(k+1, n-k+1)."""
    assert rate_interval(0, 0) == [0, 1]
    assert rate_interval(0, 1) == pytest.approx([0, 0.975])  # 20 (1 - p) = 1 / 2
    assert rate_interval(2, 2) == pytest.approx([60**-0.5, 1])  # 20 p^2 = 1 / 3
    low, high = rate_interval(1, 2)  # 20 p (1 - p) = 1 / 6
    assert low * (1 - low) == pytest.approx(1 / 120) == high * (1 - high)


def test_criteria(tmp_path):
    path = tmp_path / "criteria.toml"
    path.write_text(TEXT)
    criteria = read_criteria(path)
    assert criteria.test == walk()
    assert sequential.tested(criteria, [True])["criteria"] == files.read_toml(path)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ('"attack"', '"car"', ":1: case: "),
        ("wheel_out_s", "speed", ":2: metric: "),
        ("at_least = 1.0", "", ": at_least: "),
        ("at_least", "at_most = 2.0\nat_least", ":4: at_least: "),
        ("0.75", "0.29", ":6: test.p1: must exceed p0 by 0.05"),
        ("beta = 0.1", "beta = 0.9", ":8: test.beta: "),
        ("beta = 0.1", "", ":4: test.beta: "),
        ("alpha = 0.1", "alpha = 0.0", ":7: test.alpha: "),
        ("p0", "p2", ":5: test.p2: "),
        ("[test]", "[test", ": "),
    ],
)
def test_criteria_that_are_refused(tmp_path, old, new, where):
    path = tmp_path / "criteria.toml"
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(InputError) as refused:
        read_criteria(path)
    assert f"{path}{where}" in str(refused.value)


def test_drives_that_end_early(tmp_path):
    """They count where more of them could change nothing."""
    path = tmp_path / "criteria.toml"

    def judge(text: str, complete: bool, **figures: float) -> bool | None:
        path.write_text(text)
        return read_criteria(path).judge(figures, complete)

    for word, seconds, complete, outcome in (
        ("at_least", 1.0, True, True),
        ("at_least", 0.9, True, False),
        ("at_least", 1.0, False, True),
        ("at_least", 0.9, False, None),
        ("at_most", 1.0, True, True),
        ("at_most", 1.1, True, False),
        ("at_most", 1.0, False, None),
        ("at_most", 1.1, False, False),
    ):
        text = TEXT.replace("at_least", word)
        assert judge(text, complete, wheel_out_s=seconds) is outcome
    text = TEXT.replace("wheel_out_s", "cross_track_mean_m")
    assert judge(text, True, cross_track_mean_m=2.0) is True
    assert judge(text, False, cross_track_mean_m=2.0) is None
