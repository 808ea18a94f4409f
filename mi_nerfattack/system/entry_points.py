"""Kinds that other packages offer by entry points, and the packages they come from.

Nobody looks them up, and no other package is imported, until a file or an option names
something that this package does not have. docs/dev/extend/index.md is the guide.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, get_args, get_type_hints

from mi_nerfattack.errors import InputError, is_interrupt

#: Groups of entry points: Mitsuba plugins by their type, environments, and words of
#: ``transfer --conditions``. A `Section` of the scenario file names its own group.
PLUGINS = "mi_nerfattack.plugins"
ENVIRONMENTS = "mi_nerfattack.environments"
CONDITIONS = "mi_nerfattack.conditions"

_T = TypeVar("_T")


@dataclass(frozen=True)
class Offer:
    """What an entry point names.

    Attributes:
        value: the class, function or module.
        package: name and version of its package, and a digest of the code; results
            record it.
        source: the entry point and its package, for messages.
    """

    value: Any
    package: str
    source: str

    def subclass(self, base: type[_T], name: str) -> type[_T]:
        """Return the value.

        Raises:
            InputError: it is no subclass of a base whose attribute ``kind`` is a
                `Literal` of this name, or it lacks methods.
        """
        if not (isinstance(kind := self.value, type) and issubclass(kind, base)):
            raise self.refuse(f"is {kind!r}, no subclass of {base.__name__}")
        if inspect.isabstract(kind):
            missing = ", ".join(sorted(vars(kind)["__abstractmethods__"]))
            raise self.refuse(f"{kind.__name__} has no {missing}")
        if get_args(get_type_hints(kind).get("kind")) != (name,):
            raise self.refuse(f'{kind.__name__} needs kind: Literal["{name}"]')
        return kind

    def refuse(self, reason: str) -> InputError:
        """Return the error that a value of another type is."""
        return InputError(f"{self.source}: {reason}; correct or uninstall this package")


def names(group: str) -> list[str]:
    """Return what other packages offer in a group, sorted."""
    return sorted({point.name for point in entry_points(group=group)})


def find(group: str, name: str, known: Iterable[str], where: str = "is ") -> Offer:
    """Import what another package offers under a name.

    Args:
        group: of entry points.
        name: of the entry point.
        known: names that this package has, for the message.
        where: begins the message of an unknown name.

    Raises:
        InputError: no package offers it, several do, or it cannot be imported.
    """
    if name not in (offered := names(group)):
        others = f", or of other packages {', '.join(offered)}" if offered else ""
        raise InputError(f"{where}{name!r}; one of {', '.join(known)}{others}")
    return _load(group, name)


def register_plugin(name: str) -> bool:
    """Let another package register its Mitsuba plugin for the active variant.

    Returns:
        whether a package offers a plugin of this type.

    Raises:
        InputError: the module cannot be imported, or the entry point names no module.
    """
    if name not in names(PLUGINS):
        return False
    (point, *_) = entry_points(group=PLUGINS, name=name)
    before = sys.modules.get(point.module)
    offer = _load(PLUGINS, name)
    if not isinstance(offer.value, ModuleType):
        raise offer.refuse("is no module; name one that registers the plugin")
    if before is not None:  # for another variant: base classes are its own
        with _reported(offer.source):
            importlib.reload(offer.value)
    return True


def plugin_packages(types: Sequence[str]) -> str:
    """Return the packages that offer Mitsuba plugins of these types; "" for none."""
    plugins = sorted(set(types) & set(names(PLUGINS)))
    return ", ".join(_load(PLUGINS, name).package for name in plugins)


class _reported:
    """Turns what another package raises into an error that names the package."""

    def __init__(self, source: str) -> None:
        self.source = source

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, Exception) and not is_interrupt(error):
            raise InputError(
                f"{self.source}: importing it raised {type(error).__name__}: {error}; "
                "repair or uninstall this package"
            ) from error


@functools.cache
def _load(group: str, name: str) -> Offer:
    points = list(entry_points(group=group, name=name))
    source = f"entry point {name!r} of {group} ({_described(points[0])})"
    if len({point.value for point in points}) > 1:
        several = " and ".join(_described(point) for point in points)
        raise InputError(
            f"entry point {name!r} of {group}: {several} offer it; uninstall one"
        )
    with _reported(source):
        value = points[0].load()
    code = _digest(sys.modules[points[0].module])
    return Offer(value, f"{_described(points[0])}, code {code}", source)


def _described(point: EntryPoint) -> str:
    """Return name and version of the package that an entry point is of."""
    return f"{point.dist.name} {point.dist.version}" if point.dist else "no package"


def _digest(module: ModuleType) -> str:
    """Hash the Python files of a module's folder, or of a module without a package."""
    total, file = hashlib.sha256(), Path(module.__file__ or "")
    paths = sorted(file.parent.rglob("*.py")) if module.__package__ else [file]
    for path in paths:
        total.update(path.read_bytes())
    return total.hexdigest()[:12]
