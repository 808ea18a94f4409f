"""When a search by gradient tries, follows the camera, slows down and stops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from mi_nerfattack.attack.opening import AbstractOpening
from mi_nerfattack.rollout.function import Rollout

#: The last fifth of the iterations is to gain less than this share of the whole gain.
LEAST_GAIN = 0.02
#: Below, a fifth is too few to tell.
_FEWEST = 10


@dataclass(frozen=True)
class Schedule:
    """Learning rates over the iterations.

    They are constant until the attack has converged, or three quarters of
    `max_iterations` are done; then they fall exponentially over a third as many
    iterations as were done till then.

    Attributes:
        max_iterations: in all.
        final_rate: share of the rates that is left at the end.
    """

    max_iterations: int
    final_rate: float = 1.0

    def rate(self, objectives: Sequence[float]) -> float:
        """Return the share of the learning rates after some iterations.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        if turn is None:
            return 1.0
        # An exponential fall, which reaches the final rate after `_fall` iterations
        return float(self.final_rate ** ((len(objectives) - turn + 1) / _fall(turn)))

    def is_over(self, objectives: Sequence[float]) -> bool:
        """Whether to stop.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        done = len(objectives)
        return done >= self.max_iterations or (
            turn is not None and done >= turn + _fall(turn)
        )

    def has_converged(self, objectives: Sequence[float]) -> bool:
        """Whether the rates fell because there was nothing more to gain at full rate.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        return turn is not None and has_settled(objectives[:turn])

    def full(self, objectives: Sequence[float]) -> int:
        """Return how many iterations had the full rates.

        Args:
            objectives: of the iterations that are done.
        """
        turn = self._turn(objectives)
        return len(objectives) if turn is None else turn

    def _turn(self, objectives: Sequence[float]) -> int | None:
        """Return after how many iterations the rates began to fall."""
        last = math.ceil(0.75 * self.max_iterations)
        settled = np.flatnonzero(_settled_after(objectives[:last]))
        if len(settled):
            return int(settled[0])
        return last if len(objectives) >= last else None


def has_settled(objectives: Sequence[float]) -> bool:
    """Whether the last fifth of the iterations gained under 2 % of the whole gain.

    The gain is that of the least objective so far on the first one. Nothing has settled
    that gained nothing at all, nor after fewer than ten iterations.

    Args:
        objectives: of each iteration, minimised.
    """
    return bool(_settled_after(objectives)[-1])


