"""Ranges of numbers as types, and dataclasses that hold their fields to them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema

from mi_nerfattack.errors import InputError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Negative = Annotated[float, Field(lt=0, allow_inf_nan=False)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False, description=", seconds")]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
SomeShare = Annotated[float, Field(gt=0, le=1)]
Acute = Annotated[float, Field(gt=0, lt=math.pi / 2, description=", radians")]
Natural = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=1 << 31)]
Name = Annotated[str, Field(min_length=1, description="a name, not empty")]
ControlUnit = Annotated[
    str, Field(pattern="^rad(/s)?$", description="'rad/s' or 'rad'")
]
Facing = Annotated[
    str,
    Field(
        pattern="^(shape|along|traffic)$",
        description="'shape', 'along' or 'traffic'",
    ),
]
CarUnit = Annotated[
    str, Field(pattern="^(rad(/s)?|other)$", description="'rad/s', 'rad' or 'other'")
]

_T = TypeVar("_T")
_STRICT = ConfigDict(extra="forbid", strict=True)


def checked(owner: str = "") -> Callable[[type[_T]], type[_T]]:
    """Let a dataclass check its fields when an object is made.

    Write ``@dataclass`` above it, so that the dataclass's ``__init__`` runs the check.

    A field whose type is a range or a kind of word, or a mapping or alternative with
    one, raises `InputError` for another type or a value outside. A `__post_init__` of
    the class comes afterwards.

    Args:
        owner: what the message calls the object, ``owner.field``; a format string
            with the object as ``self``.
    """

    def decorate(cls: type[_T]) -> type[_T]:
        further = cls.__dict__.get("__post_init__")

        def check(self: Any) -> None:
            for name, (hint, adapter) in _ranges(cls).items():
                value = getattr(self, name)
                plain = value.item() if isinstance(value, np.generic) else value
                try:
                    adapter.validate_python(plain, strict=True)
                except ValidationError as err:
                    where = f"{owner.format(self=self)}.{name}" if owner else name
                    problem = f"{value!r}; must be {_allowed(hint)}"
                    raise InputError(f"{where}: {problem}") from err
            if further is not None:
                further(self)

        checked_class: Any = cls
        checked_class.__post_init__ = check
        checked_class.__pydantic_config__ = _STRICT
        checked_class.__get_pydantic_core_schema__ = classmethod(_from_table)
        return cls

    return decorate


def _from_table(cls: type, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
    """Let a scenario's table give the fields: each strict, the object made of them."""
    schema = handler(source)
    resolved_schema: Any = handler.resolve_ref_schema(schema)
    resolved_schema["strict"] = False
    return schema


@cache
def _ranges(cls: type) -> dict[str, tuple[Any, TypeAdapter[Any]]]:
    hints = get_type_hints(cls, include_extras=True)
    return {n: (h, TypeAdapter(h)) for n, h in hints.items() if _range(h) is not None}


def _range(hint: Any) -> Any:
    """Return the range in a type, None where there is none."""
    if get_origin(hint) is Annotated:
        return hint
    return next(filter(None, map(_range, get_args(hint))), None)


def _allowed(hint: Any) -> str:
    kind, field = get_args(_range(hint))
    if kind is str:
        return field.description
    noun = "a whole number" if kind is int else "a finite number"
    unit = field.description or ""
    limits = {n: getattr(m, n) for m in field.metadata for n in _SIGNS if hasattr(m, n)}
    if len(limits) == 2:
        (low, least), (high, most) = limits.items()
        interval = f"{_SIGNS[low]}{least:.10g}, {most:.10g}{_SIGNS[high]}"
        return f"{noun} in {interval}{unit}"
    words = {"gt": " above ", "ge": " of at least ", "lt": " below "}
    return noun + "".join(f"{words[n]}{limit}" for n, limit in limits.items()) + unit


_SIGNS = {"gt": "(", "ge": "[", "lt": ")", "le": "]"}
