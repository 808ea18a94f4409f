"""From photographs and videos to poses: cameras, scale, upright axes."""
