"""Deployment environments: worlds that an attack was never optimised against."""

from mi_nerfattack.deploy.mitsuba import PathTracedSensor, paste

__all__ = ["PathTracedSensor", "paste"]
