"""How Mitsuba 3.10 finds Python plugins, put into the Mitsuba that is installed.

https://mitsuba.readthedocs.io, "Distributing Python plugins": Mitsuba imports the
modules that entry points of the group `mitsuba` name, in the order of the entry points'
names, the first time that a variant becomes active. It reloads these modules after
every change of variant. MI_DISABLE_AUTOLOAD skips the search.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from collections.abc import Callable
from types import ModuleType

import mitsuba as mi

Callback = Callable[[str | None, str], None]


class Discovery:
    """Takes over changes of variant, and the callbacks that packages register.

    Args:
        callbacks_first: whether callbacks run before modules are imported or reloaded.
    """

    def __init__(self, callbacks_first: bool) -> None:
        self._callbacks_first = callbacks_first
        self._callbacks: dict[Callback, None] = {}  # in the order of registration
        self._modules: list[ModuleType] | None = None
        self._set_variant = mi.set_variant
        mi.set_variant = self.set_variant
        mi.detail.add_variant_callback = self._callbacks.setdefault
        mi.detail.clear_variant_callbacks = self._callbacks.clear

    def set_variant(self, name: str) -> None:
        before = mi.variant()
        self._set_variant(name)
        if name == before:
            return
        if not self._callbacks_first:
            self._load()
        for callback in list(self._callbacks):
            callback(before, name)
        if self._callbacks_first:
            self._load()

    def _load(self) -> None:
        if self._modules is not None:
            for module in self._modules:
                importlib.reload(module)
            return
        self._modules = []
        if os.environ.get("MI_DISABLE_AUTOLOAD"):
            return
        points = importlib.metadata.entry_points(group="mitsuba")
        for point in sorted(points, key=lambda point: point.name):
            self._modules.append(importlib.import_module(point.value))
