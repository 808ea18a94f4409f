"""A drive before it is driven, and the one list of what decides about it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.deploy.registry import environment_versions
from mi_nerfattack.io.resumable import content_of, flatten

FORMAT = "mi_nerfattack drive 5"


@dataclass(frozen=True, eq=False)
class DriveSpec:
    """One drive before it is driven.

    Args:
        environment: its label in documents.
        route: name.
        case: name of the case, which says what the objects show.
        run: index among the drives of one route, environment and case, from 0.
        seed: of the environment.
        steps: control periods, at most.
        identity: everything that the result of the drive depends on, see `identify`.
        context: what the driver needs besides; not part of the identity.
    """

    environment: str
    route: str
    case: str
    run: int
    seed: int
    steps: int
    identity: Mapping[str, str]
    context: Any = None

    @cached_property
    def digest(self) -> str:
        """Tell the drive from all others."""
        return short_digest(self.identity)


def identify(environment: str | None, decisive: Mapping[str, Any]) -> dict[str, str]:
    """Return the identity of a drive: format, versions, and what else decides.

    Args:
        environment: key of `deploy.registry.ENVIRONMENTS`; None for a surrogate of
            which no package of its own decides.
        decisive: the rest, JSON values by name.
    """
    names = versions()
    if environment is not None:
        names |= environment_versions(environment)
    identity = {"format": FORMAT, **flatten("version", names)}
    for name, value in decisive.items():
        identity[name] = value if isinstance(value, str) else json.dumps(value)
    return identity


def short_digest(identity: Mapping[str, str]) -> str:
    """Return 12 hexadecimal digits that tell one identity from another.

    Files count by their content, whatever they are called.
    """
    contents = {key: content_of(value) for key, value in identity.items()}
    text = json.dumps(contents, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
