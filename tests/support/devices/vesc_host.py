"""A program that drives a car at 1 m/s, in a process of its own, to be ended badly.

    python tests/support/devices/vesc_host.py PORT

prints `driving` each time that the car has come to speed. A line on its standard input
hangs it, until the next.
"""

from __future__ import annotations

import select
import sys
import time

from mi_nerfattack.car.devices import Command, DeviceLostError
from mi_nerfattack.car.vesc.motor import VescMotor


def main(port: str) -> None:
    motor = VescMotor(port)
    motor.arm()
    was_fast = False
    while True:
        try:
            motor.send(Command(1.0, 0.0))
            values = motor.read()
        except DeviceLostError:  # while this process was stopped
            motor.arm()
            continue
        is_fast = values is not None and (values.speed_ms or 0.0) > 0.95
        if is_fast and not was_fast:
            print("driving", flush=True)
        was_fast = is_fast
        if select.select([sys.stdin], [], [], 0.05)[0]:
            sys.stdin.readline()
            sys.stdin.readline()
        time.sleep(0.01)


if __name__ == "__main__":
    main(sys.argv[1])
