"""Gymnasium's checker, repeated drives, rewards and ends of episodes."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from support.faults.refusals import refusals
from support.files.recordings import write_folder
from support.worlds.places import blank_environment, write_place

from mi_nerfattack.deploy.environment import policy_image
from mi_nerfattack.deploy.gym import FAR_M, DrivingEnv, make_gym
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

SIMULATED = ("surrogate", "mitsuba", "mujoco", "mujoco_gl")
LINE = np.array([[0.0, 0.0], [30.0, 0.0]])
SPP = Conditions(spp=2)


@pytest.fixture
def place(request, tmp_path) -> Place:
    """A place with a recording, where there is OpenGL if MuJoCo's is asked for."""
    if "mujoco_gl" in request.node.name:
        request.getfixturevalue("gl")
    return replace(write_place(tmp_path), recording=write_folder(tmp_path / "drive"))


def blind(closed: bool = False, **options) -> DrivingEnv:
    points = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]) if closed else LINE
    route = Route("line", 1, points, 3.8, 5.0, closed)
    return DrivingEnv(blank_environment(), [route], **options)


@pytest.mark.parametrize("name", [*SIMULATED, "replay"])
def test_gymnasiums_checker_passes(name, place):
    environment = gymnasium.make(
        f"mi_nerfattack/{name}-v0", place=place, conditions=SPP, render_mode="rgb_array"
    )
    check_env(environment.unwrapped)
    image = environment.unwrapped.environment.camera
    environment.reset(seed=1)
    assert environment.render().shape == (image.height, image.width, 3)
    environment.close()
    with pytest.raises(InputError, match="it is closed"):
        environment.reset()


def test_reward_falls_from_the_lanes_centre_to_its_border():
    driving = blind()
    driving.reset(seed=0, options={"pose": (2.0, 0.3, 0.0)})
    observation, reward, terminated, truncated, info = driving.step(np.zeros(1))
    assert reward == pytest.approx(0.7, abs=1e-6)  # 1 m is left on either side
    assert info["arc_length_m"] == pytest.approx(2.5, abs=1e-6)
    assert not terminated and not truncated
    assert (observation["depth"] == FAR_M).all()
    assert observation["goal"] == 1
    assert driving.observation_space.contains(observation)
    far, _ = driving.reset(seed=0, options={"pose": (-1e9, 1e9, 3.0)})
    assert driving.observation_space.contains(far)
    driving.reset(seed=0)
    driving.step(np.array([-0.5], np.float32))
    # a share of the largest control, of the car 1.5 rad/s, held for 0.1 s
    assert driving.environment.state[2] == pytest.approx(-0.075, rel=1e-3)
    driving.step(10**2)  # beyond the largest it saturates
    assert driving.environment.state[2] == pytest.approx(0.075, rel=1e-3)
    driving.reset(seed=0, options={"pose": (2.0, 1.2, 0.0)})
    assert driving.step(np.zeros(1))[1:3] == (0.0, True)  # never below


@pytest.mark.parametrize(("offset", "is_out"), [(0.99, False), (1.01, True)])
def test_episode_ends_where_the_side_of_the_car_passes_the_border(offset, is_out):
    narrow = DrivingEnv(blank_environment(), [NARROW], width=0.3)
    narrow.reset(seed=0)
    assert not narrow.step(np.zeros(1))[2]
    driving = blind()  # (3.8 m - 1.8 m) / 2
    driving.reset(seed=0, options={"pose": (2.0, -offset, 0.0)})
    assert driving.step(np.zeros(1))[2:4] == (is_out, False)


def test_episode_is_cut_at_the_routes_end_and_after_the_most_steps():
    driving = blind()
    driving.reset(seed=0, options={"pose": (27.4, 0.0, 0.0)})
    assert driving.step(np.zeros(1))[2:4] == (False, False)
    assert driving.step(np.zeros(1))[2:4] == (False, True)  # 28.4 m of 30 m
    short = blind(max_steps=2)
    short.reset(seed=0)
    assert [short.step(np.zeros(1))[3] for _ in range(2)] == [False, True]
    loop = blind(closed=True)
    loop.reset(seed=0, options={"pose": (0.4, 0.4, -2.4)})
    assert not loop.step(np.zeros(1))[3]


def test_a_recording_ends_and_keeps_its_size(place):
    driving = make_gym("replay", place)
    driving.reset(seed=0)
    ends = [driving.step(np.zeros(1, np.float32))[3] for _ in range(5)]
    assert ends == [False, False, False, False, True]
    camera = driving.environment.camera
    make_gym("replay", place, size_px=(camera.width, camera.height)).close()
    with pytest.raises(InputError, match="size_px: 5 x 4 px; .*'replay'"):
        make_gym("replay", place, size_px=(5, 4))


def test_a_refused_reset_leaves_the_episode_as_it_was():
    ahead, aside = (Route(str(i), i, LINE + [0, 9 * i]) for i in range(2))
    driving = DrivingEnv(blank_environment(), [ahead, aside])
    driving.reset(seed=0, options={"route": "0"})
    with pytest.raises(InputError, match="pose: "):
        driving.reset(options={"route": "1", "pose": (0.0, np.nan, 0.0)})
    observation, reward, *_ = driving.step(np.zeros(1))
    assert (observation["goal"], reward) == (0, 1)


NARROW, WIDE = (Route(str(width), 0, LINE, width) for width in (0.6, 3.5))


def made(*routes, **options):
    return lambda: DrivingEnv(blank_environment(), routes, **options)


def reset(**options):
    return lambda: blind().reset(options=options)


def step(action):
    def drive():
        driving = blind()
        driving.reset(seed=0)
        driving.step(action)

    return drive


NO_NUMBERS = ["left", "0.5", None, [True], {}, [[1], [2, 3]], 1j]
test_what_cannot_be_driven_is_refused = refusals(
    (made(), "routes: none"),
    (made(WIDE, NARROW), "route '0.6': .* 0.6 m wide, the vehicle 1.8 m"),
    (made(WIDE, max_steps=0), "max_steps: 0"),
    (made(WIDE, margin_m=float("nan")), "margin_m: nan"),
    (made(WIDE, render_mode="human"), "render_mode: 'human'; 'rgb_array'"),
    (reset(route="left"), "options.route: 'left'; one of 'line'"),
    (reset(speed=3), "options: speed; 'route', 'pose'"),
    (reset(pose=(1e20, 0.0, 0.0)), r"pose: \[1e\+20, .*1e\+09"),
    *((step(action), "action: ") for action in NO_NUMBERS),
    (step(np.zeros(2)), r"action: shape \(2,\)"),
)


@pytest.mark.slow
def test_the_bundled_policy_earns_more_than_crashing():
    """On the right turn, from its start to its end."""
    scenario, _ = load_scenario(bundled("base.toml"))
    policy = scenario.build_policy()

    def episode(steer):
        driving = make_gym("surrogate", routes=["right"])
        observation, _ = driving.reset(seed=0)
        total, ended = 0.0, False
        while not ended:
            action = np.array([steer(observation) / driving.environment.max_control])
            observation, reward, left, over, _ = driving.step(action)
            total, ended = total + reward, left or over
        driving.close()
        return total

    def steered(observation):
        image, goal = policy_image(observation["image"]), int(observation["goal"])
        row, _ = policy.step(image, goal, policy.initial_memory(1))
        return float(np.array(row)[0])

    driven, straight, lock = map(episode, (steered, lambda _: 0.0, lambda _: 9.0))
    assert driven > 2 * straight > 2 * lock > 0
