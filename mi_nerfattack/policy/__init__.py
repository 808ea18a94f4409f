"""Image-based driving policies: network, adapter, training. Imports torch."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .base import AbstractPolicy as AbstractPolicy
    from .black_box import AbstractBlackBox as AbstractBlackBox
    from .black_box import CallablePolicy as CallablePolicy
    from .drjit_network import DrJitNetwork as DrJitNetwork
    from .exported.program import export_program as export_program
    from .http_policy import HttpPolicy as HttpPolicy
    from .pilotnet import PilotNet as PilotNet
    from .preprocess import Preprocess as Preprocess
    from .torch_policy import TorchPolicy as TorchPolicy

__getattr__, __dir__ = lazy(__name__)
