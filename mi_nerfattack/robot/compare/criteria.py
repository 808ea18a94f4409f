"""Criteria of success, written before the first drive."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict_toml import parse_toml
from mi_nerfattack.ranges import NonNegative
from mi_nerfattack.robot.compare.sequential import SequentialTest
from mi_nerfattack.scenario.lines import tell
from mi_nerfattack.scenario.section import Section, problems, refuse

#: What an object can show to a real car.
Case = Literal["no_object", "own", "random", "attack"]
_MEAN = "cross_track_mean_m"


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
        how = "at least" if least else "at most"
        return f"{self.case}: {self.metric} of {how} {limit:g}"


@dataclass(frozen=True)
class WrittenCriteria:
    """Criteria and where they are from.

    Attributes:
        path: the file.
        criteria: what it says.
        sha256: of its content, comments included.
        written: when it was last changed, seconds since 1970.
    """

    path: Path
    criteria: Criteria
    sha256: str
    written: float


def read_criteria(path: Path) -> WrittenCriteria:
    """Read criteria.

    Raises:
        InputError: the file cannot be read, is no TOML, or a key is unknown, missing,
            of the wrong type or out of range; with file and line.
    """
    text = files.read_text(path, files.MAX_TOML_BYTES)
    try:
        criteria = Criteria.model_validate(parse_toml(path, text))
    except ValidationError as err:
        raise InputError(tell(path, text, problems(err))) from err
    digest = hashlib.sha256(text.encode()).hexdigest()
    return WrittenCriteria(path, criteria, digest, path.stat().st_mtime)
