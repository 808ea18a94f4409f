"""Functions that a user gives as ``FILE.py:NAME`` or ``package.module:NAME``."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Callable
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io import files


def check_trust(key: str, name: str, trusted: bool) -> None:
    """Refuse code that the user has not said to trust.

    Args:
        key: of the file that is code, ``section.key``.
        name: of the file.
        trusted: the section's `trust_code`.

    Raises:
        InputError: it is False.
    """
    if not trusted:
        raise InputError(
            f"{key}: {name}: is code and runs with all rights of your account; if you "
            f"trust who wrote it, say so: trust_code = true beside {key}, or "
            f"--set {key.partition('.')[0]}.trust_code=true"
        )


def load_function(path: str | Path, name: str) -> Callable[..., Any]:
    """Run a Python file and return what it calls `name`.

    The file runs with all rights of this process: name files that you trust. Files
    beside it cannot be imported from it.

    Args:
        path: Python source.
        name: of a function, or of another callable.

    Raises:
        InputError: the file cannot be read, is no Python, raises an exception, or has
            no such callable.
    """
    source = files.read_text(path)
    digest = hashlib.sha256(f"{Path(path).resolve()}\0{source}".encode()).hexdigest()
    module = ModuleType(f"mi_nerfattack_user_{digest[:16]}")
    module.__file__ = str(path)
    try:
        code = compile(source, str(path), "exec")
    except (SyntaxError, ValueError) as err:
        line = getattr(err, "lineno", None)
        where = f"{path}:{line}" if line else f"{path}"
        raise InputError(f"{where}: {err}; must be Python") from err
    sys.modules[module.__name__] = module  # dataclasses look their module up
    try:
        exec(code, module.__dict__)
    except Exception as err:
        if is_interrupt(err):
            raise
        raise InputError(f"{path}: raised {type(err).__name__}: {err}") from err
    found = module.__dict__.get(name)
    if not callable(found):
        known = [key for key, value in module.__dict__.items() if _own(value, module)]
        raise InputError(
            f"{path}: has no function {name!r}; it has {', '.join(known) or 'none'}"
        )
    return found


def import_function(reference: str) -> Callable[..., Any]:
    """Import what ``package.module:NAME`` names, from the installed packages.

    Raises:
        InputError: there is no such module, importing it raises an exception, or it
            has no such callable.
    """
    module, _, name = reference.rpartition(":")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as err:
        raise InputError(
            f"{reference!r}: {err}; install the package, or name a file: FILE.py:{name}"
        ) from err
    except Exception as err:
        if is_interrupt(err):
            raise
        raise InputError(
            f"{reference!r}: importing it raised {type(err).__name__}: {err}"
        ) from err
    if not callable(found):
        raise InputError(f"{reference!r}: {module} has no function {name!r}")
    return found


def module_file(name: str) -> Path | None:
    """Find the source of an installed module without running it or its packages.

    Args:
        name: ``package.module``.

    Returns:
        the file that importing it would run; None where there is none.
    """
    top, *rest = name.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except ValueError:  # a module of this process without a specification
        return None
    for part in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        path = list(spec.submodule_search_locations)
        spec = PathFinder.find_spec(f"{spec.name}.{part}", path)
    if spec is None or not spec.has_location or spec.origin is None:
        return None
    return Path(spec.origin)


def _own(value: Any, module: ModuleType) -> bool:
    return callable(value) and getattr(value, "__module__", None) == module.__name__
