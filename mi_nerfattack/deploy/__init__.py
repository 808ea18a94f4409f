"""Deployment environments: worlds that an attack was never optimised against."""

from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.path_traced_sensor import PathTracedSensor
from mi_nerfattack.deploy.views.paste import paste_layer, paste_objects

__all__ = [
    "AbstractEnvironment",
    "CameraFrame",
    "PathTracedSensor",
    "paste_layer",
    "paste_objects",
]
