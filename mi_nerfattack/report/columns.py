"""A table for a terminal of 80 columns and for pages, from one list of columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from string import Formatter
from typing import Any, NamedTuple

import rich.box
import rich.table

_WIDTH = 19  # of labels in a terminal, characters


class Cell(NamedTuple):
    """What a page shows in a cell: text, soft text after it, how it looks."""

    text: str
    soft: str = ""
    bad: bool = False
    code: bool = False
    style: str = ""


@dataclass(frozen=True)
class Column:
    """A column of a table: its name, and the value that it shows of a record.

    A value is a text, a number, the two ends of an interval, or None.

    Attributes:
        header: name.
        value: keys of the value in a record, such as ``attack.wheel_out_s``, or a
            function of the record. Three keys are a count, a total, and the ends of an
            interval of the share. A text with braces is a format, such as
            ``{psnr_db:.2f}``. In a format None gives no text, an undefined number a
            dash, and a pair "a to b". The type ``%`` gives a number of percent without
            the sign. `bad` of the record has the headers of columns in which the record
            is not good enough.
        digits: of numbers, after the point.
        short: name in a terminal; the header by default.
        page: whether a page shows it.
        terminal: whether a terminal shows it.
        bad: whether a value that is not 0 speaks against the policy.
    """

    header: str
    value: str | tuple[str, str, str] | Callable[[Any], Any]
    digits: int = 3
    short: str = ""
    page: bool = True
    terminal: bool = True
    bad: bool = False

    def of(self, record: Any) -> Any:
        """Return its value in a record; None where keys are missing."""
        if callable(self.value):
            return self.value(record)
        if isinstance(self.value, tuple):
            return tuple(_at(record, keys) for keys in self.value)
        if "{" in self.value:
            text = _FORMATTER.vformat(self.value, (), record)
            return Cell(text, bad=self.header in record.get("bad", ()))
        return _at(record, self.value)

    def plain(self, record: Any) -> str:
        """Return what a terminal shows, and a label."""
        value = self.of(record)
        if isinstance(value, Cell):
            return value.text
        if isinstance(value, tuple):
            some, total, ends = value
            interval = "" if ends is None else f" {[round(100 * end) for end in ends]}"
            return "" if some is None else f"{some}/{total}{interval}"
        if isinstance(value, list):
            return "[" + ", ".join(f"{end:.{self.digits}f}" for end in value) + "]"
        return "" if value is None else _text(value, self.digits)

    def cell(self, record: Any) -> Cell:
        """Return what a page shows."""
        value = self.of(record)
        if isinstance(value, Cell):
            return value
        if isinstance(value, tuple):
            some, total, ends = value
            if some is None:
                return Cell("–")
            soft = "" if ends is None else f"{_ends([100 * e for e in ends], 0)} %"
            return Cell(f"{some}/{total}", soft, self.bad and some > 0)
        if isinstance(value, list):
            return Cell(_ends(value, self.digits))
        text = "–" if value is None else _text(value, self.digits)
        return Cell(text, bad=self.bad and bool(value))


@dataclass(frozen=True)
class Table:
    """Records by columns.

    Attributes:
        title: in a terminal.
        labels: columns of names; one that stays, with all before it, is not repeated.
        figures: other columns.
        records: rows.
        heading: the first so many labels are a line of their own in a terminal.
        caption: on a page.
    """

    title: str
    labels: Sequence[Column]
    figures: Sequence[Column]
    records: Sequence[Any]
    heading: int = 0
    caption: str = ""

    @staticmethod
    def of(records: Iterable[Any], columns: Sequence[Column]) -> Table:
        """Make a table without a title; the first column is the label."""
        return Table("", columns[:1], columns[1:], records=list(records))

    @property
    def shown(self) -> list[Column]:
        """Figures of a page."""
        return [column for column in self.figures if column.page]

    @property
    def body(self) -> Iterator[tuple[bool, list[str], list[Cell]]]:
        """Rows of a page: whether a group begins, labels, cells."""
        for new, names, record in self._rows():
            yield (
                new < self._groups,
                names,
                [column.cell(record) for column in self.shown],
            )

    def __rich__(self) -> rich.table.Table:
        figures = [column for column in self.figures if column.terminal]
        table = rich.table.Table(
            title=self.title,
            box=rich.box.SIMPLE_HEAD,
            pad_edge=False,
            padding=(0, int(len(figures) < 7)),
        )
        width = _WIDTH if self._groups else None
        for column in self.labels[self.heading :]:
            table.add_column(column.header, overflow="fold", max_width=width)
        for column in figures:
            name = column.short or column.header
            table.add_column(name, justify="right", no_wrap=True)
        above = self.labels[: self.heading]
        for new, names, record in self._rows():
            if new < max(self.heading, self._groups):
                table.add_section()
            if new < self.heading:
                table.add_row(" ".join(column.plain(record) for column in above))
            own = [" " * bool(above) + name for name in names[self.heading :]]
            table.add_row(*own, *(column.plain(record) for column in figures))
        return table

    @property
    def _groups(self) -> bool:
        """Whether the first label begins groups."""
        return len(self.labels) > 1

    def _rows(self) -> Iterator[tuple[int, list[str], Any]]:
        """Yield the first label that changes, labels that are shown, the record."""
        before: list[str] = []
        for record in self.records:
            names = [column.plain(record) for column in self.labels]
            same = 0
            while before and same < len(names) - 1 and names[same] == before[same]:
                same += 1
            yield same, [""] * same + names[same:], record
            before = names


class _Formatter(Formatter):
    """Formats what may be unknown; see `Column`."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None:
            return ""
        if isinstance(value, list | tuple):
            return " to ".join(self.format_field(v, format_spec) for v in value)
        if isinstance(value, float) and not math.isfinite(value):
            return "–" if math.isnan(value) else "∞"
        if format_spec.endswith("%"):
            value, format_spec = 100 * value, f"{format_spec[:-1]}f"
        return format(value, format_spec)


_FORMATTER = _Formatter()


def _at(record: Any, keys: str) -> Any:
    for key in keys.split("."):
        record = None if record is None else record.get(key)
    return record


def _text(value: Any, digits: int) -> str:
    return f"{value:,.{digits}f}" if isinstance(value, float) else str(value)


def _ends(ends: Sequence[float], digits: int) -> str:
    return f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}"
