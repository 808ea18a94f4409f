"""Numbers of the cars that drive in the environments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import (
    Acute,
    CarUnit,
    Name,
    Negative,
    NonNegative,
    Positive,
    checked,
)
from mi_nerfattack.render.camera.intrinsics import CameraMount


@dataclass(frozen=True)
@checked("control")
class Control:
    """A control of a vehicle besides its first one, which steers.

    Args:
        name: "acceleration", or a name of your own.
        unit: such as "m/s^2".
        lowest: smallest value that has an effect, negative.
        highest: largest value that has an effect.
    """

    name: Name
    unit: str
    lowest: Negative
    highest: Positive


#: Names of the first control by its unit.
_STEERING = {"rad/s": "heading_rate", "rad": "steering"}


def control_names(unit: str, others: Sequence[Control]) -> tuple[str, ...]:
    """Return the names of a vehicle's controls.

    Args:
        unit: of the first one.
        others: those after the first one.
    """
    return _STEERING.get(unit, "control"), *(control.name for control in others)


def acceleration_of(controls: Sequence[Control]) -> tuple[float, float] | None:
    """Return the lowest and the highest acceleration, m/s^2, where it is a control."""
    accelerations = [item for item in controls if item.name == "acceleration"]
    return (
        (accelerations[0].lowest, accelerations[0].highest) if accelerations else None
    )


@dataclass(frozen=True)
@checked("car")
class Car:
    """A car with front-wheel steering; its state refers to a point on its middle line.

    Args:
        wheelbase: between the axles, metres.
        width: metres, of departures from the lane.
        length: metres.
        track: between the wheels of an axle, metres.
        wheel_radius: metres.
        mass: kilograms.
        max_steer: largest steering angle, radians, below pi / 2.
        control_unit: of the control that a policy gives: "rad/s" of a heading rate,
            "rad" of a steering angle, "other" of what drives no car with wheels.
        max_control: largest control that has an effect, in that unit; of a steering
            angle at most `max_steer`.
        more_controls: those that it takes after this one.
        reference: how far ahead of the rear axle this point is, metres; a centre of
            gravity for some models.
    """

    wheelbase: Positive = 2.7
    width: Positive = 1.8
    length: Positive = 4.4
    track: Positive = 1.55
    wheel_radius: Positive = 0.32
    mass: Positive = 1400.0
    max_steer: Acute = 0.75
    control_unit: CarUnit = "rad/s"
    max_control: Positive = 1.5
    more_controls: tuple[Control, ...] = ()
    reference: NonNegative = 0.0

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls, in their order."""
        return control_names(self.control_unit, self.more_controls)

    def from_axle(self, mount: CameraMount) -> CameraMount:
        """Return a mount on the car's point as one on the middle of the rear axle.

        Trackers, and recordings of real drives, have poses of the latter.
        """
        return replace(mount, forward_m=mount.forward_m + self.reference)

    def __post_init__(self) -> None:
        if self.control_unit == "rad" and self.max_control > self.max_steer:
            raise InputError(
                f"car.max_control: {self.max_control!r} rad; a steering angle of at "
                f"most max_steer, {self.max_steer!r} rad"
            )


#: The full-size car of the intersection, driven by its heading rate.
CAR = Car()

#: A car of a tenth of the size, as the RACECAR/J, driven by its steering angle.
SMALL_CAR = Car(
    wheelbase=0.325,
    width=0.296,
    length=0.45,
    track=0.24,
    wheel_radius=0.054,
    mass=4.0,
    max_steer=0.4,
    control_unit="rad",
    max_control=0.4,
)

#: Where the camera is on the small car of the bundled room.
SMALL_CAR_MOUNT = CameraMount(0.2, forward_m=0.3, pitch_deg=10.0)
