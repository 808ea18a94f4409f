"""Public names of packages, loaded when somebody asks for them (PEP 562)."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any


def lazy(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's `__getattr__`, which knows its `__all__`, and `__dir__`.

    The public names are those that the package's `__init__.py` imports for type
    checkers alone, so each stands there once; they are read off at the first question.

    Args:
        package: its ``__name__``; below ``if TYPE_CHECKING:`` it has ``from MODULE
            import NAME as NAME`` for all its public names.
    """

    @cache
    def sources() -> dict[str, str]:
        tree = ast.parse(inspect.getsource(sys.modules[package]))
        return {
            item.name: "." * node.level + (node.module or "")
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for item in node.names
            if item.asname
        }

    def find(name: str) -> Any:
        if name == "__all__":
            return sorted(sources())
        if name.startswith("__") or name not in sources():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(sources()[name], package), name)
        setattr(sys.modules[package], name, value)  # asked for once
        return value

    return find, lambda: sorted({*vars(sys.modules[package]), *sources()})
