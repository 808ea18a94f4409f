"""Functions that a user gives as ``FILE.py:NAME`` or ``package.module:NAME``."""

from __future__ import annotations

import ast
import builtins
import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib.machinery import PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io import files

#: What a helper may not replace: modules of Python, and this package.
_NO_HELPERS = {*sys.stdlib_module_names, __name__.partition(".")[0]}


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

    The file runs with all rights of this process: name files that you trust. The file
    and its `helper_files` import each other by name, and nothing else finds them. Each
    call runs all of them again.

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
    if helpers := helper_files(path):
        module.__package__ = _Helpers.offer(f"{module.__name__}_files", helpers)
        module.__dict__["__builtins__"] = _builtins(module.__package__)
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
        missing = isinstance(err, ModuleNotFoundError)
        remedy = "; install it, or put it in the folder of this file" * missing
        raise InputError(f"{path}: raised {type(err).__name__}: {err}{remedy}") from err
    function = module.__dict__.get(name)
    if not callable(function):
        known = [key for key, value in module.__dict__.items() if _own(value, module)]
        raise InputError(
            f"{path}: has no function {name!r}; it has {', '.join(known) or 'none'}"
        )
    return function


def helper_files(path: str | Path) -> dict[str, Path]:
    """Find the modules in the folder of a Python file that the file imports.

    A module, or a package with an ``__init__.py``, counts if an import statement of the
    file or of another helper names it. It goes before an installed module of the same
    name, as in a script.

    Returns:
        files by dotted name; empty where the file itself cannot be parsed.
    """
    return _modules(Path(path).parent, _imported("", Path(path)))


def module_files(name: str) -> dict[str, Path]:
    """Find the modules in the current folder that ``python -m name`` runs.

    Returns:
        files by dotted name, as of `helper_files`.
    """
    return _modules(Path(), [name, f"{name}.__main__"])


def _modules(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Return the files of modules of a folder, and of what these import from it."""
    modules, queue = dict[str, Path](), list(names)
    while queue:
        segments = queue.pop().split(".")
        for count in range(1, len(segments) + 1):
            dotted = ".".join(segments[:count])
            place = folder.joinpath(*segments[:count])
            candidates = place / "__init__.py", place.with_suffix(".py")
            file = next(filter(os.path.isfile, candidates), None)
            if file is None or segments[0] in _NO_HELPERS:
                break
            if dotted not in modules:
                modules[dotted] = file
                is_package = file.name == "__init__.py"
                queue += _imported(dotted if is_package else _parent(dotted), file)
    return modules


def _imported(package: str, path: Path) -> Iterator[str]:
    """Yield what import statements of a file of a package name: modules, or parts."""
    try:
        tree = ast.parse(files.read_bytes(path, files.MAX_TEXT_BYTES))
    except (SyntaxError, ValueError):  # running it says why
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Assign) and path.name == "__init__.py":
            yield from (f"{package}.{name}" for name in _offered(node))
        elif isinstance(node, ast.ImportFrom):
            above = package if node.level else ""
            for _ in range(node.level - 1):
                above = _parent(above)
            for alias in node.names:
                yield ".".join(filter(None, (above, node.module, alias.name)))


def _offered(node: ast.Assign) -> Iterator[str]:
    """Yield the names of `__all__`, which `import *` imports."""
    targets = [target.id for target in node.targets if isinstance(target, ast.Name)]
    if "__all__" in targets and isinstance(node.value, ast.List | ast.Tuple):
        for item in node.value.elts:
            if isinstance(item, ast.Constant) and isinstance(item.value, str):
                yield item.value


def _parent(name: str) -> str:
    return name.rpartition(".")[0]


class _Helpers:
    """Finder of helpers, under the name of a package that belongs to one file."""

    files: ClassVar[dict[str, Path]] = {}

    @classmethod
    def offer(cls, package: str, helpers: dict[str, Path]) -> str:
        """Let helpers be imported from a package, which is made; return its name."""
        for name in [name for name in sys.modules if name.startswith(f"{package}.")]:
            del sys.modules[name]
        sys.modules[package] = ModuleType(package)
        sys.modules[package].__path__ = []
        cls.files |= {f"{package}.{name}": file for name, file in helpers.items()}
        if cls not in sys.meta_path:
            sys.meta_path.insert(0, cls)
        return package

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        """Return how to load a helper; None of other modules."""
        del path, target
        if (file := cls.files.get(name)) is None:
            return None
        # A folder that no other finder knows, so that only helpers are found inside
        inside = ["<helpers>"] if file.name == "__init__.py" else None
        return importlib.util.spec_from_file_location(
            name,
            file,
            loader=_HelperLoader(name, str(file)),
            submodule_search_locations=inside,
        )


class _HelperLoader(SourceFileLoader):
    """Runs a helper from its source; writes no bytecode."""

    def get_code(self, fullname: str) -> Any:
        """Compile the source."""
        source = files.read_bytes(self.path, files.MAX_TEXT_BYTES)
        return self.source_to_code(source, self.path)

    def exec_module(self, module: ModuleType) -> None:
        """Run the code, which finds other helpers."""
        package = module.__name__.partition(".")[0]
        module.__dict__["__builtins__"] = _builtins(package)
        super().exec_module(module)


def _builtins(package: str) -> dict[str, Any]:
    """Return Python's builtins, whose imports look into a package of helpers first."""

    def find(
        name: str,
        module_globals: Any = None,
        own: Any = None,
        fromlist: Any = (),
        level: int = 0,
    ) -> Any:
        top = name.partition(".")[0]
        if level or f"{package}.{top}" not in _Helpers.files:
            return builtins.__import__(name, module_globals, own, fromlist, level)
        module = builtins.__import__(f"{package}.{name}", module_globals, own, fromlist)
        return module if fromlist else sys.modules[f"{package}.{top}"]

    return vars(builtins) | {"__import__": find}


def import_function(reference: str) -> Callable[..., Any]:
    """Import what ``package.module:NAME`` names, from the installed packages.

    Raises:
        InputError: there is no such module, importing it raises an exception, or it
            has no such callable.
    """
    module, _, name = reference.rpartition(":")
    try:
        function = getattr(importlib.import_module(module), name, None)
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
    if not callable(function):
        raise InputError(f"{reference!r}: {module} has no function {name!r}")
    return function


def module_file(name: str) -> Path | None:
    """Find the source of an installed module without running it or its packages.

    Args:
        name: ``package.module``.

    Returns:
        the file that importing it would run; None where there is none.
    """
    top, *submodules = name.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except ValueError:  # a module of this process without a specification
        return None
    for part in submodules:
        if spec is None or spec.submodule_search_locations is None:
            return None
        path = list(spec.submodule_search_locations)
        spec = PathFinder.find_spec(f"{spec.name}.{part}", path)
    if spec is None or not spec.has_location or spec.origin is None:
        return None
    return Path(spec.origin)


def _own(value: Any, module: ModuleType) -> bool:
    return callable(value) and getattr(value, "__module__", None) == module.__name__
