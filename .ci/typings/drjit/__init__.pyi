"""Dr.Jit for the type checker, in place of stubs that are wrong about our use.

Its own know neither arithmetic between array types (`Float * Color3f`) nor PyTrees, and
take Mitsuba's `Float` and the `Float` of Mitsuba's functions for two types. Here each
array type is a class of its own, so that functions are held to those they name, and
what arithmetic and the functions of Dr.Jit return may be any of them.
tests/backend/test_foreign_names.py holds the names used to the installed version.
"""

from collections.abc import Iterator
from typing import Any, Generic, TypeVar

_Self = TypeVar("_Self")
_SelfCp = TypeVar("_SelfCp")
_Val = TypeVar("_Val")
_ValCp = TypeVar("_ValCp")
_Red = TypeVar("_Red")
_Plain = TypeVar("_Plain")
_Mask = TypeVar("_Mask")

def __getattr__(name: str) -> Any: ...

class ArrayBase(Generic[_Self, _SelfCp, _Val, _ValCp, _Red, _Plain, _Mask]):
    def __init__(self, *args: Any, **kwargs: Any) -> None: ...
    def __getitem__(self, key: Any) -> Any: ...
    def __setitem__(self, key: Any, value: Any) -> None: ...
    def __iter__(self) -> Iterator[Any]: ...
    def __len__(self) -> int: ...
    def __float__(self) -> float: ...
    def __int__(self) -> int: ...
    def __bool__(self) -> bool: ...
    def _one(self) -> Any: ...
    __neg__ = __pos__ = __invert__ = __abs__ = __array__ = _one
    def _two(self, other: Any, /) -> Any: ...
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = _two
    __add__ = __sub__ = __mul__ = __truediv__ = __floordiv__ = __mod__ = __pow__ = _two
    __radd__ = __rsub__ = __rmul__ = __rtruediv__ = __rfloordiv__ = __rmod__ = _two
    __and__ = __or__ = __xor__ = __lshift__ = __rshift__ = __matmul__ = _two
    __rand__ = __ror__ = __rxor__ = __rlshift__ = __rrshift__ = __rmatmul__ = _two
    x: Any
    y: Any
    z: Any
    w: Any
    array: Any
    shape: Any
    state: Any
    numpy: Any
    torch: Any
