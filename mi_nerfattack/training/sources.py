"""From which states driving frames are taken."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.vehicle import Controls
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.ranges import Share, checked
from mi_nerfattack.vehicle.expert import AbstractExpert
from mi_nerfattack.vehicle.route.route import Route


class Labelled(NamedTuple):
    """A frame of a drive.

    Args:
        image: (height, width, 3), uint8 sRGB.
        control: the expert's, in the unit of the vehicle; (k,) of k > 1 controls.
        pose: (3,) of the vehicle, x and y in metres, heading in radians.
        step: control periods since the drive began; 0 begins another drive.
    """

    image: np.ndarray
    control: float | np.ndarray
    pose: np.ndarray
    step: int


@dataclass(frozen=True, eq=False)
class Scenery:
    """Where one group of frames is taken.

    Args:
        environment: dressed.
        route: to follow.
        expert: of the route and the environment's vehicle.
        poses: (n, 3), around one point of the route.
        rng: source of all draws.
    """

    environment: AbstractEnvironment
    route: Route
    expert: AbstractExpert
    poses: np.ndarray
    rng: np.random.Generator

    def reset(self, pose: np.ndarray) -> np.ndarray:
        """Put the vehicle at a pose and return the image."""
        seed = int(self.rng.integers(2**31))
        return self.environment.reset(self.route, pose, seed).image

    def drive(
        self,
        control: Callable[[np.ndarray], Controls],
        horizon: int,
        expert_share: float = 0.0,
    ) -> Iterator[Labelled]:
        """Drive from the first pose, until the horizon or the vehicle has strayed.

        Args:
            control: called with images (height, width, 3) uint8 of the periods in which
                the expert does not drive, one after the other.
            horizon: control periods, each a frame.
            expert_share: probability of a period in which the expert drives.
        """
        yield (frame := self.label(self.reset(self.poses[0]), 0))
        for step in range(1, horizon):
            held = frame.control
            if self.rng.uniform() >= expert_share:
                held = control(frame.image)
            image = self.environment.step(held).image
            if self.strayed:
                return
            yield (frame := self.label(image, step))

    def label(self, image: np.ndarray, step: int) -> Labelled:
        """Add the vehicle's pose and the expert's control to the image of a step."""
        state = self.environment.state
        controls = self.expert.control(state)
        control = float(controls[0]) if controls.ndim == 1 else controls[0]
        return Labelled(image, control, np.array(state[:3], np.float64), step=step)

    @property
    def strayed(self) -> bool:
        """Whether the vehicle is so far off that its frames teach nothing.

        More than 0.6 lane widths off the route, or more than 2 m after its end.
        """
        arc, error, _ = self.route.project_numpy(self.environment.state[:3])
        past = not self.route.closed and arc[0] > self.route.length + 2
        return bool(abs(error[0]) > 0.6 * self.route.lane_width_m or past)


class AbstractSource(ABC):
    """Way to come to states; picklable."""

    kind: ClassVar[str]

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return all that decides about the states, as JSON."""

    @abstractmethod
    def prepare(self) -> Any:
        """Load what is needed, once for each process."""

    @abstractmethod
    def frames(self, prepared: Any, scenery: Scenery) -> Iterator[Labelled]:
        """Take one group of frames, of any number."""


@dataclass(frozen=True)
class Scattered(AbstractSource):
    """All poses of a group, each seen at once: the widest spread of states."""

    kind: ClassVar[str] = "scattered"

    def describe(self) -> dict[str, Any]:
        """Return the kind."""
        return {"kind": self.kind}

    def prepare(self) -> None:
        """Load nothing."""

    def frames(self, prepared: None, scenery: Scenery) -> Iterator[Labelled]:
        """See and label the poses."""
        for pose in scenery.poses:
            yield scenery.label(scenery.reset(pose), 0)


@dataclass(frozen=True)
class ExpertDrives(AbstractSource):
    """The expert drives from the first pose of a group: recoveries.

    Args:
        horizon: control periods of a drive, each a frame.
    """

    horizon: int = 8
    kind: ClassVar[str] = "expert"

    def describe(self) -> dict[str, Any]:
        """Return kind and horizon."""
        return {"kind": self.kind, **asdict(self)}

    def prepare(self) -> None:
        """Load nothing."""

    def frames(self, prepared: None, scenery: Scenery) -> Iterator[Labelled]:
        """Drive."""
        yield (frame := scenery.label(scenery.reset(scenery.poses[0]), 0))
        for step in range(1, self.horizon):
            image = scenery.environment.step(frame.control).image
            if scenery.strayed:
                return
            yield (frame := scenery.label(image, step))


@dataclass(frozen=True)
@checked()
class PolicyDrives(AbstractSource):
    """A policy drives from the first pose of a group, the expert labels (DAgger).

    Args:
        weights: safetensors of a PilotNet.
        horizon: control periods of a drive, each a frame.
        expert_share: probability of a period in which the expert drives (beta).

    Source: Ross et al. 2011.
    """

    weights: Path
    horizon: int = 16
    expert_share: Share = 0.0
    kind: ClassVar[str] = "policy"

    def describe(self) -> dict[str, Any]:
        """Return numbers and the weights' checksum."""
        return {
            "kind": self.kind,
            "weights": files.sha256(self.weights),
            "horizon": self.horizon,
            "expert_share": self.expert_share,
        }

    def prepare(self) -> PilotNet:
        """Load the policy."""
        return PilotNet.load(self.weights)

    def frames(self, prepared: PilotNet, scenery: Scenery) -> Iterator[Labelled]:
        """Drive until the horizon, or until the vehicle has strayed."""
        goal = scenery.route.goal
        yield from scenery.drive(
            lambda image: steer(prepared, image, goal), self.horizon, self.expert_share
        )


@dataclass(frozen=True)
class Mixture(AbstractSource):
    """Several sources that take turns by chance.

    Args:
        sources: at least one.
        shares: of the groups, positive, one a source.
    """

    sources: tuple[AbstractSource, ...]
    shares: tuple[float, ...]
    kind: ClassVar[str] = "mixture"

    def __post_init__(self) -> None:
        if len(self.sources) != len(self.shares) or not min(self.shares, default=0) > 0:
            raise InputError(
                f"Mixture: {len(self.sources)} sources, shares {self.shares}; one "
                "positive share a source"
            )

    def describe(self) -> dict[str, Any]:
        """Return all parts."""
        descriptions = [source.describe() for source in self.sources]
        return {"kind": self.kind, "sources": descriptions, "shares": list(self.shares)}

    def prepare(self) -> list[Any]:
        """Prepare all parts."""
        return [source.prepare() for source in self.sources]

    def frames(self, prepared: list[Any], scenery: Scenery) -> Iterator[Labelled]:
        """Let one of the sources take the group."""
        shares = np.array(self.shares) / sum(self.shares)
        index = int(scenery.rng.choice(len(shares), p=shares))
        yield from self.sources[index].frames(prepared[index], scenery)


@torch.no_grad()
def steer(module: PilotNet, image: np.ndarray, goal: int) -> float:
    """Return a policy's control for one image (height, width, 3) uint8 sRGB."""
    batch = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
    return float(module(batch.float() / 255, torch.tensor([goal]))[0])
