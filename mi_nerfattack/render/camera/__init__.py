"""Cameras: intrinsics, distortion, poses and their conventions."""
