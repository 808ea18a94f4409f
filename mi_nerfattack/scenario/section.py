"""Tables of a scenario file as strict models, and unions that ``kind`` chooses from.

The key ``kind`` of a table such as ``[vehicle]`` chooses which other keys the table
has. Each choice is a :class:`Section`, or the dataclass that is built, with a `Literal`
called ``kind``; :class:`Kinds` marks their union. The table ``[camera]`` is here
because a real car reads it, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, is_dataclass, replace
from inspect import signature
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NoReturn,
    TypeVar,
    get_args,
    get_type_hints,
)

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PrivateAttr,
    Tag,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    WrapValidator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import (
    CoreSchema,
    ErrorDetails,
    InitErrorDetails,
    PydanticCustomError,
    core_schema,
)

from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Count, Finite, Positive
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig

Trust = Annotated[bool, Field(exclude=True)]  # results do not depend on it

#: Of a control: a heading rate, a steering angle, or another quantity.
Unit = Literal["rad/s", "rad", "other"]

#: Keys and indices that lead to a value of the file.
Location = tuple[str | int, ...]

_Reader = Callable[[Any], Any]
_WORDS = {"tuple_type": "must be an array", "model_type": "must be a table"}
_UNKNOWN = ("unknown", "unexpected_keyword_argument")
_WORDS |= {"model_attributes_type": "must be a table", "missing": "is missing"}


class Section(BaseModel):
    """A table of the file, or one kind of it; unknown keys are refused."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, strict=True
    )
    #: Keys that do not count at their defaults: digests from before them stay.
    later: ClassVar[tuple[str, ...]] = ()
    #: Entry points by which other packages offer kinds; "" where they cannot.
    group: ClassVar[str] = ""
    _package: str = PrivateAttr("")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the keys of the table and their defaults."""
        return {name: field.default for name, field in cls.model_fields.items()}

    @property
    def package(self) -> str:
        """Name and version of the other package that offers this kind, or ""."""
        return self._package

    @classmethod
    def offered(cls, name: str, known: Iterable[str]) -> tuple[type[Section], str]:
        """Return another package's class, and the package; as `find`, it raises."""
        from mi_nerfattack.system import entry_points

        offer = entry_points.find(cls.group, name, known)
        return offer.subclass(cls, name), offer.package

    def leaves(self) -> Iterator[tuple[Location, Any]]:
        """Yield the location of each value that counts, and the value."""
        yield from _leaves((), self)

    @model_validator(mode="wrap")
    @classmethod
    def _read(cls, data: Any, handler: _Reader) -> Any:
        """Make tuples of lists, which strict models take; say which keys there are."""
        if not isinstance(data, dict):
            return handler(data)

        def reword(error: ErrorDetails) -> tuple[str, Location, str]:
            location = error["loc"]
            if error["type"] == "extra_forbidden" and len(location) == 1:
                keys = ", ".join(cls.model_fields)
                return "unknown", location, f"unknown key; allowed: {keys}"
            return error["type"], location, error["msg"]

        return _reworded(lambda: handler(_frozen(data)), reword)


def _untagged(data: Any, read: _Reader) -> Any:
    def reword(error: ErrorDetails) -> tuple[str, Location, str]:
        return error["type"], error["loc"][1:], error["msg"]

    return _reworded(lambda: read(data), reword)


#: Marks a union with a `Discriminator` whose tags are no keys of the file.
UNTAGGED = WrapValidator(_untagged)


