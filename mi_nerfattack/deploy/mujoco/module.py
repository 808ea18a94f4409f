"""MuJoCo's package, or one message that says why it cannot be imported."""

from __future__ import annotations

import os

from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import missing

try:
    import mujoco
except ModuleNotFoundError as error:
    raise missing("mujoco", "the environment 'mujoco'", error) from error
except (ImportError, AttributeError, OSError, RuntimeError) as error:
    # it fails in several ways where MUJOCO_GL names what is not there
    raise InputError(
        f"MuJoCo: cannot be imported with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} "
        f"({error}); unset it"
    ) from error

__all__ = ["mujoco"]