def _settled_after(objectives: Sequence[float]) -> np.ndarray:
    """Return :func:`has_settled` after each number of iterations from 0, (n + 1,)."""
    settled = np.zeros(len(objectives) + 1, bool)
    done = np.arange(_FEWEST, len(objectives) + 1)
    if len(done):
        # The total gain and the gain of the last fifth, for every count of iterations
        best = np.minimum.accumulate(objectives)
        last = best[done - 1]
        gain, late = best[0] - last, best[done - 1 - done // 5] - last
        settled[done] = (gain > 0) & (late < LEAST_GAIN * gain)
    return settled


def _fall(turn: int) -> int:
    """Return over how many iterations the rates fall."""
    return max(1, turn // 3)


#: In which iterations after the opening attached images are differentiated.
Follow = Literal["always", "second_half", "in_turns"]

_WINDOW = 5  # iterations whose predicted and real gains are compared


@dataclass(frozen=True)
class Plan:
    """What each iteration of a search by gradient does.

    The opening's tries come first, the search itself goes on from the best of them.
    Everything follows from the objectives of the iterations that are done.

    Attributes:
        schedule: of the learning rates, after the opening. With "second_half" each
            half has one of its own, and only the second one's rates fall.
        opening: from where to try first; None for one start.
        follow: where the rollout is attached, in which iterations it is: `"always"`,
            in tries too; in the `"second_half"` after the opening, or once the first
            has settled; `"in_turns"`, in every other iteration after the opening.
    """

    schedule: Schedule
    opening: AbstractOpening | None = None
    follow: Follow = "always"

    @property
    def tried(self) -> int:
        """Number of iterations of the opening."""
        return self.opening.count * self.opening.each if self.opening else 0

    def try_index(self, done: int) -> int | None:
        """Return which try the next iteration belongs to; None after the opening.

        Args:
            done: number of iterations that are done.
        """
        return done // self.opening.each if self.opening and done < self.tried else None

    def starts_over(self, done: int) -> bool:
        """Whether the next iteration starts from other parameters than the last left.

        Args:
            done: number of iterations that are done.
        """
        if self.opening is None or done > self.tried:
            return False
        return done % self.opening.each == 0

    def resets_moments(self, objectives: Sequence[float]) -> bool:
        """Whether the next iteration's gradient is of another kind than all before.

        Args:
            objectives: of the iterations that are done.
        """
        second = self.follow == "second_half"
        return second and self._last(objectives) == len(objectives)

    def followed(self, rollout: Rollout, objectives: Sequence[float]) -> Rollout:
        """Return the rollout whose gradient the next update follows.

        Args:
            rollout: of the attack.
            objectives: of the iterations that are done.
        """
        done = len(objectives)
        # Whether the images of this iteration follow the state, or stop there (A.12)
        if self.follow == "in_turns":
            attached = done > self.tried and (done - self.tried) % 2 == 1
        else:
            attached = self.follow == "always" or self._last(objectives) is not None
        rollout = replace(rollout, attached=rollout.attached and attached)
        index = self.try_index(done)
        if self.opening is None or index is None:
            return rollout
        return self.opening.rollout(rollout, index)

    def gradient_scale(self, gradients: Sequence[np.ndarray]) -> float:
        """Return what gradients are divided by before Adam takes them.

        In turns, it is their root mean square: attached and detached ones differ in
        size, which Adam evens out over many iterations only. Else 1.
        """
        if self.follow != "in_turns":
            return 1.0
        flat = np.concatenate([value.ravel() for value in gradients])
        return float(np.sqrt(np.mean(flat**2))) or 1.0

    def rate(self, objectives: Sequence[float]) -> float:
        """Return the share of the learning rates, see :meth:`Schedule.rate`."""
        last = self._last(objectives)
        if last is None:
            return 1.0
        return self._schedule(last).rate(_part(objectives, last))

    def is_over(self, objectives: Sequence[float]) -> bool:
        """Whether to stop, see :meth:`Schedule.is_over`."""
        last = self._last(objectives)
        if last is None:
            return False
        return self._schedule(last).is_over(_part(objectives, last))

    def has_converged(self, objectives: Sequence[float]) -> bool:
        """Whether nothing was left to gain, see :meth:`Schedule.has_converged`."""
        last = self._last(objectives)
        if last is None:
            return False
        return self._schedule(last).has_converged(_part(objectives, last))

    def steady(self, objectives: Sequence[float]) -> list[range]:
        """Return the iterations that were to gain something, at the full rates.

        After the opening; of a part that settled, without its last fifth.

        Args:
            objectives: of the iterations that are done.
        """
        last, done = self._last(objectives), len(objectives)
        # Iterations before the last part; none unless `follow` is "second_half"
        ends = [(self.tried, done if last is None else last, last is not None)]
        if last is not None:
            # The last part, up to the iteration in which its rates begin to fall
            schedule, part = self._schedule(last), _part(objectives, last)
            settled = schedule.has_converged(part)
            ends.append((last, last + schedule.full(part), settled))
        # The last fifth of a part that settled was to gain nothing, so it is left out
        ranges = []
        for start, end, settled in ends:
            cut = settled and has_settled(_part(objectives[:end], start))
            ranges.append(range(start, end - (end - start) // 5 * cut))
        return ranges

    def least_gain(
        self,
        objectives: Sequence[float],
        predicted: Sequence[float],
        gains: np.ndarray,
    ) -> dict[str, Any] | None:
        """Find five iterations in a row that gave the least of the predicted gain.

        Of those that add up to a predicted fall of the objective.

        Args:
            objectives: of all iterations.
            predicted: gain by the gradient, of each.
            gains: real ones, (n,).

        Returns:
            see `AbstractAttack.least_gain`.
        """
        windows = [
            {
                "first": start,
                "predicted": sum(predicted[start : start + _WINDOW]),
                "gain": float(gains[start : start + _WINDOW].sum()),
            }
            for part in self.steady(objectives)
            for start in range(part.start, part.stop - _WINDOW + 1)
        ]
        falling = [window for window in windows if window["predicted"] > 0]
        return min(falling, key=lambda w: w["gain"] / w["predicted"], default=None)

    def _last(self, objectives: Sequence[float]) -> int | None:
        """Return where the part whose rates fall begins; None before."""
        done = len(objectives)
        turn = self.tried
        if self.follow == "second_half":
            # The first half ends where the attack settles, or after `half` iterations
            half = self.schedule.max_iterations // 2
            first = _part(objectives[: turn + half], turn)
            settled = np.flatnonzero(_settled_after(first))
            turn += int(settled[0]) if len(settled) else half
        return turn if done >= turn else None

    def _schedule(self, last: int) -> Schedule:
        """Return the schedule of the part that begins there."""
        left = self.schedule.max_iterations - (last - self.tried)
        return Schedule(left, self.schedule.final_rate)


def _part(objectives: Sequence[float], start: int) -> Sequence[float]:
    """Return the objectives from an iteration on, as a schedule looks at them.

    They are the least so far, and the first of them is the attack's very first, so
    that what earlier parts gained counts as gain.
    """
    if len(objectives) <= start:
        return []
    least = np.minimum.accumulate(objectives)
    return [float(objectives[0]), *least[start + 1 :].tolist()]
