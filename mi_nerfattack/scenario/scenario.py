"""The scenario file: one TOML file that replays one result.

Paths are relative to the file, or name bundled data as ``bundled:FILE``. Every
section but ``scene``, ``objects`` and ``policy`` may be left out; unknown keys are
refused with their line.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.scenario.sections import (
    AttackSection,
    BaselineSection,
    CameraSection,
    DeploymentSection,
    DriveSection,
    ObjectiveSection,
    ObjectSection,
    PolicySection,
    SceneSection,
    Section,
    TermSection,
    VehicleSection,
    explain,
)
from mi_nerfattack.scenario.user_code import module_file, split_reference

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

BUNDLED = "bundled:"
#: Keys that name files, in any section.
FILE_KEYS = (
    "field",
    "deployment",
    "routes",
    "file",
    "weights_file",
    "target",
    "function",
)
_REFERENCE = re.compile(r"\.py:\w+$")
_MODULE = re.compile(r"(?!bundled:)[A-Za-z_][\w.]*(?<!\.py):\w+")  # of Python
_STRING = r"""(?!\"{3}|'{3})(?:"(?:[^"\\\n]|\\.)*"|'[^'\n]*')"""  # on one line


class Scenario(Section):
    """A complete scenario."""

    name: Annotated[str, Field(min_length=1)]
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    scene: SceneSection
    objects: Annotated[tuple[ObjectSection, ...], Field(min_length=1)]
    policy: PolicySection
    camera: CameraSection = CameraSection()
    vehicle: VehicleSection = VehicleSection()
    drive: DriveSection = DriveSection()
    objective: ObjectiveSection = ObjectiveSection()
    attack: AttackSection = AttackSection()
    baseline: BaselineSection = BaselineSection()
    deployment: DeploymentSection = DeploymentSection()

    def identity(self, base: str | Path) -> dict[str, str]:
        """Return all values by key, as JSON, and the content of the files they name.

        Args:
            base: folder of the scenario file.

        Returns:
            ``{"scenario.drive.horizon": "60", ...}``; a file is given by its name and
            the SHA-256 of its content.

        Raises:
            InputError: a file cannot be read.
        """
        result = {}
        for key, value in _leaves("scenario", self.model_dump(mode="json")):
            name = key.rpartition(".")[2]
            if name in FILE_KEYS and value:
                value = _content(value, base)
            result[key] = json.dumps(value, sort_keys=True)
        return result

    def digest(self, base: str | Path) -> str:
        """Hash all values, and the content of the files that they name.

        Args:
            base: folder of the scenario file.

        Returns:
            16 hexadecimal digits; equal where the results are, wherever the files lie
            and whatever they are called.
        """
        identity = self.identity(base)
        values = {key: json.loads(value) for key, value in identity.items()}
        for value in values.values():
            if isinstance(value, dict):
                value.pop("file")
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_scenario(path: str | Path) -> tuple[Scenario, str]:
    """Read and check a scenario file.

    Returns:
        the scenario with its paths as written, and the text of the file.

    Raises:
        InputError: the file cannot be read, is no TOML, or a key is unknown,
            missing, of the wrong type or out of range; with file and line.
    """
    text = files.read_text(path)
    data = files.read_toml(path)
    try:
        scenario = Scenario.model_validate_json(json.dumps(data, default=str))
    except ValidationError as err:
        raise InputError(_describe(path, text, err)) from err
    names = [item.id for item in scenario.objects]
    if len(set(names)) != len(names) or "scene" in names:
        raise InputError(f"{path}: objects: ids {names}; must differ, and not be scene")
    _check_portable(path, text, data)
    return scenario, text


def resolve(name: str, base: str | Path) -> Path:
    """Find a file that a scenario names.

    Args:
        name: ``bundled:FILE``, or a path relative to `base`.
        base: folder of the scenario file.
    """
    if name.startswith(BUNDLED):
        from mi_nerfattack.scenes import bundled

        return bundled(name[len(BUNDLED) :])
    path = Path(name).expanduser()
    return path if path.is_absolute() else Path(base) / path


def replace_objects(scenario: Scenario, text: str, field: Path) -> tuple[Scenario, str]:
    """Give every object another field file, in the scenario and in its text."""
    name = str(field.resolve())
    objects = tuple(
        item.model_copy(update={"field": name}) for item in scenario.objects
    )
    changed = scenario.model_copy(update={"objects": objects})
    head, *blocks = re.split(r"(?m)^(?=[ \t]*\[\[\s*objects\s*\]\])", text)
    line = re.compile(rf"(?m)^(\s*field\s*=\s*)(?:{_STRING})")
    blocks = [
        line.sub(lambda match: match.group(1) + json.dumps(name), block, count=1)
        for block in blocks
    ]
    return changed, head + "".join(blocks)


def portable_text(text: str, base: str | Path) -> str:
    """Make the relative paths in a scenario's text absolute, to replay it anywhere."""
    keys = "|".join(FILE_KEYS)
    line = re.compile(rf"(?m)^(\s*(?:{keys})\s*=\s*)({_STRING})")

    def absolute(match: re.Match[str]) -> str:
        value = tomllib.loads(f"value = {match.group(2)}")["value"]
        return match.group(1) + json.dumps(_absolute(value, base), ensure_ascii=False)

    return line.sub(absolute, text)


def _absolute(value: str, base: str | Path) -> str:
    """Make the value of a key of `FILE_KEYS` independent of the folder."""
    if value.startswith(BUNDLED) or _MODULE.fullmatch(value):
        return value
    return str(resolve(value, base).resolve())


def _check_portable(path: str | Path, text: str, data: dict[str, Any]) -> None:
    """Refuse files that :func:`portable_text` does not find, in inline tables."""
    base = Path(path).parent
    moved = dict(_leaves("", tomllib.loads(portable_text(text, base))))
    for key, value in _leaves("", data):
        name = key.rpartition(".")[2]
        wanted = _absolute(value, base) if name in FILE_KEYS else value
        if moved.get(key) != wanted:
            lines = text.splitlines()
            number = next((i for i, row in enumerate(lines, 1) if str(value) in row), 0)
            where = f"{path}:{number}" if number else f"{path}"
            raise InputError(
                f"{where}: {key[1:]}: stands in an inline table, a dotted or quoted "
                f'key or a long string; write {name} = "..." on a line of its own, '
                "under the [section]"
            )


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Walk through tables and arrays of tables."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _leaves(f"{key}.{name}", item)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for index, item in enumerate(value):
            yield from _leaves(f"{key}[{index}]", item)
    else:
        yield key, value


def _content(value: str, base: str | Path) -> dict[str, str]:
    """Hash the content of ``FILE`` or ``FILE.py:NAME``, and the name.

    An XML file counts with the files that it names itself, meshes and pictures. Of
    ``package.module:NAME``, the module's own source counts; the name where it has none.
    """
    if _MODULE.fullmatch(value):
        source = module_file(value.partition(":")[0])
        raw = (
            b"" if source is None else files.read_bytes(source, files.MAX_TENSOR_BYTES)
        )
        digest = hashlib.sha256(raw + value.encode())
        return {"file": value, "sha256": digest.hexdigest()}
    file, name = (value, "") if not _REFERENCE.search(value) else split_reference(value)
    path = resolve(file, base)
    raw = files.read_bytes(path, files.MAX_TENSOR_BYTES)
    digest = hashlib.sha256(raw + name.encode())
    if path.suffix.lower() == ".xml":
        text = raw.decode("utf-8", "replace")
        for inner in sorted(set(re.findall(r'="([^"\n]+)"', text))):
            if (path.parent / inner).is_file():
                part = files.read_bytes(path.parent / inner, files.MAX_TENSOR_BYTES)
                digest.update(hashlib.sha256(part).digest())
    shown = f"{path.name}:{name}" if name else path.name
    return {"file": shown, "sha256": digest.hexdigest()}


def _describe(path: str | Path, text: str, err: ValidationError) -> str:
    problems, found = [], err.errors()
    lists = {error["loc"][:1] for error in found if len(error["loc"]) > 1}
    for error in found:
        if error["type"] == "too_short" and error["loc"] in lists:
            continue  # its only item is wrong, and told
        location, message = explain(error)
        key = ".".join(str(part) for part in location) or "(file)"
        line = _line_of(text, location)
        where = f"{path}:{line}" if line else f"{path}"
        message = message[0].lower() + message[1:]
        if error["type"] == "extra_forbidden":
            message = f"unknown key; allowed: {', '.join(_allowed(location))}"
        problems.append(f"{where}: {key}: {message}")
    return "\n".join(problems)


def _allowed(location: list[Any]) -> list[str]:
    items = {"objects": ObjectSection, "terms": TermSection}
    model: Any = Scenario
    for part in location[:-1]:
        if isinstance(part, int):
            continue
        annotation = model.model_fields[part].annotation
        model = items.get(part, annotation)
    return list(model.model_fields)


def _line_of(text: str, location: list[Any]) -> int | None:
    """Find the line of a key in TOML text: its table, then its name; 1-based."""
    while len(location) > 1 and isinstance(location[-1], int):  # an item of an array
        location = location[:-1]
    tables = [part for part in location[:-1] if isinstance(part, str)]
    index = next((part for part in location if isinstance(part, int)), 0)
    name, current, header_line = str(location[-1]), "", None
    seen: dict[str, int] = {}  # items of each array of tables so far
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?\s*([^\]]+?)\s*\]\]?", line)
        if header:
            current = header.group(1)
            if "[[" in line:
                seen[current] = seen.get(current, -1) + 1
            if current == ".".join(tables or [name]):
                header_line = number if seen.get(current, 0) <= index else header_line
            continue
        in_table = current == ".".join(tables)
        if line.lstrip().startswith("#") or not in_table:
            continue
        if seen.get(current, index) != index:
            continue
        if re.match(rf"\s*[\"']?{re.escape(name)}[\"']?\s*=", line):
            return number
    return header_line
