"""Tables of what is refused: one test per reader, one row per reason."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mi_nerfattack.errors import InputError


def refusals(*rows: tuple[Callable[..., Any], str]) -> Callable[..., None]:
    """Make a test of calls, each of which must be refused.

    Args:
        rows: a call that takes nothing, or the test's folder, and a pattern that the
            message must contain.
    """

    @pytest.mark.parametrize(("call", "message"), rows)
    def test(call: Callable[..., Any], message: str, tmp_path: Path) -> None:
        parameters = inspect.signature(call).parameters.values()
        takes_folder = any(item.default is item.empty for item in parameters)
        arguments = [tmp_path] if takes_folder else []
        with pytest.raises(InputError, match=message):
            call(*arguments)

    return test


@contextmanager
def refused_at(where: object, *named: str) -> Iterator[None]:
    """Check that what is done is refused, where the error says, and what it names.

    Args:
        where: file or parameter; the end of `InputError.where`.
        named: numbers and names that the message must hold.
    """
    with pytest.raises(InputError) as refused:
        yield
    assert refused.value.where.endswith(str(where)), refused.value
    assert all(word in str(refused.value) for word in named), refused.value
