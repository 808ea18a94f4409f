"""``python -m bench``, in the checkout: figures beside the peers they compare to."""

from __future__ import annotations

import sys

from bench.accuracy import BenchAccuracy
from bench.attack.bench import BenchAttack
from bench.attack.scaling import BenchScaling
from bench.capture import BenchGaps, BenchPoses
from bench.certificates import BenchCertificates
from bench.end_to_end import BenchEndToEnd
from bench.fit.bench import BenchFit
from bench.gpu import BenchFrames, BenchGpu
from bench.loop.bench import BenchLoop
from bench.reach import BenchReach
from bench.render.bench import BenchRender
from bench.roughness import BenchRoughness
from bench.splats import BenchSplats
from bench.studies.run import BenchResults
from bench.vary import BenchVary
from mi_nerfattack import cli

COMMANDS = {
    "render": BenchRender,
    "fit": BenchFit,
    "attack": BenchAttack,
    "scaling": BenchScaling,
    "loop": BenchLoop,
    "end_to_end": BenchEndToEnd,
    "splats": BenchSplats,
    "accuracy": BenchAccuracy,
    "vary": BenchVary,
    "roughness": BenchRoughness,
    "reach": BenchReach,
    "certificates": BenchCertificates,
    "poses": BenchPoses,
    "gaps": BenchGaps,
    "frames": BenchFrames,
    "gpu": BenchGpu,
    "results": BenchResults,
}


def main(argv: list[str] | None = None) -> int:
    """Run one benchmark and return the exit code."""
    return cli.main(argv, {"": COMMANDS}, "python -m bench")


if __name__ == "__main__":
    sys.exit(main())
