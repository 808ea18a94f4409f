"""The versions that a result depends on."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Mapping
from pathlib import Path

import drjit as dr
import mitsuba as mi

import mi_nerfattack
from mi_nerfattack.backend import llvm, variant
from mi_nerfattack.errors import SetupError

#: Folders that show results or steer a real car; no result depends on them.
_INERT = ("commands", "report", "car")
#: Packages that lie beside ours in a checkout, and in it when it is installed.
_ELSEWHERE = ("plugins", "scenes")


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
        "variant": variant.ensure(),
    }


@functools.cache
def _own_source() -> str:
    places = {"": Path(mi_nerfattack.__path__[0])}
    for name in _ELSEWHERE:
        spec = importlib.util.find_spec(f"mi_nerfattack.{name}")
        locations = spec and spec.submodule_search_locations
        places[name] = Path((locations or [places[""] / name])[0])
    return digest_code(places)


def digest_code(places: Mapping[str, Path]) -> str:
    """Hash the Python files that results may depend on, 12 hexadecimal digits.

    Equal for a checkout and for what is installed of it.

    Args:
        places: folders by what the names of their modules begin with; of the first,
            `commands`, `report`, `car` and the other folders do not count.

    Raises:
        SetupError: a folder has no Python files.
    """
    total = hashlib.sha256()
    for prefix, folder in places.items():
        paths = {path.relative_to(folder): path for path in folder.rglob("*.py")}
        if not paths:
            raise SetupError(f"{folder}: has no Python files; install the package anew")
        for name in sorted(paths):
            if prefix or name.parts[0] not in (*_INERT, *places):
                entry = f"{prefix}/{name.as_posix()}\n"
                total.update(entry.encode() + paths[name].read_bytes())
    return total.hexdigest()[:12]


@functools.cache
def _installed(package: str) -> str:
    return importlib.metadata.version(package)
