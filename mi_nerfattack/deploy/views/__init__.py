"""What the camera of an environment sees."""