@dataclass(frozen=True)
class Kinds:
    """Mark a union of sections and dataclasses that differ in their ``kind``.

    Args:
        default: the kind of a table without the key; or a function that derives the
            kind from the other keys.
        family: section whose `group` names entry points of further kinds.
    """

    default: str | Callable[[dict[str, Any]], str] | None = None
    family: type[Section] = Section

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return a schema that chooses by the kind, and always writes it."""
        union = Annotated[source, Field(discriminator="kind")]
        return core_schema.with_info_wrap_validator_function(
            lambda data, read, info: self._read(get_args(source), data, read, info),
            handler.generate_schema(union),
            serialization=core_schema.wrap_serializer_function_ser_schema(
                _written, info_arg=True, schema=handler.generate_schema(union)
            ),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Require the key of all kinds but the default."""
        json_schema = handler(schema)
        if callable(self.default):
            return {"anyOf": json_schema["oneOf"]}
        default = json_schema["discriminator"]["mapping"].get(self.default)
        others = [item for item in json_schema["oneOf"] if item["$ref"] != default]
        kinds = [item | {"required": ["kind"]} for item in others]
        return {"oneOf": [*([{"$ref": default}] if default else []), *kinds]}

    def _read(
        self, members: tuple[Any, ...], data: Any, read: _Reader, info: ValidationInfo
    ) -> Any:
        if isinstance(data, dict) and data.get("kind") is None:
            kind = self.default(data) if callable(self.default) else self.default
            data = {"kind": kind, **{k: v for k, v in data.items() if k != "kind"}}
        known = [kind for member in members for kind in _kinds_of(member)]
        kind = data["kind"] if isinstance(data, dict) else getattr(data, "kind", None)
        if self.family.group and isinstance(kind, str) and kind not in known:
            try:
                return read_offered(self.family, data, known, info.context)
            except InputError as err:
                refuse("kind", str(err))

        def reword(error: ErrorDetails) -> tuple[str, Location, str]:
            what, location, message = error["type"], error["loc"], error["msg"]
            if what == "union_tag_invalid":
                allowed = error.get("ctx", {})["expected_tags"].replace("'", '"')
                problem = f"is {data['kind']!r}" if data["kind"] else "is missing"
                return "told", ("kind",), f"{problem}; one of {allowed}"
            if len(location) == 2 and what in ("missing", *_UNKNOWN):
                message, what = _key_problem(members, what, *map(str, location)), "told"
            return what, location[1:], message

        return _reworded(lambda: read(data), reword)


def read_offered(
    family: type[Section], data: Any, known: Iterable[str] = (), context: Any = None
) -> Any:
    """Make a section of another package of a table; see :meth:`Section.offered`."""
    if isinstance(data, family):
        return data
    kind, package = family.offered(data["kind"], known)
    section = kind.model_validate(data, context=context)
    section._package = package
    return section


def _written(value: Any, write: _Reader, info: Any) -> dict[str, Any]:
    """Write a section with its kind, whatever its defaults."""
    kind, options = {"kind": value.kind}, {"exclude_defaults": info.exclude_defaults}
    if isinstance(value, Section) and value.package:  # no member of the union
        values = value.model_dump(mode=info.mode, **options)
        return kind | values | {"package": value.package}
    return kind | write(value)


_T = TypeVar("_T")
#: A value, or an array of such.
OneOrSeveral = Annotated[
    Annotated[_T, Tag("one")]
    | Annotated[tuple[_T, ...], Field(min_length=1), Tag("several")],
    Discriminator(lambda value: "several" if isinstance(value, tuple) else "one"),
    UNTAGGED,
]


def refuse(key: str, reason: str) -> NoReturn:
    """Raise an error of a key that a check of the whole section found."""
    way = tuple(int(part) if part.isdigit() else part for part in key.split("."))
    raise ValidationError.from_exception_data("", [_error(way, reason)])


def _reworded(
    read: Callable[[], Any],
    reword: Callable[[ErrorDetails], tuple[str, Location, str]],
) -> Any:
    """Read a value, and raise its errors with other types, locations and messages."""
    try:
        return read()
    except ValidationError as err:
        reworded = [(*reword(error), error["input"]) for error in err.errors()]
        errors = [_error(way, text, kind, value) for kind, way, text, value in reworded]
        raise ValidationError.from_exception_data("", errors) from None


def _key_problem(members: tuple[Any, ...], what: str, kind: str, key: str) -> str:
    """Say what is wrong with a key that a kind needs, or does not have."""
    line = f'kind = "{kind}"'
    if what == "missing":
        return f"is missing; {line} needs it"
    keys = {member: list(signature(member).parameters) for member in members}
    allowed = ", ".join(next(keys[m] for m in members if kind in _kinds_of(m)))
    having = [f'"{k}"' for m in members if key in keys[m] for k in _kinds_of(m)]
    if not having:
        return f"unknown key; allowed with {line}: {allowed}"
    others = " or ".join(having)
    return f"has no meaning with {line}, which allows {allowed}; set kind to {others}"


