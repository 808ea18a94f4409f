"""The machine: cores, memory, processes, interrupts."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .workers import InThisProcess as InThisProcess
    from .workers import Processes as Processes
    from .workers import available_cores as available_cores

__getattr__, __dir__ = lazy(__name__)
