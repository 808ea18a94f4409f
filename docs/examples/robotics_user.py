"""Drive a route and a vehicle model of one's own, and see what lag does."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack import deploy, policy, scenes, vehicle
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.vehicle.expert import choose

mi.set_variant("llvm_ad_rgb")
STEPS, SPEED = 40, 5.0  # periods of 0.1 s, m/s

x = np.arange(-25.0, 0.0, 0.5)  # to the crossing, along the lane's middle
route = vehicle.Route(
    "mine",
    goal=0,  # straight on
    points=np.column_stack([x, np.full_like(x, -1.75)]),
    lane_width_m=3.5,
    speed_ms=SPEED,
)


def car_with_lag(seconds):
    """Return a car whose heading rate follows the control after a while."""

    def derivative(state, control):
        _, _, theta, rate = state  # metres, metres, radians, rad/s
        forward = SPEED * dr.cos(theta), SPEED * dr.sin(theta)
        return *forward, rate, (control - rate) / seconds

    dynamics = vehicle.FunctionDynamics(derivative, size=4, limit=1.5)
    return Motion(dynamics, vehicle.RK4(), substeps=4)


network = policy.PilotNet.load(scenes.bundled("policy/pilotnet.safetensors"))
driver = policy.TorchPolicy(network)
start = route.pose_at(1.0, lateral=0.4, heading=0.05)
for lag in (0.05, 0.2, 0.5):
    place = replace(deploy.bundled_place(), motion=car_with_lag(lag))
    world = deploy.make_environment("mitsuba", place, deploy.Conditions(spp=4))
    driven = deploy.drive(world, driver, route, start, 0, STEPS)

    expert = choose.expert_for("rad/s", route, world.period, lag=lag)
    world.reset(route, start)
    errors = []
    for _ in range(STEPS):  # it knows its state: nothing is rendered
        world.advance(expert.control(world.state)[0])
        errors.append(abs(route.cross_track_numpy(world.state[:3])))
    policy_m, expert_m = abs(driven.cross_track_m).mean(), np.mean(errors)
    print(f"lag {lag} s: mean error, policy {policy_m:.3f} m, expert {expert_m:.3f} m")
