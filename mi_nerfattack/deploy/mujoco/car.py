"""A car with four wheels as MJCF.

The body's frame has its origin on the ground under the middle of the rear axle, x
forward, y left, z up. Only the wheels and the floor of the body touch the ground,
nothing of the car touches another part of it, so that the front wheels steer clear of
the chassis.

- Tyres: one contact point each with Coulomb friction in an elliptic cone.
- Steering: a column, whose angle is that of the bicycle model, turns the front wheels
  by a linkage so that the axes of all wheels meet in one point (Ackermann's condition).
- Drive: a tendon over both rear wheels, which shares the torque between them and leaves
  them free to turn at different speeds, as a differential does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Car
from mi_nerfattack.deploy.mujoco.module import mujoco
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Positive, Seconds, checked

BODY, COLUMN, AXLE = "car", "column", "rear_axle"
STEER, DRIVE = "steer", "drive"
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
GROUND = "ground"
MAX_TIMESTEP = 0.002

_WHEEL_MASS = 0.0125  # of the car's mass, each
_HEIGHT = 0.2  # of the wheelbase: centre of gravity above the ground
_SERVO_RATE = 250.0  # rad/s, of the steering column's undamped oscillation
_STIFF = (0.006, 1.0)  # time constant (s) and damping ratio of linkage and tyres
_SPARE_STEER = 0.05  # rad, beyond the largest steering angle


@dataclass(frozen=True)
@checked("handling")
class Handling:
    """How a car answers, besides its dimensions.

    Args:
        steer_time_constant: of the first-order lag of the steering angle, seconds.
        steer_rate: largest rate of the steering angle, rad/s.
        motor_time_constant: of the first-order lag of the driving torque, seconds.
        max_acceleration: that the motor and the brakes give, m/s^2.
        friction: coefficient between tyre and road.
    """

    steer_time_constant: Seconds = 0.1
    steer_rate: Positive = 1.5
    motor_time_constant: Seconds = 0.1
    max_acceleration: Positive = 4.0
    friction: Positive = 0.9


def add_ground(spec: mujoco.MjSpec) -> None:
    """Add the plane z = 0, which is all that a car touches."""
    spec.worldbody.add_geom(
        name=GROUND,
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=0,
        conaffinity=1,
        group=4,  # not drawn
    )


def add_car(spec: mujoco.MjSpec, car: Car, handling: Handling) -> None:
    """Add a car, its linkage and its actuators; its rear axle stands at the origin.

    Raises:
        InputError: it would steer about a point between its rear wheels.
    """
    largest = math.atan(2 * car.wheelbase / car.track) - _SPARE_STEER
    if car.max_steer >= largest:
        raise InputError(
            f"car.max_steer: {car.max_steer!r} rad; MuJoCo's car steers by less than "
            f"{largest:.3f} rad, where its inner front wheel stands across"
        )
    _set_options(spec)
    body = spec.worldbody.add_body(name=BODY)
    body.add_freejoint(name=BODY)
    _add_chassis(body, car)
    column = body.add_body(name=COLUMN, pos=[car.wheelbase, 0, car.wheel_radius])
    inertia = 2 * _wheel_inertia(car)
    column.mass, column.inertia = inertia / car.wheel_radius**2, [inertia] * 3
    column.explicitinertial, column.ipos = True, [0, 0, 0]
    column.add_joint(name=COLUMN, axis=[0, 0, 1])
    for name in WHEELS:
        _add_wheel(body, name, car, handling=handling)
    _add_linkage(spec, car)
    _add_actuators(spec, car, handling)


def ackermann_angles(car: Car, steer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles (radians) of the left and the right front wheel.

    Args:
        car: its wheelbase and track.
        steer: angle of the bicycle model, radians, any shape; positive to the left.
    """
    tangent = np.tan(steer)
    half = car.track / (2 * car.wheelbase)
    left = np.arctan(tangent / (1 - half * tangent))
    return left, np.arctan(tangent / (1 + half * tangent))


