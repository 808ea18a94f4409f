"""A car's motor controller: a VESC at a serial port."""
