"""Attached derivatives of the bundled scenario against central differences.

Its field has dense matter beside empty cells: where derivatives by the camera go wrong.
Differences are small, because one ray a pixel sees another point after a milliradian.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import World, build_world
from mi_nerfattack.scenes import bundled

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

HEADING = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def world(variant: str, monkeypatch: pytest.MonkeyPatch) -> World:
    """The bundled scenario, with samples in the middle of their intervals.

    With more rays than one a pixel, one of them jumps over an edge at these poses.
    """
    monkeypatch.setattr("mi_nerfattack.scenario.world.SMOOTH_SPP", 1)
    scenario, _ = load_scenario(bundled("base.toml"))
    attack = scenario.attack.model_copy(update={"jitter": False, "attached": True})
    scene = scenario.scene.model_copy(update={"spp": 1})
    scenario = scenario.model_copy(update={"attack": attack, "scene": scene})
    return build_world(scenario, scenario.policy.build())


def to_the_left(pose: np.ndarray) -> np.ndarray:
    return np.array([-np.sin(pose[2]), np.cos(pose[2]), 0.0])


def test_one_frame(world: World) -> None:
    """A smooth function of eight frames' pixels, all poses in one launch."""
    sensor, loop = world.surrogate, world.loop(world.surrogate)
    rng = np.random.default_rng(0)
    shifts = rng.uniform(0, 25, 8), rng.normal(0, 0.3, 8), rng.normal(0, 0.05, 8)
    poses = world.route.pose_at(*shifts)
    width, height = sensor.camera.size
    y, x = np.mgrid[0:height, 0:width]
    rows = [
        np.cos(3 * x / width + c) * np.sin(2 * y / height + 1 + c) for c in range(3)
    ]
    weight = np.stack(rows, -1).astype(np.float32)

    def values(poses: np.ndarray) -> np.ndarray:
        image = sensor.observe(loop.initial(poses), 0).image
        return (np.array(image, np.float64) * weight).sum((1, 2, 3))

    state = loop.initial(poses)
    observation = sensor.observe(state, 0)
    sensor.start_gradient()
    d_image = mi.TensorXf(np.repeat(weight[None], len(poses), 0))
    gradient = (
        np.array(sensor.vjp(observation, state, d_image, True))
        .reshape(-1, len(poses))
        .T
    )
    for name, direction in (
        ("heading", np.repeat(HEADING[None], len(poses), 0)),
        ("lateral", np.array([to_the_left(pose) for pose in poses])),
    ):
        by_pose = (gradient[:, :3] * direction).sum(1)
        # the slope of many small differences: single precision rounds points to a
        # twentieth of what one of them moves, and larger ones bend
        steps = np.arange(1, 17) / 16 * (5e-6 if name == "heading" else 1e-4)
        ends = [
            values(poses + s * direction) - values(poses - s * direction) for s in steps
        ]
        expected = steps @ np.array(ends) / (2 * (steps**2).sum())
        error = np.linalg.norm(by_pose - expected) / np.linalg.norm(expected)
        assert error < 0.03, (name, by_pose, expected)


def test_the_loop(world: World) -> None:
    """Five periods from the scenario's initial poses, in five directions."""
    # steps of eight bits have no finite differences
    loop = replace(world.loop(world.surrogate), eight_bit=False)
    poses = world.initial
    rollout = Rollout(loop, world.objective, 5, attached=True)
    gradient = rollout.gradient(rollout.run(loop.initial(poses)))
    by_state = np.array(gradient.initial).T[:, :3]

    def difference(direction: np.ndarray, h: float) -> float:
        ends = [poses + s * direction for s in (h, -h)]
        high, low = (float(rollout.run(loop.initial(end)).value) for end in ends)
        return (high - low) / (2 * h)

    heading = np.repeat(HEADING[None], len(poses), 0)
    lateral = np.array([to_the_left(pose) for pose in poses])
    for direction, h in ((heading, 1e-5), (lateral, 1e-4)):
        expected = difference(direction, h)
        assert (by_state * direction).sum() == pytest.approx(expected, rel=0.05)

    (original,) = [np.array(texture) for texture in world.surrogate.textures()]
    (by_texture,) = [np.array(texture) for texture in gradient.textures]
    for seed in range(3):
        # all of one sign: what others come to drowns in single precision
        along = np.abs(np.random.default_rng(seed).normal(size=original.shape))
        along *= np.sign(by_texture)
        values = []
        for h in (1e-2, -1e-2):
            world.set_textures([(original + h * along).astype(np.float32)])
            values.append(float(rollout.run(loop.initial(poses)).value))
        expected = (values[0] - values[1]) / 2e-2
        assert (by_texture * along).sum() == pytest.approx(expected, rel=0.05)