def _set_options(spec: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep = MAX_TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 20  # tyres creep sideways otherwise
    option.tolerance = 1e-10


def _add_chassis(body: Any, car: Car) -> None:
    """Add the mass without the wheels, and a shape, which is centred.

    The mass is at the centre of gravity of `car.reference`, or between the axles.
    """
    height = 2 * _HEIGHT * car.wheelbase
    mass = car.mass * (1 - 4 * _WHEEL_MASS)
    middle = [car.reference or car.wheelbase / 2, 0, _HEIGHT * car.wheelbase]
    sides = np.array([car.length, car.width, height])
    body.mass, body.ipos = mass, middle
    body.inertia = mass / 12 * (sides @ sides - sides**2)
    body.explicitinertial = True
    clearance = 0.5 * car.wheel_radius
    narrow = min(0.5 * car.width, 0.5 * car.track - 0.4 * car.wheel_radius)
    body.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[car.length / 2, narrow, (height - clearance) / 2],
        pos=[car.wheelbase / 2, 0, (height + clearance) / 2],
        contype=1,
        conaffinity=0,
        rgba=[0.55, 0.1, 0.1, 1],
    )


def _wheel_inertia(car: Car) -> float:
    """Return the largest moment of inertia of a wheel, kg m^2."""
    return 0.4 * _WHEEL_MASS * car.mass * car.wheel_radius**2


def _add_wheel(chassis: Any, name: str, car: Car, handling: Handling) -> None:
    front, left = name.startswith("front"), name.endswith("left")
    radius, sign = car.wheel_radius, 1 if left else -1
    offset = [car.wheelbase if front else 0, sign * car.track / 2, radius]
    holder = chassis.add_body(name=name, pos=offset)
    if front:
        holder.add_joint(name=f"{name}_steer", axis=[0, 0, 1])
    holder.add_joint(name=name, axis=[0, 1, 0])
    # An ellipsoid touches a plane in one point: turning on the spot needs no force.
    holder.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=[radius, 0.35 * radius, radius],
        mass=_WHEEL_MASS * car.mass,
        contype=1,
        conaffinity=0,
        condim=3,
        priority=1,
        friction=[handling.friction, 0, 0],
        solref=_STIFF,
        group=4,
    )
    holder.add_geom(
        name=f"{name}_tyre",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[radius, 0.3 * radius, 0],
        quat=[math.sqrt(0.5), math.sqrt(0.5), 0, 0],
        mass=0,
        contype=0,
        conaffinity=0,
        rgba=[0.08, 0.08, 0.08, 1],
    )


def _add_linkage(spec: mujoco.MjSpec, car: Car) -> None:
    """Tie both front wheels to the column by polynomials of its angle."""
    reach = car.max_steer + _SPARE_STEER
    grid = reach * np.cos(np.linspace(0, np.pi, 100))
    for name, angles in zip(WHEELS[:2], ackermann_angles(car, grid), strict=True):
        powers = np.stack([grid**k for k in range(4)], axis=1)
        # of the ratio, so that small angles are as exact as large ones
        coefficients, *_ = np.linalg.lstsq(powers, angles / grid, rcond=None)
        equality = spec.add_equality(
            name=f"{name}_link",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=f"{name}_steer",
            name2=COLUMN,
            solref=_STIFF,
        )
        equality.data[:5] = [0, *coefficients]


def _add_actuators(spec: mujoco.MjSpec, car: Car, handling: Handling) -> None:
    stiffness = 4 * _wheel_inertia(car) * _SERVO_RATE**2
    lag = mujoco.mjtDyn.mjDYN_FILTEREXACT
    steer = spec.add_actuator(
        name=STEER, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=COLUMN
    )
    steer.dyntype, steer.dynprm[0] = lag, handling.steer_time_constant
    steer.gainprm[0] = stiffness
    steer.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    steer.biasprm[:3] = 0, -stiffness, -2 * stiffness / _SERVO_RATE
    axle = spec.add_tendon(name=AXLE)
    for name in WHEELS[2:]:
        axle.wrap_joint(name, 0.5)
    drive = spec.add_actuator(
        name=DRIVE, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=AXLE
    )
    drive.dyntype, drive.dynprm[0] = lag, handling.motor_time_constant
    drive.gainprm[0] = car.mass * car.wheel_radius  # activation in m/s^2
