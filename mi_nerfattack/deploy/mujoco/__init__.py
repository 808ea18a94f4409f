"""MuJoCo: map and car as MJCF, its physics, its renderer."""
