"""The newest pose of each body that a tracker sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_nerfattack.car.devices import TrackedPose

REPEATS = 3  # frames in which a pose may repeat bit for bit
MOST_BODIES = 256  # that are kept


@dataclass
class _Body:
    pose: TrackedPose
    repeats: int


class NewestPoses:
    """The newest pose of each body by its name.

    A pose that repeats bit for bit in more than `REPEATS` frames is that of a body that
    the tracker has lost, since measurements jitter: its time stays that of the last
    frame that counted.
    """

    def __init__(self) -> None:
        self._bodies: dict[str, _Body] = {}

    def update(self, name: str, matrix: np.ndarray, time_s: float, index: int) -> bool:
        """Take what a frame says of a body; the second time in one frame not.

        Args:
            name: of the body.
            matrix: (4, 4), body to world, metres; not copied, read-only from here on.
            time_s: of the frame.
            index: of the frame.

        Returns:
            Whether it is the newest pose now.
        """
        known, repeats = self._bodies.get(name), 0
        if known is None:
            if len(self._bodies) >= MOST_BODIES:
                return False
        elif known.pose.index == index:
            return False
        elif np.array_equal(known.pose.body_to_world, matrix):
            repeats = known.repeats + 1
            if repeats > REPEATS:
                known.repeats = repeats
                return False
        matrix.setflags(write=False)
        self._bodies[name] = _Body(TrackedPose(matrix, time_s, index), repeats)
        return True

    def newest(self, name: str) -> TrackedPose | None:
        """Return the newest pose of a body; None before the first."""
        known = self._bodies.get(name)
        return None if known is None else known.pose

    def explain(self, name: str, index: int, remedy: str) -> str:
        """Say why no new pose of a body comes.

        Args:
            name: of the body.
            index: of the newest frame.
            remedy: what to do about a body that never came.
        """
        known = self._bodies.get(name)
        if known is None:
            names = ", ".join(sorted(self._bodies)) or "no body"
            return f"it has seen {names}, not {name!r}: {remedy}"
        if known.repeats > REPEATS:
            return (
                f"{name!r} repeats bit for bit, as what is lost from view: are enough "
                "markers seen?"
            )
        return f"{name!r} was last in frame {known.pose.index} of {index}"
