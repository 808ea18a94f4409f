"""The camera of a scenario."""

from __future__ import annotations

from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.scenario.sections import CameraSection


def build_camera(section: CameraSection) -> tuple[Camera, CameraMount]:
    """Make intrinsics and mount."""
    camera = from_fov(section.width, section.height, section.fov_x_deg)
    mount = CameraMount(section.height_m, section.forward_m, section.pitch_deg)
    return camera, mount
