"""Packages that only a part of the work needs, and the extras that install them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from mi_nerfattack.errors import SetupError


@dataclass(frozen=True)
class Optional:
    """A package that the core does without.

    Attributes:
        extra: of ours, which installs it.
        distribution: its name for pip.
    """

    extra: str
    distribution: str


#: Packages by the name that Python imports. pyproject.toml lists the same extras.
OPTIONAL: Mapping[str, Optional] = {
    "DracoPy": Optional("formats", "DracoPy"),
    "av": Optional("video", "av"),
    "carla": Optional("carla", "carla"),
    "cv2": Optional("markers", "opencv-python-headless"),
    "gymnasium": Optional("gym", "gymnasium"),
    "lz4": Optional("mcap", "lz4"),
    "matplotlib": Optional("report", "matplotlib"),
    "mcap": Optional("mcap", "mcap"),
    "mcap_ros2": Optional("mcap", "mcap-ros2-support"),
    "motioncapture": Optional("motion-capture", "motioncapture"),
    "mujoco": Optional("mujoco", "mujoco"),
    "onnx": Optional("onnx", "onnx"),
    "optuna": Optional("bayesian", "optuna"),
    "pandas": Optional("report", "pandas"),
    "pillow_heif": Optional("formats", "pillow-heif"),
    "pycolmap": Optional("photos", "pycolmap"),
    "ray": Optional("ray", "ray"),
    "skimage": Optional("mesh", "scikit-image"),
    "submitit": Optional("submitit", "submitit"),
    "trimesh": Optional("mesh", "trimesh"),
    "viser": Optional("view", "viser"),
    "zstandard": Optional("mcap", "zstandard"),
}


def install_hint(*extras: str) -> str:
    """Return the remedy that installs extras of this package."""
    return f"install it with: pip install 'mi-nerfattack[{','.join(extras)}]'"


def require(purpose: str, *modules: str) -> None:
    """Raise SetupError unless optional packages are installed; import none of them.

    Args:
        purpose: what needs them, for the message.
        modules: keys of `OPTIONAL`.
    """
    absent = [name for name in modules if find_spec(name) is None]
    if absent:
        extras = sorted({OPTIONAL[name].extra for name in absent})
        raise SetupError(
            f"{purpose} needs {', '.join(absent)}, which cannot be imported; "
            f"{install_hint(*extras)}"
        )


def missing(module: str, purpose: str, cause: object, otherwise: str = "") -> Exception:
    """Return the error of an optional package that cannot be imported.

    Args:
        module: the package, or a module of it.
        purpose: what needs it, for the message.
        cause: why it cannot be imported.
        otherwise: what helps where the package cannot be installed.
    """
    package = module.partition(".")[0]
    remedy = install_hint(OPTIONAL[package].extra)
    if otherwise:
        remedy += f", or {otherwise}"
    return SetupError(
        f"{purpose} needs {package}, which cannot be imported ({cause}); {remedy}"
    )


def load_extra(module: str, purpose: str, otherwise: str = "") -> Any:
    """Import an optional package; see :func:`missing` for the arguments.

    Raises:
        SetupError: it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(module, purpose, error, otherwise) from error
