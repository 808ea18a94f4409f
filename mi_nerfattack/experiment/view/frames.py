"""Frames of recorded drives, rendered when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager

import matplotlib
import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.experiment.view.run import ViewedRun
from mi_nerfattack.report.plots.heat import COLOUR_MAP
from mi_nerfattack.rollout.drive import NO_OBJECT, OWN, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.vehicle.dynamics import to_state

#: Mean difference of the channels, of 255, from which on a pixel is brightest.
FULL = 128
NOWHERE: Mapping[int, np.ndarray] = {}


class FrameSource:
    """What the policy's camera sees at any time of recorded drives.

    Surrogate: the drive's own sensor at the recorded pose, one march a frame. Others:
    the environment is driven there by the recorded controls, from the same seed; that
    is two of its frames, and its vehicle's steps. Environments stay open until
    :meth:`close`.

    Args:
        viewed: the run.
    """

    def __init__(self, viewed: ViewedRun) -> None:
        self.viewed = viewed
        self._bare = viewed.world.without_objects()
        self._open: dict[tuple[str, str | None], AbstractEnvironment] = {}
        self._stack = ExitStack()

    def see(
        self,
        drive: Drive,
        step: int,
        case: str | None = None,
        moved: Mapping[int, np.ndarray] = NOWHERE,
    ) -> np.ndarray:
        """Render the frame before a control period of a drive.

        Args:
            drive: of T control periods.
            step: from 0 to T, at the drive's end.
            case: whose look the objects have; the drive's own by default.
            moved: offsets (6,) of objects by number, see :meth:`ViewedRun.poses`.

        Returns:
            (height, width, 3), uint8, sRGB.

        Raises:
            InputError: the environment cannot be opened.
        """
        case = case or drive.case
        if case != NO_OBJECT:
            self.viewed.show(case, moved)
        if drive.environment == SURROGATE:
            world = self.viewed.world
            sensor = self._bare if case == NO_OBJECT else world.surrogate
            observation = sensor.observe(to_state(drive.poses[step][None]), step)
            return np.round(255 * np.array(observation.image)[0]).astype(np.uint8)
        with self._environment(drive.environment, case, bool(moved)) as environment:
            route = self.viewed.world.route
            frame = environment.reset(route, drive.poses[0], drive.seed)
            for control in drive.controls[: max(step - 1, 0)]:
                environment.advance(control)
            if step:
                frame = environment.step(drive.controls[step - 1])
            return frame.image

    def difference(
        self,
        drive: Drive,
        step: int,
        image: np.ndarray,
        moved: Mapping[int, np.ndarray],
    ) -> np.ndarray | None:
        """Show where a frame differs from the frame with original textures.

        Args:
            drive: as of :meth:`see`.
            step: as of :meth:`see`.
            image: what :meth:`see` returned.
            moved: as of :meth:`see`.

        Returns:
            (height, width, 3), uint8, in the colours of heat maps; None for drives
            without objects or with original textures.
        """
        if drive.case in (NO_OBJECT, OWN):
            return None
        return heat(image, self.see(drive, step, OWN, moved))

    def close(self) -> None:
        """Close all environments."""
        self._open.clear()
        self._stack.close()

    @contextmanager
    def _environment(
        self, label: str, case: str, moved: bool
    ) -> Iterator[AbstractEnvironment]:
        """Open an environment with what its objects look like at present."""
        world, empty = self.viewed.world, case == NO_OBJECT
        built = world.builds_in(label) and not empty
        if built and moved:
            with closing(world.open(label)) as environment:
                yield environment
            return
        key = label, case if built or empty else None
        if key not in self._open:
            opened = world.open(label, empty)
            self._open[key] = self._stack.enter_context(closing(opened))
        yield self._open[key]


def heat(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Draw how far apart two images are, channels averaged; brightest from `FULL` on.

    Args:
        image: (height, width, 3), uint8.
        other: (height, width, 3), uint8.

    Returns:
        (height, width, 3), uint8.
    """
    apart = np.abs(image.astype(np.float64) - other).mean(-1) / FULL
    mapped = matplotlib.colormaps[COLOUR_MAP](apart.clip(0, 1))
    return np.round(255 * mapped[..., :3]).astype(np.uint8)
