"""Packages that only a part of the work needs, and the extras that install them."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from mi_nerfattack.errors import SetupError


@dataclass(frozen=True)
class OptionalPackage:
    """A package that the core does without.

    Attributes:
        extra: of ours, which installs it.
        distribution: its name for pip.
    """

    extra: str
    distribution: str


#: Packages by the name that Python imports. pyproject.toml lists the same extras.
OPTIONAL: Mapping[str, OptionalPackage] = {
    "DracoPy": OptionalPackage("formats", "DracoPy"),
    "av": OptionalPackage("video", "av"),
    "carla": OptionalPackage("carla", "carla"),
    "cv2": OptionalPackage("markers", "opencv-python-headless"),
    "gymnasium": OptionalPackage("gym", "gymnasium"),
    "lz4": OptionalPackage("mcap", "lz4"),
    "matplotlib": OptionalPackage("report", "matplotlib"),
    "mcap": OptionalPackage("mcap", "mcap"),
    "mcap_ros2": OptionalPackage("mcap", "mcap-ros2-support"),
    "motioncapture": OptionalPackage("motion-capture", "motioncapture"),
    "mujoco": OptionalPackage("mujoco", "mujoco"),
    "onnx": OptionalPackage("onnx", "onnx"),
    "optuna": OptionalPackage("bayesian", "optuna"),
    "pandas": OptionalPackage("report", "pandas"),
    "pillow_heif": OptionalPackage("formats", "pillow-heif"),
    "pycolmap": OptionalPackage("photos", "pycolmap"),
    "ray": OptionalPackage("ray", "ray"),
    "skimage": OptionalPackage("mesh", "scikit-image"),
    "submitit": OptionalPackage("submitit", "submitit"),
    "trimesh": OptionalPackage("mesh", "trimesh"),
    "viser": OptionalPackage("view", "viser"),
    "zstandard": OptionalPackage("mcap", "zstandard"),
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
        raise missing(module, purpose, error, otherwise=otherwise) from error
