"""A sequential test of a rate of success, for drives that are few and dear.

Wald's test: after each drive, the likelihood of all outcomes so far at a rate of `p1`
over that at `p0`. From (1 - beta) / alpha on the rate is taken to be p1, down from
beta / (1 - alpha) on to be p0; between them another drive is needed. At the rate p0 it
accepts with a probability of about alpha at most, at p1 it rejects with about beta.

Source: Wald 1945, "Sequential Tests of Statistical Hypotheses", section 3.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.overrides import tell
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.ranges import Fraction, NonNegative
from mi_nerfattack.scenario.section import Section, problems, refuse

GO_ON, ACCEPT, REJECT = "go on", "accept", "reject"
#: Rates that are closer take hundreds of drives to tell apart.
CLOSEST = 0.05
_ROUNDING = 1e-9  # of sums of logarithms
#: What an object can show to a real car.
Case = Literal["no_object", "own", "random", "attack"]
_MEAN = "cross_track_mean_m"
_LEFT = 1e-12  # probability of drives that are no longer followed


@dataclass(frozen=True)
class Forecast:
    """What a test does at a rate of success.

    Attributes:
        rate: of success.
        drives: expected number until the decision.
        accepted: probability that it accepts.
    """

    rate: float
    drives: float
    accepted: float


class SequentialTest(Section):
    """Wald's test of a rate; see the module."""

    p0: Fraction  # rate of success that is not enough
    p1: Fraction  # rate that is
    alpha: Fraction  # chance to accept at p0
    beta: Fraction  # chance to reject at p1

    @model_validator(mode="after")
    def _check_rates(self) -> Any:
        if self.p1 - self.p0 < CLOSEST - _ROUNDING:
            refuse("p1", f"must exceed p0 by {CLOSEST} at least (is {self.p1})")
        if self.alpha + self.beta >= 1:
            refuse("beta", f"alpha + beta must be below 1 (is {self.beta})")
        return self

    def log_ratio(self, successes: Any, drives: Any) -> Any:
        """Return the logarithm of the ratio of likelihoods, p1 over p0."""
        gain = math.log(self.p1 / self.p0)
        loss = math.log((1 - self.p1) / (1 - self.p0))
        return successes * gain + (drives - successes) * loss

    @property
    def bounds(self) -> tuple[float, float]:
        """Logarithms of the ratios at which it rejects and accepts."""
        reject = math.log(self.beta / (1 - self.alpha))
        return reject, math.log((1 - self.beta) / self.alpha)

    def decisions(self, outcomes: Sequence[bool]) -> list[str]:
        """Return the decision after each drive; the first but "go on" stands."""
        low, high = self.bounds
        decisions: list[str] = []
        successes = 0
        for drives, outcome in enumerate(outcomes, start=1):
            successes += outcome
            if decisions and decisions[-1] != GO_ON:
                decisions.append(decisions[-1])
                continue
            ratio = self.log_ratio(successes, drives)
            accepts, rejects = ratio >= high - _ROUNDING, ratio <= low + _ROUNDING
            decisions.append(ACCEPT if accepts else REJECT if rejects else GO_ON)
        return decisions

    def forecast(self, rate: float) -> Forecast:
        """Return what the test does at a rate of success in (0, 1), exactly.

        By the probability of every number of successes of those that go on.
        """
        low, high = self.bounds
        going, fewest, drives = np.ones(1), 0, 0  # by successes, from the fewest on
        expected = accepted = 0.0
        while (left := float(going.sum())) > _LEFT:
            expected += left
            going, drives = np.convolve(going, [1 - rate, rate]), drives + 1
            ratio = self.log_ratio(fewest + np.arange(len(going)), drives)
            accepted += float(going[ratio >= high - _ROUNDING].sum())
            rejected = int((ratio <= low + _ROUNDING).sum())  # rises with successes
            fewest += rejected
            going = going[rejected : int((ratio < high - _ROUNDING).sum())]
        return Forecast(rate, expected, accepted)


class Criteria(Section):
    """What counts as success, and how many successes are enough."""

    case: Case = "attack"  # the drives that count
    metric: Literal[
        "wheel_out_s", "centre_out_s", "cross_track_mean_m", "cross_track_max_m"
    ]
    at_least: NonNegative | None = None  # a drive succeeds from here on
    at_most: NonNegative | None = None  # or up to here
    test: SequentialTest

    @model_validator(mode="after")
    def _check_threshold(self) -> Any:
        if (self.at_least is None) == (self.at_most is None):
            refuse("at_least", "give either at_least or at_most")
        return self

    def judge(self, figures: Mapping[str, Any], complete: bool) -> bool | None:
        """Tell whether a drive succeeded.

        Args:
            figures: of the drive, as `metrics.summarise` gives them.
            complete: whether it went all the way.

        Returns:
            None of a drive that ended early and might have come to either.
        """
        value = figures[self.metric]
        grows = self.metric != _MEAN
        if self.at_least is not None:
            reached = value >= self.at_least
            return reached if complete or (reached and grows) else None
        exceeded = value > (self.at_most or 0.0)
        return not exceeded if complete or (exceeded and grows) else None

    @property
    def sentence(self) -> str:
        """What a success is."""
        least = self.at_least is not None
        limit = self.at_least if least else self.at_most
        comparison = "at least" if least else "at most"
        return f"{self.case}: {self.metric} of {comparison} {limit:g}"


