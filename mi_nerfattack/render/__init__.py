"""Rendering of fields: cameras, marching, compositing."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .camera.intrinsics import Camera as Camera
    from .camera.intrinsics import CameraMount as CameraMount
    from .camera.intrinsics import from_fov as from_fov
    from .camera.intrinsics import look_at as look_at
    from .camera.pose import Pose as Pose
    from .composite import AbstractComposite as AbstractComposite
    from .composite import DepthComposite as DepthComposite
    from .interleaved import InterleavedComposite as InterleavedComposite
    from .pathtrace.frames import FrameRenderer as FrameRenderer
    from .pathtrace.frames import write_frame as write_frame
    from .pathtrace.load import load_scene as load_scene
    from .pathtrace.sequence import Shot as Shot
    from .pathtrace.sequence import render_folder as render_folder
    from .pathtrace.sequence import render_video as render_video
    from .posed import PosedField as PosedField
    from .rays import March as March
    from .rays import Rays as Rays
    from .splats import SplatBackground as SplatBackground

__getattr__, __dir__ = lazy(__name__)
