"""The environment of a CARLA server."""
