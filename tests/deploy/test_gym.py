"""Gymnasium's checker, repeated drives, rewards and ends of episodes."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers.blank_view import blank_environment
from helpers.recorded_drives import write_folder
from helpers.tiny_place import write_place

from mi_nerfattack.deploy.gym import FAR_M, DrivingEnv, make_gym
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import ENVIRONMENTS
from mi_nerfattack.errors import InputError
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
        f"mi_nerfattack/{name}-v0",
        place=place,
        conditions=SPP,
        render_mode="rgb_array",
    )
    check_env(environment.unwrapped)
    image = environment.unwrapped.environment.camera
    environment.reset(seed=1)
    assert environment.render().shape == (image.height, image.width, 3)
    environment.close()


@pytest.mark.parametrize("name", SIMULATED)
def test_two_copies_with_one_seed_give_equal_steps(name, place):
    copies = [make_gym(name, place, SPP, max_steps=1000) for _ in range(2)]
    observed = [copy.reset(seed=5, options={"route": "bend"}) for copy in copies]
    controls = np.random.default_rng(2).uniform(-0.4, 0.4, (20, 1))
    for control in controls:
        for key, value in observed[0][0].items():
            assert np.array_equal(value, observed[1][0][key]), key
        assert np.array_equal(observed[0][-1]["state"], observed[1][-1]["state"])
        observed = [copy.step(control.astype(np.float32)) for copy in copies]
        assert observed[0][1:4] == observed[1][1:4]
    assert observed[0][0]["image"].std() > 3


def test_every_environment_is_registered():
    for name in ENVIRONMENTS:
        assert f"mi_nerfattack/{name}-v0" in gymnasium.registry


def test_reward_is_the_distance_from_the_lanes_centre():
    driving = blind()
    driving.reset(seed=0, options={"pose": (2.0, 0.3, 0.0)})
    observation, reward, terminated, truncated, info = driving.step(np.zeros(1))
    assert reward == pytest.approx(-0.3, abs=1e-6)
    assert info["arc_length_m"] == pytest.approx(2.5, abs=1e-6)
    assert not terminated and not truncated
    assert (observation["depth"] == FAR_M).all()
    assert observation["goal"] == 1
    assert driving.observation_space.contains(observation)
    observation["camera_to_world"][:2, 3] = 5e5, 5.4e6  # as on a map
    assert driving.observation_space.contains(observation)


def test_action_is_a_share_of_the_largest_control():
    driving = blind()
    driving.reset(seed=0)
    driving.step(np.array([-0.5], np.float32))
    # the largest of the car is 1.5 rad/s, held for 0.1 s
    assert driving.environment.state[2] == pytest.approx(-0.075, rel=1e-3)


@pytest.mark.parametrize(("offset", "is_out"), [(0.99, False), (1.01, True)])
def test_episode_ends_where_the_side_of_the_car_passes_the_border(offset, is_out):
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


def test_closed_route_has_no_end():
    driving = blind(closed=True)
    driving.reset(seed=0, options={"pose": (0.4, 0.4, -2.4)})
    assert not driving.step(np.zeros(1))[3]


def test_a_lane_that_is_no_wider_than_the_car_is_refused(tmp_path):
    narrow, wide = (Route(str(w), 0, LINE, lane_width_m=w) for w in (0.6, 3.5))
    message = r"route '0.6': its lane is 0.6 m wide, the vehicle 1.8 m; give the vehi"
    with pytest.raises(InputError, match=message):
        DrivingEnv(blank_environment(), [wide, narrow])
    with pytest.raises(InputError, match="the vehicle 0.0 m"):
        DrivingEnv(blank_environment(), [wide], width=0.0)
    driving = DrivingEnv(blank_environment(), [narrow], width=0.3)
    driving.reset(seed=0)
    assert not driving.step(np.zeros(1))[2]


def test_images_of_a_recording_are_not_resized(place):
    own = make_gym("replay", place)
    camera = own.environment.camera
    own.close()
    with pytest.raises(InputError, match="size_px: 5 x 4 px; environment 'replay' has"):
        make_gym("replay", place, size_px=(5, 4))
    make_gym("replay", place, size_px=(camera.width, camera.height)).close()


def test_a_refused_reset_leaves_the_episode_as_it_was():
    ahead, aside = (Route(str(i), i, LINE + [0, 9 * i]) for i in range(2))
    driving = DrivingEnv(blank_environment(), [ahead, aside])
    driving.reset(seed=0, options={"route": "0"})
    with pytest.raises(InputError, match="pose: .*three finite numbers"):
        driving.reset(options={"route": "1", "pose": (0.0, np.nan, 0.0)})
    observation, reward, *_ = driving.step(np.zeros(1))
    assert (observation["goal"], reward) == (0, 0)


def test_observations_of_the_farthest_pose_lie_in_their_space():
    driving = blind()
    observation, _ = driving.reset(seed=0, options={"pose": (-1e9, 1e9, 3.0)})
    assert driving.observation_space.contains(observation)
    with pytest.raises(InputError, match=r"pose: \[1e\+20, .*at most 1e\+09"):
        driving.reset(options={"pose": (1e20, 0.0, 0.0)})


def test_a_closed_environment_is_over():
    driving = blind()
    driving.reset(seed=0)
    driving.close()
    for call in (driving.reset, lambda: driving.step(np.zeros(1))):
        with pytest.raises(InputError, match="it is closed; make another"):
            call()


@pytest.mark.parametrize("action", ["left", "0.5", None, [True], {}, [[1], [2, 3]], 1j])
def test_actions_that_are_no_numbers(action):
    driving = blind()
    driving.reset(seed=0)
    with pytest.raises(InputError, match="action: "):
        driving.step(action)
    assert driving.step(10**2)[1] <= 0  # beyond the largest it saturates


def test_bad_input(tmp_path):
    driving = blind()
    with pytest.raises(InputError, match="routes: none; at least one"):
        DrivingEnv(blank_environment(), [])
    with pytest.raises(InputError, match="max_steps: 0; at least 1"):
        blind(max_steps=0)
    for margin in (float("nan"), -1.0, float("inf")):
        with pytest.raises(InputError, match=f"margin_m: {margin}; a finite length"):
            blind(margin_m=margin)
    with pytest.raises(InputError, match="render_mode: 'human'; 'rgb_array' or None"):
        blind(render_mode="human")
    with pytest.raises(InputError, match="options.route: 'left'; one of 'line'"):
        driving.reset(options={"route": "left"})
    with pytest.raises(InputError, match="options: speed; 'route', 'pose'"):
        driving.reset(options={"speed": 3})
    driving.reset(seed=0)
    with pytest.raises(InputError, match=r"action: shape \(2,\); one control"):
        driving.step(np.zeros(2))
    with pytest.raises(InputError, match="control: nan; a policy must return finite"):
        driving.step(np.array([np.nan]))
    with pytest.raises(InputError, match="camera.width: 0; must be positive"):
        make_gym("surrogate", write_place(tmp_path), size_px=(0, 4))
