"""OpenGL without a window, for MuJoCo's renderer."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
from typing import Any

from mi_nerfattack.errors import InputError

VARIABLE = "MUJOCO_GL"
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
_began_in: list[int] = []  # the process that used OpenGL first
_REMEDY = (
    "install one of Debian's packages libegl1 with libgl1-mesa-dri (EGL) or libosmesa6 "
    f"(OSMesa, {VARIABLE}=osmesa), or take the environment 'mujoco', whose images are "
    "Mitsuba's"
)


def backend() -> str:
    """Choose how OpenGL is reached.

    Returns:
        the value of MUJOCO_GL where it is set; else on Linux the first of "egl" and
        "osmesa" whose library is there; elsewhere "", MuJoCo's own choice.

    Raises:
        InputError: neither library is there.
    """
    chosen = os.environ.get(VARIABLE, "").lower().strip()
    if chosen or not sys.platform.startswith("linux"):
        return chosen
    for name, library in _LIBRARIES.items():
        if _is_there(library):
            return name
    raise InputError(f"OpenGL: neither EGL nor OSMesa was found; {_REMEDY}")


def make_context(width: int, height: int) -> Any:
    """Make an OpenGL context and make it current.

    Args:
        width: of the largest image, pixels.
        height: of the largest image, pixels.

    Returns:
        an object with `make_current()` and `free()`.

    Raises:
        InputError: there is no OpenGL, it cannot draw without a window, or this process
            was forked from one that had used it, where it would wait for ever.
    """
    name = backend()
    if _began_in and _began_in[0] != os.getpid():
        raise InputError(
            "OpenGL: this process was forked from one that had used it; start it with "
            "the method 'spawn' (of Gymnasium's vector environments: "
            "vector_kwargs={'context': 'spawn'})"
        )
    _began_in[:] = [os.getpid()]
    try:
        context = _context_class(name)(width, height)
        context.make_current()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        detail = " ".join(str(error).split()) or type(error).__name__
        setting = f"{VARIABLE}={name or 'default'}"
        raise InputError(
            f"OpenGL: {setting} does not work ({detail}); {_REMEDY}"
        ) from error
    return context


def _context_class(name: str) -> Any:
    """Import MuJoCo's class for a backend, whatever was chosen at MuJoCo's import."""
    if name == "egl":
        from mujoco.egl import GLContext
    elif name == "osmesa":
        from mujoco.osmesa import GLContext
    elif name in ("disable", "disabled", "off", "false", "0"):
        raise ImportError("it is switched off")
    else:
        from mujoco.gl_context import GLContext
    return GLContext


def _is_there(library: str) -> bool:
    path = ctypes.util.find_library(library)
    if path is None:
        return False
    try:
        ctypes.CDLL(path)
    except OSError:
        return False
    return True
