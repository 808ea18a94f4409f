"""``python -m bench``, in the checkout: figures beside the peers they compare to."""

from __future__ import annotations

import sys

from bench.commands.circle import BenchCircle
from bench.commands.experts import BenchExperts
from bench.commands.gaps import BenchGaps
from bench.commands.gpu import BenchFrames, BenchGpu
from bench.commands.imports import BenchImports
from bench.commands.loop import BenchLoop
from bench.commands.matrix import BenchMatrix
from bench.commands.memory import BenchMemory
from bench.commands.methods import BenchMethods
from bench.commands.overlay import BenchOverlay
from bench.commands.phone import BenchPhone
from bench.commands.poses import BenchPoses
from bench.commands.quality import BenchQuality
from bench.commands.scaling import BenchScaling
from bench.commands.soak import BenchSoak
from bench.commands.speed import (
    BenchAttack,
    BenchComposite,
    BenchFit,
    BenchRender,
    BenchSteps,
)
from bench.commands.steering import BenchSteering
from bench.commands.study import BenchStudy
from bench.commands.table2 import BenchTable2
from bench.commands.training import BenchCollect, BenchDagger
from mi_nerfattack import cli

COMMANDS = {
    "render": BenchRender,
    "fit": BenchFit,
    "attack": BenchAttack,
    "memory": BenchMemory,
    "loop": BenchLoop,
    "soak": BenchSoak,
    "scaling": BenchScaling,
    "composite": BenchComposite,
    "steps": BenchSteps,
    "experts": BenchExperts,
    "circle": BenchCircle,
    "collect": BenchCollect,
    "dagger": BenchDagger,
    "study": BenchStudy,
    "quality": BenchQuality,
    "table2": BenchTable2,
    "steering": BenchSteering,
    "methods": BenchMethods,
    "matrix": BenchMatrix,
    "overlay": BenchOverlay,
    "poses": BenchPoses,
    "gaps": BenchGaps,
    "phone": BenchPhone,
    "imports": BenchImports,
    "frames": BenchFrames,
    "gpu": BenchGpu,
}


def main(argv: list[str] | None = None) -> int:
    """Run one benchmark and return the exit code."""
    return cli.main(argv, {"": COMMANDS}, "python -m bench")


if __name__ == "__main__":
    sys.exit(main())
