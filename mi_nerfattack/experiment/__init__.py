"""One attack as a job: stages, run folder, results."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .job import Job as Job

__getattr__, __dir__ = lazy(__name__)
