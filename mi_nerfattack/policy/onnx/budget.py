"""A limit for the values of an evaluation, checked before each is made."""

from __future__ import annotations

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map

from mi_nerfattack.errors import InputError


class Budget(TorchDispatchMode):
    """Refuses what makes more than so many bytes of values; a context manager.

    The size of a value is found by making it without memory, on torch's device
    ``meta``. Costs about 0.1 ms an operation.

    Args:
        limit: bytes.
    """

    def __init__(self, limit: int) -> None:
        super().__init__()
        self.limit = self.left = limit

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # its import takes seconds

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Judge an operation, and do it."""
        kwargs = kwargs or {}
        if not func.is_view:
            without = {**kwargs, "device": _META} if "device" in kwargs else kwargs
            try:
                made = func(*tree_map(_meta, args), **tree_map(_meta, without))
            except (RuntimeError, TypeError, ValueError):
                made = ()  # the operation itself tells, or its size is of its values
            for value in tree_iter(made):
                if isinstance(value, torch.Tensor):
                    self.left -= value.numel() * value.element_size()
            if self.left < 0:
                raise InputError(
                    f"its values take more than {self.limit / 1e9:.1f} GB for these "
                    "images; export a smaller network, or give fewer or smaller images"
                )
        return func(*args, **kwargs)


_META = torch.device("meta")


def _meta(value: Any) -> Any:
    return value.to(_META) if isinstance(value, torch.Tensor) else value