def _kinds_of(member: Any) -> tuple[str, ...]:
    return get_args(get_type_hints(member).get("kind"))


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
    details = err.errors()
    lists = {error["loc"][:1] for error in details if len(error["loc"]) > 1}
    for error in details:
        kind, location = error["type"], error["loc"]
        if kind == "too_short" and location in lists:
            continue  # its only item is wrong, and told
        message = _WORDS.get(kind, error["msg"])
        is_worded = kind in ("told", "unknown", "missing")
        suffix = "" if is_worded else f" (is {error['input']!r})"
        yield location, message[0].lower() + message[1:] + suffix


def _leaves(location: Location, value: Any) -> Iterator[tuple[Location, Any]]:
    inner: list[tuple[str | int, Any]]
    if isinstance(value, Section):
        keys, usual = type(value).model_fields.items(), value.defaults()
        inner = [(k, getattr(value, k)) for k, field in keys if not field.exclude]
        inner = [(k, v) for k, v in inner if k not in value.later or v != usual[k]]
        inner += [("package", value.package)] if value.package else []
    elif is_dataclass(value) and hasattr(value, "kind"):
        inner = list(vars(value).items())
    elif isinstance(value, tuple) and value and isinstance(value[0], Section):
        inner = list(enumerate(value))
    else:
        yield location, value
        return
    for key, item in inner:
        yield from _leaves((*location, key), item)


def _frozen(value: Any) -> Any:
    """Make tuples of lists, which strict models take."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


class AbstractCameraSection(Section):
    """A camera on the vehicle."""

    width: Count = 200
    height: Count = 66
    fov_x_deg: Annotated[float, Field(gt=0, lt=180)] = 90.0
    fx: Positive | None = None  # pixels; in place of fov_x_deg
    fy: Positive | None = None  # fx
    cx: Finite | None = None  # pixels from the image's corner, not its first pixel's
    cy: Finite | None = None  # centre; the middle
    k1: Finite = 0.0  # distortion as OpenCV's
    k2: Finite = 0.0
    p1: Finite = 0.0
    p2: Finite = 0.0
    height_m: Positive = 1.4
    forward_m: Finite = 0.5
    pitch_deg: Annotated[float, Field(gt=-90, lt=90)] = 6.0
    left_m: Finite = 0.0
    yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0  # to the left
    later: ClassVar[tuple[str, ...]] = ("left_m", "yaw_deg")
    lens: ClassVar[tuple[str, ...]] = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")

    def build(self) -> tuple[Camera, CameraMount]:
        """Make intrinsics and mount."""
        camera = from_fov(self.width, self.height, self.fov_x_deg)
        lens = {k: getattr(self, k) for k in self.lens} | {"fy": self.fy or self.fx}
        camera = replace(camera, **{k: v for k, v in lens.items() if v is not None})
        names = ("height_m", "forward_m", "pitch_deg", "left_m", "yaw_deg")
        return camera, CameraMount(**{name: getattr(self, name) for name in names})

    @model_validator(mode="after")
    def _check_lens(self) -> Any:
        """Refuse two focal lengths, half of one, and distortion without an inverse."""
        if self.fx and "fov_x_deg" in self.model_fields_set:
            refuse("fx", "stands beside fov_x_deg; give one of them")
        if self.fy and not self.fx:
            refuse("fy", "stands without fx; give both, or fov_x_deg")
        try:
            self.build()
        except InputError as error:
            refuse("k1", str(error))
        return self


class CameraSection(AbstractCameraSection):
    """The only camera on the vehicle."""

    def rig(self) -> Rig:
        """Make what a vehicle with this camera sees by."""
        return Rig.of_one(*self.build())


class NamedCameraSection(AbstractCameraSection):
    """One of several cameras, of which the first is what a drive is checked by."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,19}$")]


#: The tables [[cameras]].
CameraSections = Annotated[tuple[NamedCameraSection, ...], Field(min_length=1)]


def rig_of(cameras: tuple[NamedCameraSection, ...]) -> Rig:
    """Make what a vehicle with several cameras sees by.

    Raises:
        InputError: two have one name.
    """
    names = tuple(camera.name for camera in cameras)
    lenses, mounts = zip(*(camera.build() for camera in cameras), strict=True)
    return Rig(names, lenses, mounts)
