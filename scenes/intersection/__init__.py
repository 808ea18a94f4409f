"""A T-intersection built by a script."""
