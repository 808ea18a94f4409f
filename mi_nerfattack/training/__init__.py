"""Collecting frames, imitation, DAgger."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .collect import CollectSettings as CollectSettings
    from .collect import find_shards as find_shards
    from .dataset import FrameDataset as FrameDataset
    from .settings import ImitationSettings as ImitationSettings
    from .sources import AbstractSource as AbstractSource
    from .sources import ExpertDrives as ExpertDrives
    from .sources import Mixture as Mixture
    from .sources import PolicyDrives as PolicyDrives
    from .sources import Scattered as Scattered
    from .train import TrainSettings as TrainSettings
    from .train import fit_policy as fit_policy

__getattr__, __dir__ = lazy(__name__)
