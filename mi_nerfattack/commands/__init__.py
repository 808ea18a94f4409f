"""The sub-commands of ``mi-nerfattack``, one file each.

A command is a frozen dataclass: its fields are the arguments, their docstrings the
help, and ``run()`` does the work and returns the exit code or, where it prints
figures, these, as a ``Result``; then it takes ``json``. These modules are all
imported for ``--help``; import anything slow (torch, our own parts) inside run().
"""

from __future__ import annotations

from typing import Protocol

from mi_nerfattack.commands.asset import Asset
from mi_nerfattack.commands.attack import Attack
from mi_nerfattack.commands.bake import Bake
from mi_nerfattack.commands.calibrate import Calibrate
from mi_nerfattack.commands.capture import Capture
from mi_nerfattack.commands.check import Check
from mi_nerfattack.commands.compare_drives import CompareDrives
from mi_nerfattack.commands.demo import Demo
from mi_nerfattack.commands.doctor import Doctor
from mi_nerfattack.commands.drive import DriveCommand
from mi_nerfattack.commands.evaluate import Evaluate
from mi_nerfattack.commands.export import Export
from mi_nerfattack.commands.fit import Fit
from mi_nerfattack.commands.monitor import Monitor
from mi_nerfattack.commands.overlay import OverlayCommand
from mi_nerfattack.commands.refine import Refine
from mi_nerfattack.commands.render import Render
from mi_nerfattack.commands.replay import Replay
from mi_nerfattack.commands.report import Report
from mi_nerfattack.commands.retrain import Retrain
from mi_nerfattack.commands.serve_policy import ServePolicy
from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.sweep import Sweep
from mi_nerfattack.commands.train import Train
from mi_nerfattack.commands.transfer import Transfer
from mi_nerfattack.commands.view import View


class Command(Protocol):
    """What the command line calls after it has parsed the arguments."""

    def run(self) -> int | Result:
        """Do the work and return the exit code, or the figures with it."""
        ...


COMMANDS: dict[str, type[Command]] = {
    "doctor": Doctor,
    "demo": Demo,
    "render": Render,
    "capture": Capture,
    "fit": Fit,
    "bake": Bake,
    "asset": Asset,
    "export": Export,
    "train": Train,
    "evaluate": Evaluate,
    "check": Check,
    "attack": Attack,
    "sweep": Sweep,
    "replay": Replay,
    "transfer": Transfer,
    "refine": Refine,
    "retrain": Retrain,
    "overlay": OverlayCommand,
    "monitor": Monitor,
    "drive": DriveCommand,
    "serve-policy": ServePolicy,
    "compare-drives": CompareDrives,
    "calibrate": Calibrate,
    "report": Report,
    "view": View,
}

__all__ = ["COMMANDS", "Command"]
