from .camera.open import ZedOptions as ZedOptions
from .camera.open import open_camera as open_camera
from .tracker.motion_capture import MotionCaptureTracker as MotionCaptureTracker
from .tracker.open import open_tracker as open_tracker
from .tracker.vicon import ViconTracker as ViconTracker
from .vesc.motor import VescMotor as VescMotor
