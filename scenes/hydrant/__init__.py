"""A fire hydrant built by a script."""
