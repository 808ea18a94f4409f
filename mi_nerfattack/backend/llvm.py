"""Find the LLVM library that Dr.Jit compiles with, and refuse one that crashes.

Dr.Jit reads ``DRJIT_LIBLLVM_PATH`` once, when it is imported. Its own search takes
the first system LLVM, however old, and never looks into a Python environment.
``system/before_drjit.py`` runs this file by itself where others import Dr.Jit first:
nothing of this package is imported here before it is needed.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import re
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
PACKAGE = "karellen-llvm-core"
MINIMUM = 17
MINIMUM_SYSTEM = 19

_INSTALL = (
    f"install one with 'pip install {PACKAGE}' (Linux x86-64) or from the system's "
    f"packages (libllvm{MINIMUM_SYSTEM} or newer), or set {VARIABLE} to its file"
)
_LIBRARY = re.compile(r"libLLVM(?:[-.\d]*)(?:\.so[.\d]*|\.dylib)$")
_RUNTIME = ("libunwind", "libc++abi", "libc++")


@dataclass(frozen=True)
class Library:
    """Where LLVM comes from.

    Attributes:
        path: the file; None where Dr.Jit searches for itself.
        origin: "variable" (the user's), "package", "system" or "dr.jit".
    """

    path: Path | None
    origin: str


def setup() -> Library:
    """Point Dr.Jit to an LLVM unless the user did or Dr.Jit is already loaded."""
    library = locate()
    if library.path is None or VARIABLE in os.environ or "drjit" in sys.modules:
        return library
    if library.origin == "package":
        try:
            _preload_runtime(library.path)
        except FileNotFoundError as err:
            from mi_nerfattack.errors import SetupError

            raise SetupError(str(err)) from err
    os.environ[VARIABLE] = str(library.path)
    return library


def locate() -> Library:
    """Find the LLVM that setup() takes: variable, then package, then system."""
    package = _find_in_package()
    chosen = os.environ.get(VARIABLE)
    if chosen is not None:
        own = package is not None and str(package) == chosen
        return Library(Path(chosen), "package" if own else "variable")
    if package is not None:
        return Library(package, "package")
    system = _find_in_system()
    return Library(system, "dr.jit" if system is None else "system")


def version() -> tuple[int, int, int] | None:
    """Return the version of the LLVM that Dr.Jit has loaded, None without one."""
    import drjit

    major, minor, patch = drjit.detail.llvm_version()
    return None if major < 0 else (major, minor, patch)


def check_version() -> tuple[int, int, int]:
    """Return the version of Dr.Jit's LLVM.

    Raises:
        SetupError: there is none, or it is older than 17. With 15 and 16 the first
            kernel that takes a minimum aborts the process, which cannot be caught.
    """
    from mi_nerfattack.errors import SetupError

    llvm_version = version()
    chosen = os.environ.get(VARIABLE)
    if llvm_version is None:
        where = "no LLVM library found" if chosen is None else f"cannot load {chosen}"
        raise SetupError(f"{VARIABLE}: {where}; {_remedy()}")
    if llvm_version[0] < MINIMUM:
        name = ".".join(map(str, llvm_version))
        raise SetupError(
            f"{VARIABLE}: LLVM {name} is loaded, {MINIMUM} or newer is needed; "
            f"{_remedy()}"
        )
    return llvm_version


def _remedy() -> str:
    library = locate()
    if library.origin in ("package", "system"):
        return (
            "import mi_nerfattack before drjit and mitsuba, install it again, which "
            f"lets them come first, or start Python with {VARIABLE}={library.path}"
        )
    if _find_in_package() is not None:
        return f"unset {VARIABLE} to use the library of {PACKAGE}"
    return _INSTALL


def _find_in_package() -> Path | None:
    try:
        files = importlib.metadata.files(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    named = [file for file in files if _LIBRARY.match(file.name)]
    paths = [Path(os.path.realpath(str(file.locate()))) for file in named]
    return next((path for path in paths if path.is_file()), None)


def _find_in_system() -> Path | None:
    libraries = [
        (_major(path), path)
        for folder in _system_folders()
        for path in folder.glob("libLLVM*")
        if _LIBRARY.match(path.name) and path.is_file()
    ]
    usable = [item for item in libraries if item[0] >= MINIMUM_SYSTEM]
    return max(usable)[1] if usable else None


def _system_folders() -> list[Path]:
    multiarch = sysconfig.get_config_var("MULTIARCH") or "lib"
    return [
        Path("/usr/lib"),
        Path("/usr/lib") / multiarch,
        Path("/usr/lib64"),
        Path("/usr/local/lib"),
        *Path("/usr/lib").glob("llvm-*/lib"),
        Path("/opt/homebrew/opt/llvm/lib"),
        Path("/usr/local/opt/llvm/lib"),
    ]


def _major(path: Path) -> int:
    """Read the major version off a file name, following links; 0 if it has none."""
    for name in (path.name, Path(os.path.realpath(path)).name):
        match = re.search(r"\d+", name)
        if match is not None:
            return int(match.group())
    return 0


def _preload_runtime(library: Path) -> None:
    """Load LLVM's C++ runtime by file where the package's links are not made.

    The package makes its symbolic links at an interpreter start after installation,
    never where it cannot write. The libraries stay local: they define names of the
    system's C++ runtime.
    """
    files = importlib.metadata.files(PACKAGE) or []
    for stem in _RUNTIME:
        pattern = re.compile(re.escape(stem) + r"\.so\.\d+(\.\d+)*$")
        named = [file for file in files if pattern.match(file.name)]
        paths = [Path(str(file.locate())) for file in named]
        soname = [path for path in paths if path.name.count(".") == 2]
        if soname and all(path.exists() for path in soname):
            continue
        present = [path for path in paths if path.is_file()]
        if not present:
            raise FileNotFoundError(
                f"{PACKAGE}: {stem} is missing beside {library}; reinstall it with "
                f"'pip install --force-reinstall {PACKAGE}'"
            )
        ctypes.CDLL(str(present[0]))
