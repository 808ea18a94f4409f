"""A sequential test of a rate of success, for drives that are few and dear.

Wald's test: after each drive, the likelihood of all outcomes so far at a rate of `p1`
over that at `p0`. From (1 - beta) / alpha on the rate is taken to be p1, down from
beta / (1 - alpha) on to be p0; between them another drive is needed. At the rate p0 it
accepts with a probability of about alpha at most, at p1 it rejects with about beta.

Source: Wald 1945, "Sequential Tests of Statistical Hypotheses", section 3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import model_validator

from mi_nerfattack.ranges import Fraction
from mi_nerfattack.scenario.section import Section, refuse

GO_ON, ACCEPT, REJECT = "go on", "accept", "reject"
#: Rates that are closer take hundreds of drives to tell apart.
CLOSEST = 0.05
_ROUNDING = 1e-9  # of sums of logarithms
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
        found: list[str] = []
        successes = 0
        for drives, outcome in enumerate(outcomes, start=1):
            successes += outcome
            if found and found[-1] != GO_ON:
                found.append(found[-1])
                continue
            ratio = self.log_ratio(successes, drives)
            accepts, rejects = ratio >= high - _ROUNDING, ratio <= low + _ROUNDING
            found.append(ACCEPT if accepts else REJECT if rejects else GO_ON)
        return found

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


def rate_interval(successes: int, drives: int) -> list[float]:
    """Return a 95 % interval of a rate that holds whenever one stops to drive.

    Rates at which the likelihood, averaged over all rates, is less than 20 times as
    large as it is there: at the true rate that ratio is a martingale, which exceeds 20
    at any time with a probability of 5 % at most.

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

    best, tiny = (successes / drives if drives else 0.5), 1e-300
    low = root_scalar(excess, bracket=(tiny, best)).root if successes else 0.0
    high = root_scalar(excess, bracket=(best, 1 - 1e-16)).root if failures else 1.0
    return [float(low), float(high)]
