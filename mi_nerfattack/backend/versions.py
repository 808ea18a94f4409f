"""The versions that a result depends on."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Iterable
from pathlib import Path

import drjit as dr
import mitsuba as mi

import mi_nerfattack
from mi_nerfattack.backend import llvm

#: Folders that show results or steer a real car; no result depends on them.
_INERT = ("commands", "report", "robot")


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, with the active variant.

    ``source`` is a digest of the package's own code: what was kept by other code is
    not taken for a result of this one.
    """
    return {
        "mi_nerfattack": mi_nerfattack.__version__,
        "source": _own_source(),
        "mitsuba": str(mi.__version__),
        "drjit": str(dr.__version__),
        "numpy": _installed("numpy"),
        "torch": _installed("torch"),
        "llvm": ".".join(map(str, llvm.version() or ())),
        "variant": str(mi.variant()),
    }


@functools.cache
def _own_source() -> str:
    plugins = importlib.util.find_spec("mi_nerfattack.plugins")
    beside = plugins and plugins.submodule_search_locations
    places = [*mi_nerfattack.__path__, *(beside or ())]
    return digest_code(Path(place) for place in places)


def digest_code(folders: Iterable[Path]) -> str:
    """Hash the Python files that results may depend on, 12 hexadecimal digits.

    Args:
        folders: of packages; `commands`, `report` and `robot` in them do not count.
    """
    total = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            name = path.relative_to(folder)
            if name.parts[0] not in _INERT:
                total.update(f"{name.as_posix()}\n".encode() + path.read_bytes())
    return total.hexdigest()[:12]


@functools.cache
def _installed(package: str) -> str:
    return importlib.metadata.version(package)
