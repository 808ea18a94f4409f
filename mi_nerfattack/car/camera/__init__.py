"""The car's camera: a ZED, any other, a recorded video, or a rendered room."""
