"""MuJoCo: map and car as MJCF, its physics, its renderer."""

from mi_nerfattack.extras import require

require("the car and the view of MuJoCo", "mujoco")
