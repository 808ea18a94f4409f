"""Files and functions that a scenario names, found once, when it is read."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import tomlkit
from pydantic import PlainSerializer, PlainValidator, ValidationInfo, WithJsonSchema
from pydantic_core import PydanticCustomError

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.scenario.section import Section
from mi_nerfattack.scenario.user_code import (
    check_trust,
    helper_files,
    import_function,
    load_function,
    module_file,
)
from mi_nerfattack.scenes import BUNDLED, resolve


@dataclass(frozen=True)
class NamedFile:
    """A file, or a function in one.

    Attributes:
        name: as the scenario says it.
        path: the file; None of a function of an installed module.
        function: its name; empty of a file.
    """

    name: str
    path: Path | None
    function: str = ""

    def __str__(self) -> str:
        return self.name

    @property
    def file(self) -> Path:
        """The path of what is no function of a module."""
        assert self.path is not None
        return self.path

    @property
    def portable(self) -> str:
        """The name that means the same in every folder."""
        if self.path is None or self.name.startswith(BUNDLED):
            return self.name
        return ":".join(filter(None, (str(self.path.resolve()), self.function)))

    def load(self, key: str, trusted: bool) -> Callable[..., Any]:
        """Run the file or import the module, and return the function.

        Args:
            key: of the file, ``section.key``.
            trusted: the section's `trust_code`.

        Raises:
            InputError: see `check_trust`, `load_function` and `import_function`.
        """
        check_trust(key, self.name, trusted)
        if self.path is None:
            return import_function(self.name)
        return load_function(self.path, self.function)

    def content(self) -> dict[str, str]:
        """Return the name without its folder, and the SHA-256 of the content.

        An XML file counts with the files that it and included ones name, a Python file
        with its `helper_files`, the folder of a recording with all that lies in it. Of
        an installed module, its own source counts; the name where it has none. Other
        packages whose plugins an XML file names count, too: ``packages`` names them.

        Raises:
            InputError: the file cannot be read.
        """
        if self.path is None:
            source = module_file(self.name.partition(":")[0])
            raw = b"" if source is None else _read(source)
            digest = hashlib.sha256(raw + self.name.encode())
            return {"file": self.name, "sha256": digest.hexdigest()}
        if os.path.isdir(self.path):  # never raises; Path.is_dir may
            return {"file": self.path.name, "sha256": _folder_digest(self.path)}
        raw, package_entry = _read(self.path), dict[str, str]()
        digest = hashlib.sha256(raw)
        digest.update(self.function.encode())
        if self.path.suffix.lower() == ".xml":
            inner_files, packages = _files_of(self.path)
            for inner in inner_files:
                digest.update(hashlib.sha256(_read(inner)).digest())
            if packages:
                digest.update(packages.encode())
                package_entry["packages"] = packages
        if self.function:
            for name, helper in sorted(helper_files(self.path).items()):
                digest.update(f"{name} {files.sha256(helper)}\n".encode())
        shown = ":".join(filter(None, (self.path.name, self.function)))
        return {"file": shown, "sha256": digest.hexdigest(), **package_entry}


def _path(value: Any, info: ValidationInfo) -> NamedFile:
    """Find a path; the folder of relative ones is in the validation's context."""
    if isinstance(value, NamedFile):
        return value
    if not isinstance(value, str):
        raise PydanticCustomError("file", "must be a path, as text")
    if "\0" in value:
        raise PydanticCustomError("file", "has a null character, as no file's name has")
    try:
        return NamedFile(value, resolve(value, (info.context or {}).get("folder", "")))
    except InputError as err:
        raise PydanticCustomError("file", "{why}", {"why": str(err)}) from err


def _file(value: Any, info: ValidationInfo) -> NamedFile:
    """Find a file; refuse a folder, of which everything would be hashed."""
    named = _path(value, info)
    if named.path is not None and os.path.isdir(named.path):
        raise PydanticCustomError("file", "is a folder; a file is needed")
    return named


def _code(value: Any, info: ValidationInfo) -> NamedFile:
    """Find ``FILE.py:NAME``."""
    file, _, function = str(value).rpartition(":")
    if not file.endswith(".py") or not function.isidentifier():
        raise PydanticCustomError("file", "must have the form FILE.py:NAME")
    return NamedFile(str(value), _file(file, info).path, function)


def _any_code(value: Any, info: ValidationInfo) -> NamedFile:
    """Find ``FILE.py:NAME`` or ``package.module:NAME``."""
    module, _, function = str(value).rpartition(":")
    if module.endswith(".py"):
        return _code(value, info)
    if not module or not function.isidentifier():
        raise PydanticCustomError(
            "file", "must have the form FILE.py:NAME or package.module:NAME"
        )
    return NamedFile(str(value), None)


def _files_of(scene: Path) -> tuple[list[Path], str]:
    """Return the files that a Mitsuba scene names, by name, and packages of plugins."""
    from mi_nerfattack.backend import variant
    from mi_nerfattack.render.pathtrace.load import (  # slow to import
        named_files,
        plugin_packages,
    )

    variant.ensure()
    paths = [path for _, path in sorted(named_files(scene).items())]
    return paths, plugin_packages(scene)


def _folder_digest(folder: Path) -> str:
    digest = hashlib.sha256()
    with files.reported(folder):
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in paths:
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name} {files.sha256(path)}\n".encode())
    return digest.hexdigest()


def _read(path: Path) -> bytes:
    return files.read_bytes(path, files.MAX_TENSOR_BYTES)


_NAME = PlainSerializer(str, return_type=str)
_TEXT = WithJsonSchema({"type": "string"})
#: Types of keys: a file; a file or a folder; ``FILE.py:NAME``; that or a name in an
#: installed module, ``package.module:NAME``.
File = Annotated[NamedFile, PlainValidator(_file), _NAME, _TEXT]
FileOrFolder = Annotated[NamedFile, PlainValidator(_path), _NAME, _TEXT]
Code = Annotated[NamedFile, PlainValidator(_code), _NAME, _TEXT]
AnyCode = Annotated[NamedFile, PlainValidator(_any_code), _NAME, _TEXT]


def section_content(section: Section) -> dict[str, Any]:
    """Return what a policy's or vehicle's section says as JSON, files by checksums."""
    values = section.model_dump(mode="json", exclude_defaults=True)
    for (key, *_), value in section.leaves():
        if isinstance(value, NamedFile):
            values.pop(str(key))
            values[f"{key}_sha256"] = value.content()["sha256"]
    return values | ({"package": section.package} if section.package else {})


def portable_text(section: Section, text: str) -> str:
    """Name the files of a section in its text so that it replays anywhere."""
    document = tomlkit.parse(text)
    for (*way, last), value in section.leaves():
        if isinstance(value, NamedFile):
            table: Any = document
            for part in way:
                table = table[part]
            table[last] = value.portable
    token = getattr(getattr(section, "policy", None), "token_file", None)
    if token is not None:  # it is no result's, and so no leaf
        cast(Any, document)["policy"]["token_file"] = token.portable
    return tomlkit.dumps(document)
