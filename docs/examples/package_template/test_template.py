"""The program finds the vehicle, and the vehicle drifts."""

import numpy as np

import mi_nerfattack
from mi_nerfattack.deploy.vehicle import KinematicVehicle
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection

mi_nerfattack.variant.ensure()


def test_it_moves_at_an_angle_to_its_heading():
    table = {"kind": "drift", "slip_deg": 30.0}
    section = read_section("vehicle", VehicleSection, table, ".")
    assert section.package.startswith("nf-template 0.1.0")
    car = section.car()
    # motion() compares the derivatives of the model with differences.
    vehicle = KinematicVehicle(section.motion(), section.dt_s, car.max_control)
    vehicle.reset(np.zeros(3), speed=2.0)
    for _ in range(10):
        vehicle.advance(0.0)
    x, y, heading = vehicle.state
    assert np.allclose([x, y], [2 * np.cos(np.pi / 6), 2 * np.sin(np.pi / 6)])
    assert heading == 0
