"""MuJoCo: map and car as MJCF, its physics, its renderer."""

from mi_nerfattack.extras import require

require("the environment of MuJoCo", "mujoco")
