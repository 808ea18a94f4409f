"""How far objects can move a policy's control, whatever they look like.

An attack seeks one texture for all frames of a drive. Here, each pixel of each frame
may have any value that a colour of the object gives in it, whatever the other pixels
and frames have. So no texture moves the control of a frame farther. The search among
these values is a local one with exact derivatives: what it finds may be a little less.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.attack.texture.constraints import MARGIN
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.checks.before_attack import CHANGE
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.ranges import Count, checked
from mi_nerfattack.render.camera.rig import Layout
from mi_nerfattack.rollout.loop import OnStep, simulate
from mi_nerfattack.rollout.sensor import (
    AbstractDifferentiableSensor,
    AbstractSensor,
    Observation,
)
from mi_nerfattack.scenario.world import World, optimised_states
from mi_nerfattack.vehicle.dynamics import controls_as, to_control

#: The drives. In the first one, objects look as they do. In the others, they raise or
#: lower the first control of each frame as far as they can.
DRIVES = ("original", "up", "down")

# Of each search in a frame: the drive whose frame it is, and what it does there
_FRAMES, _SIGNS = np.array([0, 0, 1, 2]), np.array([1, -1, 1, -1])


@dataclass(frozen=True)
@checked("PixelSearch")
class PixelSearch:
    """Projected ascent of the first control in the pixels of images.

    A step goes along the signs of the gradient, by a share of each pixel's range. The
    first share is 1, so that one step ends at the maximum of a linear policy.

    Args:
        starts: the image itself, then images drawn evenly from the ranges.
        steps: of each start.
        last: share of the last step.
        seed: of the draws.
    """

    starts: Count = 1
    steps: Count = 16
    last: float = 0.05
    seed: int = 0

    def run(
        self,
        policy: AbstractPolicy,
        goal: int,
        image: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        cotangent: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the images with the most that a search finds, and this most.

        Args:
            policy: takes images alone, and has no memory.
            goal: its goal.
            image: (n, height, width, 3), sRGB in [0, 1].
            limits: the least and the largest values of each pixel, of this shape.
            cotangent: (n, k), weights of the controls in what is raised.

        Returns:
            (n, height, width, 3) float32, and (n,) in the units of the controls.
        """
        low, high = limits
        random, span = np.random.default_rng(self.seed), high - low
        shares = np.geomspace(1, self.last, self.steps)
        best, most = image.copy(), np.full(len(image), -np.inf)
        starts = self.starts
        if span.max() < 1 / 255:  # nothing that eight bits show
            starts, shares = 1, shares[:0]
        for start in range(starts):
            now = image if start == 0 else low + span * random.random(image.shape)
            for share in (*shares, 0):  # after the last step, its image is judged
                tensor = mi.TensorXf(np.ascontiguousarray(now, np.float32))
                weight = controls_as(dr.array_t(tensor), to_control(cotangent))
                control, slope = policy.vjp(tensor, goal, weight)
                controls = np.array(control).reshape(cotangent.T.shape)
                value = (cotangent.T * controls).sum(0)
                better = value > most
                best[better], most[better] = now[better], value[better]
                now = np.clip(now + share * span * np.sign(slope.numpy()), low, high)
        return best, most


@dataclass
class ReachSensor(AbstractSensor):
    """What a sensor sees in the three of `DRIVES`, with the pixels that a search finds.

    Attributes:
        sensor: sees the objects.
        policy: whose first control is moved.
        goal: of the policy.
        controls: their number.
        search: among the pixels.
        pixels: of each period, how many the objects can change in the original drive.
        limits: of each period, the highest and the lowest control there, (2,).
    """

    sensor: AbstractDifferentiableSensor
    policy: AbstractPolicy
    goal: int
    controls: int
    search: PixelSearch
    pixels: list[int] = field(default_factory=list)
    limits: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._looks = [
            [_of_one_colour(item, colour) for item in self.sensor.fields]
            for colour in (MARGIN, 1 - MARGIN)
        ]
        self._looks.append(self.sensor.textures())

    @property
    def layout(self) -> Layout | None:
        """See :attr:`AbstractSensor.layout`."""
        return self.sensor.layout

    def observe(self, state: Any, step: int) -> Observation:
        """See :meth:`AbstractSensor.observe`."""
        low, high, image = (self._observe(look, state, step) for look in self._looks)
        self.pixels.append(int((abs(high - low)[0].max(-1) >= CHANGE).sum()))
        limits = np.minimum(low, image)[_FRAMES], np.maximum(high, image)[_FRAMES]
        cotangent = np.zeros((len(_SIGNS), self.controls))
        cotangent[:, 0] = _SIGNS
        extremes, most = self.search.run(
            self.policy, self.goal, image[_FRAMES], limits, cotangent
        )
        self.limits.append((_SIGNS * most)[:2])
        return Observation(mi.TensorXf(np.concatenate([image[:1], extremes[2:]])), step)

    def _observe(self, textures: list[Any], state: Any, step: int) -> np.ndarray:
        self.sensor.set_textures(textures)
        return self.sensor.observe(state, step).image.numpy()


def _of_one_colour(item: GridField, colour: float) -> mi.TensorXf:
    """Return the texture (n_vertices, 3) of a field that has one colour everywhere."""
    texture = np.zeros((item.n_vertices, 3), np.float32)
    texture[item.levels()[-1].vertices] = np.log(colour / (1 - colour))
    return mi.TensorXf(texture)


@dataclass(frozen=True)
class Reach:
    """How far objects move the first control.

    Attributes:
        pixels: (T,), those that the objects can change in a frame of the first drive.
        control: (T,), the first control of that drive.
        limits: (2, T), the highest and the lowest one that they can cause there.
        cross_track_m: (3, T), signed errors of `DRIVES` after each period.
    """

    pixels: np.ndarray
    control: np.ndarray
    limits: np.ndarray
    cross_track_m: np.ndarray

    @property
    def moved(self) -> np.ndarray:
        """How far the control of each frame moves, up or down, (T,)."""
        return abs(self.limits - self.control).max(0)


def measure_reach(
    world: World, search: PixelSearch | None = None, on_step: OnStep | None = None
) -> Reach:
    """Drive from the first start of an attack, as it is and with the worst pixels.

    Args:
        world: whose objects look and stand as they do at present.
        search: among the pixels.
        on_step: called after each control period with its index.

    Raises:
        InputError: the policy has no derivatives, has a memory, or is given more than
            images.
    """
    policy, route, dynamics = world.policy, world.route, world.motion.dynamics
    if not policy.differentiable or policy.numbers or policy.initial_memory(1):
        raise InputError(
            "policy: the reach of objects is searched in the pixels of one frame at a "
            "time; take a policy with derivatives and without memory, which is given "
            "images alone"
        )
    size, search = dynamics.control_size, search or PixelSearch()
    sensor = ReachSensor(world.optimised, policy, route.goal, size, search)
    loop, original = world.loop(sensor), world.appearance()
    start = optimised_states(world.scenario, route)[:1]
    try:
        initial = loop.initial(np.repeat(start, len(DRIVES), 0))
        drive = simulate(loop, initial, world.horizon, on_step=on_step)
    finally:
        world.show(original)
    states = drive.states_numpy()[:, 1:]
    error = route.cross_track_numpy(states.reshape(-1, states.shape[2]))
    control = drive.controls_numpy()[0].reshape(world.horizon, -1)[:, 0]
    pixels, limits = np.array(sensor.pixels), np.stack(sensor.limits, 1)
    return Reach(pixels, control, limits, cross_track_m=error.reshape(len(DRIVES), -1))