def rate_interval(successes: int, drives: int) -> list[float]:
    """Return a 95 % interval of a rate that holds whenever one stops to drive.

    The interval holds the rates at which the likelihood is more than a twentieth of its
    average over all rates. At the true rate, average over likelihood is a martingale.
    So it ever exceeds 20 with a probability of 5 % at most.

    Args:
        successes: among the drives.
        drives: 0 or more.

    Source: Robbins 1970, "Statistical Methods Related to the Law of the Iterated
    Logarithm", section 3; Ville 1939.
    """
    from scipy.optimize import root_scalar  # takes a while to load
    from scipy.special import betaln, xlog1py, xlogy

    failures = drives - successes

    def excess(rate: float) -> float:
        likelihood = xlogy(successes, rate) + xlog1py(failures, -rate)
        mean = betaln(successes + 1, failures + 1)
        return float(mean - likelihood) - math.log(20)

    best, tiny = successes / max(drives, 1), 1e-300
    low = root_scalar(excess, bracket=(tiny, best)).root if successes else 0.0
    high = root_scalar(excess, bracket=(best, 1 - 1e-16)).root if failures else 1.0
    return [float(low), float(high)]


def read_criteria(path: Path) -> Criteria:
    """Read criteria.

    Raises:
        InputError: the file cannot be read, is no TOML, or a key is unknown, missing,
            of the wrong type or out of range; with file and line.
    """
    text = files.read_text(path, files.MAX_TOML_BYTES)
    try:
        return Criteria.model_validate(parse_toml(path, text))
    except ValidationError as err:
        raise InputError(tell(path, text, problems(err))) from err


def tested(criteria: Criteria, outcomes: Sequence[bool]) -> dict[str, Any]:
    """Return what the test says of drives so far; those after a decision count not.

    Args:
        criteria: of success.
        outcomes: of the drives that were judged, in their order.
    """
    test = criteria.test
    decisions = test.decisions(outcomes)
    drives = min(len(outcomes), decisions.count(GO_ON) + 1)
    successes = sum(outcomes[:drives])
    bad, good = test.forecast(test.p0), test.forecast(test.p1)
    return {
        "criteria": criteria.model_dump(exclude_none=True),
        "expected_drives_at_p0": bad.drives,
        "expected_drives_at_p1": good.drives,
        "accepts_at_p0": bad.accepted,
        "rejects_at_p1": 1 - good.accepted,
        "drives": drives,
        "successes": successes,
        "after_decision": len(outcomes) - drives,
        "log_likelihood_ratio": test.log_ratio(successes, drives),
        "bounds": list(test.bounds),
        "decision": decisions[-1] if decisions else GO_ON,
        "rate_ci95_anytime": rate_interval(successes, drives),
    }


def sentences(criteria: Criteria, done: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a test came to, a line each.

    Args:
        criteria: of success.
        done: from :func:`tested`.
    """
    test = criteria.test
    yield (
        f"Success is {criteria.sentence}. Test of {test.p1:g} against {test.p0:g}: "
        f"expected drives {done['expected_drives_at_p1']:.1f} at {test.p1:g}, "
        f"{done['expected_drives_at_p0']:.1f} at {test.p0:g}; it accepts wrongly in "
        f"{100 * done['accepts_at_p0']:.1f} %, rejects wrongly in "
        f"{100 * done['rejects_at_p1']:.1f} %."
    )
    low, high = done["rate_ci95_anytime"]
    meaning = {
        GO_ON: "another drive is needed",
        ACCEPT: f"the rate of success is {test.p1:g} rather than {test.p0:g}",
        REJECT: f"the rate of success is {test.p0:g} rather than {test.p1:g}",
    }[done["decision"]]
    yield (
        f"{done['successes']} of {done['drives']} succeeded: {done['decision']}, "
        f"{meaning}. The rate is {low:.2f} to {high:.2f} (95 %, whenever one stops)."
    )
    if done["after_decision"]:
        yield f"{done['after_decision']} drives after the decision do not count."
