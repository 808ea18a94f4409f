"""What an ONNX operator gets: its inputs and attributes, checked on access."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from mi_nerfattack.errors import InputError


@dataclass(frozen=True)
class Call:
    """One node that is evaluated.

    Attributes:
        operator: its name, for messages.
        inputs: None where an optional one is left out.
        attributes: by name; strings as str, tensors as torch's.
        opset: version of the operator set.
        dtype: precision of floating numbers in this evaluation.
        device: where the image is.
    """

    operator: str
    inputs: Sequence[torch.Tensor | None]
    attributes: Mapping[str, Any]
    opset: int
    dtype: torch.dtype
    device: torch.device

    @property
    def x(self) -> torch.Tensor:
        """The first input."""
        return self.need(0)

    def need(self, index: int) -> torch.Tensor:
        """Return an input that must be there."""
        value = self.get(index)
        if value is None:
            raise InputError(f"{self.operator}: input {index} is missing")
        return value

    def get(self, index: int) -> torch.Tensor | None:
        """Return an optional input."""
        return self.inputs[index] if index < len(self.inputs) else None

    def attribute(self, name: str, default: Any = None) -> Any:
        """Return an attribute."""
        return self.attributes.get(name, default)

    def integers(self, index: int, name: str) -> list[int] | None:
        """Return integers from an input or, in older versions, an attribute."""
        value = self.get(index)
        if value is not None:
            return [int(v) for v in value.flatten().tolist()]
        attribute = self.attributes.get(name)
        return None if attribute is None else [int(v) for v in attribute]

    def number(self, index: int, name: str) -> float | None:
        """Return a number from an input or, in older versions, an attribute."""
        value = self.get(index)
        return self.attributes.get(name) if value is None else float(value)

    def only(self, name: str, *allowed: Any) -> None:
        """Refuse an attribute with another value than these."""
        value = self.attributes.get(name)
        if value is not None and value not in allowed:
            raise InputError(
                f"{self.operator}: {name} = {value!r} is not supported; "
                f"{' or '.join(map(repr, allowed))} is"
            )


#: Value, or values, of a node.
Result = torch.Tensor | tuple[torch.Tensor, ...]
Operator = Callable[[Call], Result]
