"""Environments, experts and records of a vehicle with steering and acceleration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.faults.refusals import refusals
from support.worlds.places import BlankView, straight

from mi_nerfattack.deploy.car import CAR, Control
from mi_nerfattack.deploy.environment import drive
from mi_nerfattack.deploy.gym import DrivingEnv
from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle
from mi_nerfattack.deploy.simulated import SimulatedEnvironment
from mi_nerfattack.deploy.stress.timing import LateControls
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.drives.table import FURTHER, STEPS, read_csv, write_steps
from mi_nerfattack.evaluation.evaluate import ExpertPolicy
from mi_nerfattack.policy.action import Action
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.rollout.drive import Drive, Lane
from mi_nerfattack.vehicle import DynamicSingleTrack, KinematicSingleTrack
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.expert import SpeedKeeper, expert_for

pytestmark = pytest.mark.usefixtures("variant")

ACCELERATION = Control("acceleration", "m/s^2", -8.0, 3.0)
CAR2 = replace(CAR, control_unit="rad", max_control=0.6, more_controls=(ACCELERATION,))


def kinematic(model=None):
    motion = Motion(model or KinematicSingleTrack(), substeps=4)
    return KinematicVehicle(motion, 0.1, 0.6, "rad", (ACCELERATION,))


def environment(vehicle=None):
    vehicle = vehicle or kinematic()
    view = BlankView()
    rig = Rig.of_one(view.camera, CameraMount())
    return SimulatedEnvironment("blank", vehicle, [view], rig, 0.1)


def test_kinematic_vehicles_brake_and_accelerate():
    vehicle = kinematic()
    vehicle.reset(np.zeros(3), 8.0)
    assert vehicle.control_names == ("steering", "acceleration")
    for _ in range(10):
        vehicle.advance([0.0, -2.0])
    assert vehicle.state[3] == pytest.approx(6.0, rel=1e-3)
    assert vehicle.state[0] == pytest.approx(7.0, rel=1e-3)


def test_the_car_with_wheels_follows_its_acceleration():
    car = MujocoVehicle(CAR2)
    car.reset(np.zeros(3), 4.0)
    for _ in range(20):
        car.advance((0.0, 1.5))
    assert car.state[3] == pytest.approx(7.0, abs=0.35)  # the motor lags
    for _ in range(10):
        car.advance((0.2, 0.0))
    assert car.state[3] == pytest.approx(7.0, abs=0.2)
    assert car.state[5] > 0.3  # it turns to the left
    for _ in range(60):
        car.advance((0.0, -3.0))
    assert abs(car.state[3]) < 0.1  # it stands, and does not reverse
    assert np.isfinite(car.state).all()


def test_without_acceleration_the_car_with_wheels_is_the_one_with_one_control():
    one = MujocoVehicle(replace(CAR2, more_controls=()))
    two = MujocoVehicle(CAR2)
    for car, control in ((one, 0.1), (two, (0.1, 0.0))):
        car.reset(np.zeros(3), 5.0)
        for _ in range(10):
            car.advance(control)
    np.testing.assert_array_equal(one.state, two.state)


def expert(route, period=0.1):
    limits = ACCELERATION.lowest, ACCELERATION.highest
    return expert_for("rad", route, period, 0.6, acceleration=limits)


@pytest.mark.parametrize("kind", ["kinematic", "dynamic", "wheels"])
def test_the_expert_steers_and_keeps_the_speed(kind):
    makers = {
        "kinematic": kinematic,
        "dynamic": lambda: kinematic(DynamicSingleTrack()),
        "wheels": lambda: MujocoVehicle(CAR2),
    }
    vehicle, route = makers[kind](), straight()
    driver = expert(route)
    assert isinstance(driver, SpeedKeeper)
    vehicle.reset(np.array([2.0, 0.8, 0.1]), 2.0)
    for _ in range(70):
        vehicle.advance(driver.control(vehicle.state)[0])
    assert vehicle.state[3] == pytest.approx(route.speed_ms, abs=0.1)
    assert abs(vehicle.state[1]) < 0.05


def test_controls_of_the_expert():
    states = np.array([[0.0, 0, 0, 1.0], [0, 0.5, 0, 5.0], [0, 0, 0, 30.0]])
    controls = expert(straight()).control(states)
    np.testing.assert_allclose(controls[:, 1], [3.0, 0.0, -8.0])
    assert controls[1, 0] < 0 and controls[0, 0] == 0
    poses = expert(straight()).control(states[:, :3])
    np.testing.assert_allclose(poses, np.c_[controls[:, 0], np.zeros(3)])


def test_drives_record_both_controls(tmp_path):
    made = environment()
    driven = drive(
        made,
        ExpertPolicy(made, expert(straight())),
        straight(),
        np.array([0.0, 0.5, 0.0]),
        0,
        12,
    )
    assert driven.controls.shape == (12, 2)
    np.testing.assert_array_equal(driven.first_controls, driven.controls[:, 0])
    path = tmp_path / "steps.csv"
    write_steps(path, [driven], {"straight": Lane(0.8, 1.7)})
    table = read_csv(path, STEPS, FURTHER)
    np.testing.assert_array_equal(table["control"], driven.controls[:, 0])
    np.testing.assert_array_equal(table["control_1"], driven.controls[:, 1])
    assert driven._repr_png_()


def test_late_controls_hold_both():
    late, now = LateControls(environment(), 2), environment()
    for each in (late, now):
        each.reset(straight())
    for control in ((0.1, 1.0), (0.2, 2.0), (0.0, 0.0)):
        late.step(control)
    for control in ((0.0, 0.0), (0.0, 0.0), (0.1, 1.0)):
        now.step(control)
    np.testing.assert_array_equal(late.state, now.state)


def test_actions_of_gymnasium_are_shares_of_the_limits():
    env = DrivingEnv(environment(), [straight()])
    assert env.action_space.shape == (2,)
    taken = []
    env.environment.vehicle.advance = taken.append
    env.reset(seed=1)
    for action in ([0.5, 1.0], [-1.0, -0.5]):
        env.step(np.array(action, np.float32))
    np.testing.assert_allclose(taken, [[0.3, 3.0], [-0.6, -4.0]])


class Two(torch.nn.Module):
    def forward(self, image):
        return image.mean((2, 3))[:, :2]


def test_policies_give_a_row_for_each_control():
    policy = TorchPolicy(Two(), action=Action((0, 1)))
    driven = drive(environment(), policy, straight(), np.zeros(3), 0, 3)
    assert driven.controls.shape == (3, 2) and not driven.controls.any()


def wrong(control):
    def call():
        made = environment()
        made.reset(straight())
        made.step(control)

    return call


def drive_one():
    policy = TorchPolicy(Two(), action=Action(0))
    drive(environment(), policy, straight(), np.zeros(3), 0, 1)


PEDAL = Control("pedal", "other", -1.0, 1.0)
test_refused = refusals(
    (wrong(0.1), "gives 1, the vehicle takes 2: steering, acceleration"),
    (wrong([0.1, 0.2, 0.3]), "gives 3, the vehicle takes 2"),
    (wrong([0.1, math.nan]), "control: .*nan.*finite"),
    (drive_one, "gives 1, the vehicle takes 2"),
    (lambda: KinematicVehicle(Motion(KinematicSingleTrack()), 0.1, 1.0), "more_contr"),
    (
        lambda: KinematicVehicle(
            Motion(Dubins()), 0.1, 1.5, more_controls=(ACCELERATION,)
        ),
        "more_controls: 1; the model takes heading_rate",
    ),
    (lambda: MujocoVehicle(replace(CAR2, more_controls=(PEDAL,))), "pedal; a car with"),
    (lambda: Control("brake", "m/s^2", 1.0, 2.0), "control.lowest: 1.0.*below 0"),
    (
        lambda: expert_for("rad/s", straight(), 0.1, acceleration=(-1.0, 1.0)),
        "expert.acceleration",
    ),
    (
        lambda: Drive(
            "a", "b", "own", 0, 0, np.zeros((3, 3)), np.zeros((2, 2, 2)), [0, 0], [1, 2]
        ),
        "Drive.controls: shape",
    ),
)
