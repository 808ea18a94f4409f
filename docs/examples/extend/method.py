"""A search: one texture, changed at random and kept where that helps."""

from typing import Literal

import numpy as np

from mi_nerfattack.attack.black_box.low_frequency import LowFrequency
from mi_nerfattack.attack.black_box.search import AbstractSearch, Proposal
from mi_nerfattack.attack.black_box.surrogate import Task
from mi_nerfattack.ranges import Positive
from mi_nerfattack.scenario.attack import AbstractSearchMethod


class OnePlusOne(AbstractSearch):
    def __init__(self, basis: LowFrequency, step: float, seed: int) -> None:
        self.basis, self.step, self.rng = basis, step, np.random.default_rng(seed)
        self.best, self.least = np.zeros(basis.count), np.inf
        self.asked = self.best

    def ask(self) -> Proposal:
        if np.isfinite(self.least):  # the first proposal is the original texture
            change = self.step * self.rng.standard_normal(self.basis.count)
            self.asked = np.clip(self.best + change, -1, 1)
        return self.basis.propose(self.asked)

    def tell(self, objective: float) -> None:
        if objective < self.least:
            self.best, self.least, self.step = self.asked, objective, 1.5 * self.step
        else:
            self.step *= 1.5**-0.25  # one success in five keeps the step


class OnePlusOneMethod(AbstractSearchMethod):
    kind: Literal["one_plus_one"]
    step: Positive = 0.2  # standard deviation of the first change, sRGB

    def search(self, task: Task) -> AbstractSearch:
        return OnePlusOne(LowFrequency(task.colourings, 64), self.step, task.seed)
