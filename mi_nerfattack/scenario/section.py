"""Tables of a scenario file as strict models, and unions of them told by a key.

A key such as ``model`` of ``[vehicle]`` chooses which other keys the table has. Each
choice is a :class:`Section` with a `Literal` for that key; :class:`Kinds` marks their
union. Where several keys choose in one table (``kind`` and ``reduction`` of
``[objective]``), each union is a field of its own, whose alias stands in parentheses:
its keys lie *flat*, among those of the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NoReturn, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)
from pydantic_core import (
    CoreSchema,
    InitErrorDetails,
    PydanticCustomError,
)
from pydantic_core.core_schema import with_info_plain_validator_function

from mi_nerfattack.errors import InputError

Trust = Annotated[bool, Field(exclude=True)]  # results do not depend on it

_Value = TypeVar("_Value")
#: Keys and indices that lead to a value of the file.
Location = tuple[str | int, ...]

_WORDS = {"tuple_type": "must be an array", "model_type": "must be a table"}


class Section(BaseModel):
    """A table of the file, or the keys of one kind in it; unknown keys are refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, strict=True
    )

    #: Keys that came when there were scenarios already. At their defaults they do not
    #: count, so that what was made before them is still known by its digest.
    later: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the keys of the table and their defaults; of kinds, the first's."""
        found: dict[str, Any] = {}
        for name, field in cls.model_fields.items():
            flat = field.validation_alias is not None
            found |= _defaults(get_args(field.annotation)) if flat else {}
            found |= {} if flat else {name: field.default}
        return found

    def leaves(self) -> Iterator[tuple[Location, Any]]:
        """Yield the location of each value that counts, and the value."""
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if field.exclude or (name in self.later and value == field.default):
                continue
            if isinstance(value, Section):
                location = () if field.validation_alias else (name,)
                yield from ((location + rest, leaf) for rest, leaf in value.leaves())
            elif isinstance(value, tuple) and value and isinstance(value[0], Section):
                for index, item in enumerate(value):
                    for rest, leaf in item.leaves():
                        yield (name, index, *rest), leaf
            else:
                yield (name,), value

    @model_validator(mode="wrap")
    @classmethod
    def _gather(cls, data: Any, handler: Callable[[Any], Any]) -> Any:
        """Refuse unknown keys, and put those of each flat union under its alias."""
        if not isinstance(data, dict):
            return handler(data)
        known = cls.defaults()
        problem = f"unknown key; allowed: {', '.join(known)}"
        unknown = {key: problem for key in data if key not in known}
        data = {k: _frozen(v) for k, v in data.items() if k in known}
        for field in cls.model_fields.values():
            if isinstance(alias := field.validation_alias, str):
                keys = _defaults(get_args(field.annotation)).keys() & data.keys()
                data[alias] = {key: data.pop(key) for key in keys}
        return _with(unknown, lambda: handler(data))

    @model_serializer(mode="wrap")
    def _spread(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write flat unions as they are read."""
        values = handler(self)
        for name, field in type(self).model_fields.items():
            if field.validation_alias is not None and name in values:
                values |= values.pop(name)
        return values


@dataclass(frozen=True)
class Kinds:
    """Mark a union of sections that differ in the value of a key.

    Without the key it is the first. Keys of the others are refused.

    Args:
        key: that tells them apart.
    """

    key: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return a schema that chooses the section."""
        return with_info_plain_validator_function(
            lambda data, info: self._read(get_args(source), data, info)
        )

    def _read(
        self, members: tuple[type[Section], ...], data: Any, info: ValidationInfo
    ) -> Section:
        if isinstance(data, Section):
            return data
        if not isinstance(data, dict):
            return members[0].model_validate(data)
        given = data.get(self.key)
        chosen = [m for m in members if given is not None and given in self._values(m)]
        if given is not None and not chosen:
            allowed = _either(self._values(*members))
            refuse(self.key, f"must be {allowed} (is {given!r})")
        member = [*chosen, *members][0]
        own, others = member.defaults(), _defaults(members)
        value, wrong = own[self.key] if given is None else given, {}
        here, without = f'{self.key} = "{value}"', f"without {self.key}"
        for key in [key for key in data if key in others and key not in own]:
            having = [member for member in members if key in member.defaults()]
            wrong[key] = (
                f"has no meaning {f'with {here}' if value else without}; leave it "
                f"out, or set {self.key} to {_either(self._values(*having))}"
            )
        for key, field in member.model_fields.items():
            if field.is_required() and key not in data:
                wrong[key] = f"is missing; {here} needs it"
        kept = {k: v for k, v in data.items() if k in own or k not in others}
        return _with(wrong, lambda: member.model_validate(kept, context=info.context))

    def _values(self, *members: type[Section]) -> tuple[str | None, ...]:
        fields = [member.model_fields[self.key] for member in members]
        return tuple(value for field in fields for value in get_args(field.annotation))


def refuse(key: str, reason: str) -> NoReturn:
    """Raise an error of a key that a check of the whole section found."""
    way = tuple(int(part) if part.isdigit() else part for part in key.split("."))
    raise ValidationError.from_exception_data("", [_error(way, reason)])


def _with(reasons: Mapping[str, str], validate: Callable[[], _Value]) -> _Value:
    """Validate, and raise what is wrong together with further reasons, by key."""
    errors = [_error((key,), reason) for key, reason in reasons.items()]
    try:
        result = validate()
    except ValidationError as err:
        errors += [
            _error(error["loc"], error["msg"], error["type"], error["input"])
            for error in err.errors()
            if error["loc"][:1] not in {(key,) for key in reasons}
        ]
    else:
        if not errors:
            return result
    raise ValidationError.from_exception_data("", errors)


def _error(
    location: Location, message: str, kind: Any = "told", value: Any = None
) -> InitErrorDetails:
    error = PydanticCustomError(kind, "{why}", {"why": message})
    return InitErrorDetails(type=error, loc=location, input=value)


def read_section(name: str, kind: Any, values: Any, folder: str | Path) -> Any:
    """Check a table that stands alone.

    Args:
        name: of its file and its own, for messages.
        kind: a section, or a union of them.
        values: the table.
        folder: that its paths start from.

    Raises:
        InputError: a key is unknown, missing, of the wrong type or out of range.
    """
    try:
        return TypeAdapter(kind).validate_python(values, context={"folder": folder})
    except ValidationError as err:
        lines = [f"{'.'.join([name, *map(str, p)])}: {why}" for p, why in problems(err)]
        raise InputError("\n".join(lines)) from err


def problems(err: ValidationError) -> Iterator[tuple[Location, str]]:
    """Yield the keys that lead to each problem, and what is wrong."""
    found = err.errors()
    lists = {error["loc"][:1] for error in found if len(error["loc"]) > 1}
    for error in found:
        kind, location = error["type"], error["loc"]
        if kind == "too_short" and location in lists:
            continue  # its only item is wrong, and told
        message = _WORDS.get(kind, error["msg"])
        given = "" if kind in ("told", "missing") else f" (is {error['input']!r})"
        keys = tuple(part for part in location if not str(part).startswith("("))
        yield keys or location, message[0].lower() + message[1:] + given


def _defaults(members: Iterable[type[Section]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for member in members:
        found = {**member.defaults(), **found}
    return found


def _either(values: Iterable[str | None]) -> str:
    return " or ".join(f'"{value}"' for value in values if value)


def _frozen(value: Any) -> Any:
    """Make tuples of lists, which strict models take."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
