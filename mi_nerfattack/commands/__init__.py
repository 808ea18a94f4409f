"""The sub-commands of ``mi-nerfattack``, one file each.

A command is a frozen dataclass. Its fields are the arguments, and their docstrings are
the help; `cli` has the help of ``output``, ``json`` and ``run_folder``, which commands
share. ``run()`` does the work and returns the exit code. A command that prints figures
returns them as a ``Result`` and takes ``json``. ``--help`` imports all these modules,
so import anything slow (torch, our own parts) inside run().
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from mi_nerfattack.commands.asset import AssetCube, AssetFlat, AssetFolder, AssetMesh
from mi_nerfattack.commands.attack import Attack
from mi_nerfattack.commands.bake import Bake
from mi_nerfattack.commands.calibrate import Calibrate
from mi_nerfattack.commands.capture import (
    CapturePhotographs,
    CaptureScene,
    CaptureVideo,
)
from mi_nerfattack.commands.certify import CertifyGradient, CertifyRobustness
from mi_nerfattack.commands.check import Check
from mi_nerfattack.commands.compare_drives import CompareDrives
from mi_nerfattack.commands.compare_field import CompareField
from mi_nerfattack.commands.demo import Demo
from mi_nerfattack.commands.doctor import Doctor
from mi_nerfattack.commands.drive import DriveCommand
from mi_nerfattack.commands.evaluate import Evaluate
from mi_nerfattack.commands.export import (
    ExportFaces,
    ExportMesh,
    ExportOpenscenario,
    ExportPrint,
    ExportRoutes,
    ExportScreen,
)
from mi_nerfattack.commands.fit import Fit
from mi_nerfattack.commands.monitor import Monitor
from mi_nerfattack.commands.overlay import OverlayCommand
from mi_nerfattack.commands.render import RenderFrame, RenderPath
from mi_nerfattack.commands.report import Report
from mi_nerfattack.commands.reproduce import Reproduce
from mi_nerfattack.commands.retrain import Retrain
from mi_nerfattack.commands.serve_policy import ServePolicy
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.commands.sweep import Sweep
from mi_nerfattack.commands.train import Train
from mi_nerfattack.commands.transfer import Transfer
from mi_nerfattack.commands.upgrade import Upgrade
from mi_nerfattack.commands.view import View


class Command(Protocol):
    """What the command line calls after it has parsed the arguments.

    One that goes on where it was interrupted also has `continues`, which is true, and
    `anew`, the options that would make it start again.
    """

    def run(self) -> int | Result:
        """Do the work and return the exit code, or the figures with it."""
        ...


@dataclass(frozen=True)
class Group:
    """Commands that belong together, called ``GROUP COMMAND``.

    Attributes:
        description: a sentence for the help.
        commands: by name.
    """

    description: str
    commands: Mapping[str, type[Command]]


Commands = Mapping[str, "type[Command] | Group"]

_CAR = Group(
    "A small real car, or one in the simulated room, and an attacked box next to it.",
    {
        "calibrate": Calibrate,
        "drive": DriveCommand,
        "serve": ServePolicy,
        "overlay": OverlayCommand,
        "monitor": Monitor,
        "compare": CompareDrives,
    },
)
_RENDER = Group(
    "Render a frame or a path of a Mitsuba scene; compare it to a field.",
    {"frame": RenderFrame, "path": RenderPath, "compare": CompareField},
)
_CAPTURE = Group(
    "Make posed images of a scene, of photographs or of a video.",
    {
        "scene": CaptureScene,
        "photographs": CapturePhotographs,
        "video": CaptureVideo,
    },
)
_ASSET = Group(
    "Make the field of an object, whose texture can then be attacked.",
    {
        "mesh": AssetMesh,
        "cube": AssetCube,
        "flat": AssetFlat,
        "folder": AssetFolder,
    },
)
_EXPORT = Group(
    "Write objects, routes and scenarios for other programs, paper and screens.",
    {
        "mesh": ExportMesh,
        "faces": ExportFaces,
        "openscenario": ExportOpenscenario,
        "print": ExportPrint,
        "routes": ExportRoutes,
        "screen": ExportScreen,
    },
)
_CERTIFY = Group(
    "Bound the chance of a departure; compare an attack's gradient to differences.",
    {"robustness": CertifyRobustness, "gradient": CertifyGradient},
)
#: What can be called, by theme.
THEMES: dict[str, Commands] = {
    "start": {"doctor": Doctor, "demo": Demo},
    "place": {"capture": _CAPTURE, "fit": Fit, "bake": Bake, "render": _RENDER},
    "object": {"asset": _ASSET, "export": _EXPORT},
    "policy": {"train": Train, "evaluate": Evaluate, "retrain": Retrain},
    "attack": {
        "check": Check,
        "attack": Attack,
        "sweep": Sweep,
        "transfer": Transfer,
        "certify": _CERTIFY,
        "reproduce": Reproduce,
        "upgrade": Upgrade,
    },
    "look": {"report": Report, "view": View},
    "car": {"car": _CAR},
}


def flat(themes: Mapping[str, Commands]) -> dict[str, type[Command] | Group]:
    """Return what themes name, without them."""
    return {name: one for theme in themes.values() for name, one in theme.items()}


COMMANDS = flat(THEMES)

_TABLES = ("matplotlib", "pandas")
_FITS = (*_TABLES, "skimage")
#: Optional packages without which a command refuses before it starts. What only some
#: options of a command need is loaded, and missed, where it is used.
PACKAGES: Mapping[type[Command], tuple[str, ...]] = {
    Demo: _TABLES,
    CaptureScene: _TABLES,
    CapturePhotographs: (*_TABLES, "pycolmap"),
    CaptureVideo: (*_TABLES, "av", "pycolmap"),
    Fit: _FITS,
    Bake: _FITS,
    CompareField: _FITS,
    AssetMesh: (*_FITS, "trimesh"),
    AssetCube: _FITS,
    AssetFolder: _FITS,
    ExportMesh: ("skimage", "trimesh"),
    ExportOpenscenario: _FITS,
    ExportPrint: _TABLES,
    ExportScreen: _TABLES,
    Train: _TABLES,
    Evaluate: _TABLES,
    Retrain: _TABLES,
    Check: _TABLES,
    Attack: _TABLES,
    Sweep: _TABLES,
    Transfer: _TABLES,
    CertifyRobustness: _TABLES,
    CertifyGradient: _TABLES,
    Reproduce: _TABLES,
    Report: _TABLES,
    View: (*_FITS, "viser"),
    OverlayCommand: (*_TABLES, "av", "cv2"),
    Monitor: _TABLES,
    CompareDrives: _TABLES,
}


def each(commands: Commands) -> Iterator[tuple[tuple[str, ...], type[Command]]]:
    """Yield each command, those of groups among them, with the words that call it."""
    for name, item in commands.items():
        if isinstance(item, Group):
            yield from (((name, *words), one) for words, one in each(item.commands))
        else:
            yield (name,), item


__all__ = [
    "COMMANDS",
    "PACKAGES",
    "THEMES",
    "Command",
    "Commands",
    "Group",
    "each",
    "flat",
]
