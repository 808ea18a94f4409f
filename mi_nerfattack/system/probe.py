"""Try every Mitsuba variant; run as ``python -m mi_nerfattack.system.probe``.

One JSON line for each variant. A process of its own, because an LLVM that is too
old aborts the process at the first kernel that takes a minimum.
"""

from __future__ import annotations

import json
import logging

import drjit as dr
import mitsuba as mi


def main() -> None:
    """Print what became of each variant."""
    logging.disable()  # plugins are not what is tried here
    for name in mi.variants():
        print(json.dumps({"variant": name, "started": True}), flush=True)
        print(json.dumps({"variant": name, "error": _try(name)}), flush=True)


def _try(name: str) -> str | None:
    """Load a variant and run one kernel; return the error, None if it worked."""
    try:
        mi.set_variant(name)
        numbers = dr.minimum(mi.Float(2.0) + mi.Float(1.0), mi.Float(1.0))
        dr.eval(numbers)
        return None if dr.allclose(numbers, 1.0) else "wrong result of a kernel"
    except (ImportError, RuntimeError) as err:
        return str(err).splitlines()[0]


if __name__ == "__main__":
    main()
