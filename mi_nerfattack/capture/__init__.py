"""From photographs, scenes and meshes to posed images."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .camera_path import read_path as read_path
    from .camera_path import route_path as route_path
    from .object_views import Placement as Placement
    from .object_views import read_views as read_views
    from .object_views import render_views as render_views
    from .photographs import PoseOptions as PoseOptions
    from .photographs import estimate_poses as estimate_poses
    from .posed_images import PosedImages as PosedImages
    from .posed_images import load_images as load_images
    from .scene import capture_scene as capture_scene
    from .transforms import read_images as read_images

__getattr__, __dir__ = lazy(__name__)
