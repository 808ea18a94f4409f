"""Load Mitsuba scenes, with other parameters, film size or time of day."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near
from mi_nerfattack.scenes import BUNDLED, resolve


@dataclass(frozen=True)
class Daylight:
    """Sun and sky; x is east and y is north.

    Args:
        elevation_deg: of the sun above the horizon.
        azimuth_deg: of the sun, clockwise from north.
        sun: factor of the file's sun.
        sky: factor of the file's sky.
        turbidity: of the air, 1 to 10.
    """

    elevation_deg: float
    azimuth_deg: float
    sun: float = 1.0
    sky: float = 1.0
    turbidity: float = 4.0

    @property
    def sun_direction(self) -> tuple[float, float, float]:
        """Unit vector towards the sun."""
        up, around = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        flat = math.cos(up)
        return flat * math.sin(around), flat * math.cos(around), math.sin(up)


#: Times of day by name; "day" leaves the scene as its file has it.
DAYLIGHT: Mapping[str, Daylight | None] = {
    "day": None,
    "morning": Daylight(28.0, 100.0, sun=1.3, sky=1.9),
    "noon": Daylight(68.0, 180.0),
    "evening": Daylight(18.0, 262.0, sun=1.7, sky=2.3, turbidity=6.0),
    "overcast": Daylight(50.0, 180.0, sun=0.0, sky=1.5, turbidity=10.0),
}


def set_daylight(scene: Any, name: str) -> None:
    """Light a scene as at another time of day.

    Args:
        scene: `mi.Scene`; its emitter is changed in place.
        name: key of `DAYLIGHT`.

    Raises:
        InputError: unknown name, no `sunsky` emitter in the scene, or one whose sun
            follows from place and time instead of a direction.
    """
    if name not in DAYLIGHT:
        raise InputError(f"sky: {name!r}; one of {', '.join(DAYLIGHT)}")
    daylight = DAYLIGHT[name]
    if daylight is None:
        return
    parameters: Any = mi.traverse(scene)
    suns = [key for key in parameters.keys() if key.endswith(".sun_direction")]
    if not suns:
        raise InputError(
            f"sky: {name!r} needs a scene with a `sunsky` emitter; add one to the "
            "scene's file, or use 'day'"
        )
    for key in suns:
        emitter = key.removesuffix(".sun_direction")
        if parameters.flags(key) & mi.ParamFlags.ReadOnly.value:
            raise InputError(
                f"sky: {name!r}: the sun of {emitter!r} follows from place and time; "
                "give it a sun_direction in the scene's file, or use 'day'"
            )
        parameters[key] = mi.Vector3f(*daylight.sun_direction)
        parameters[f"{emitter}.sun_scale"] *= daylight.sun
        parameters[f"{emitter}.sky_scale"] *= daylight.sky
        parameters[f"{emitter}.turbidity"] = daylight.turbidity
    parameters.update()


_CROP = ("crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
_VALUE = re.compile(r"""=\s*["']([^"'$\n]+)["']""")
_PARAMETER = re.compile(r"\$(\w+)")
_UNKNOWN = re.compile(r'Plugin "([^"]+)" not found')


def load_scene(
    path: str | Path,
    parameters: Mapping[str, str] | None = None,
    size_px: tuple[int, int] | None = None,
    shapes: Mapping[str, Any] | None = None,
    layers: bool = False,
) -> Any:
    """Load a Mitsuba scene in the active variant.

    Args:
        path: XML file; the files it names are relative to its folder.
        parameters: values of the file's ``$NAME``, instead of the `<default>` values.
        size_px: width and height of all films, as if the file gave them; None keeps
            the file's.
        shapes: `mi.Shape` by name that the scene gets besides its own.
        layers: let a `field_integrator` that is the scene's render its AOVs, unless
            the file sets ``aovs``.

    Returns:
        `mi.Scene`.

    Raises:
        InputError: whatever the parser or a plugin refuses, in one line with the file;
            a root element that is no scene; a size for a film with a crop window.
    """

    def change(state: Any) -> None:
        _refuse_empty_bitmaps(path, state)
        if size_px is not None:
            _resize_films(path, state, size_px)
        if layers:
            _add_layers(state)
        for name, shape in (shapes or {}).items():
            state.nodes[0].props[name] = shape

    scene, missed = None, set[str]()
    while scene is None:
        try:
            scene = _instantiate(path, parameters or {}, change)
        except RuntimeError as error:
            unknown = _UNKNOWN.search(str(error))
            if not (unknown and _registers(unknown[1], missed)):
                text = _in_one_line(path, str(error))
                raise InputError(f"{path}: {text}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(
            f"{path}: describes a {type(scene).__name__}; its root must be <scene>"
        )
    corners = np.array([scene.bbox().min, scene.bbox().max], np.float64)
    if np.isfinite(corners).all():  # which a scene without shapes has not
        require_near(path, corners)
    return scene


def _instantiate(
    path: str | Path, parameters: Mapping[str, str], change: Callable[[Any], None]
) -> Any:
    """Parse a file, change what it describes, and make its root."""
    config = _config()
    with _resolved_from(path):
        state = mi.parser.parse_file(config, str(path), **parameters)
        change(state)
        config.merge_meshes = not _has_rectangles(state)
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)


def _registers(plugin: str, missed: set[str]) -> bool:
    """Whether another package registers a plugin that Mitsuba misses, first time."""
    from mi_nerfattack.system import entry_points

    is_new = plugin not in missed
    missed.add(plugin)
    return is_new and entry_points.register_plugin(plugin)


def scene_files(path: str | Path) -> list[Path]:
    """List a scene's file and all files that it names, as far as they exist.

    Args:
        path: XML file; included ones are followed.

    Returns:
        in the order of the text, each once: the XML files first, then meshes, images,
        volumes, fields and spectra.

    Raises:
        InputError: the XML cannot be read.
    """
    return list(dict.fromkeys([Path(path).resolve(), *named_files(path).values()]))


def named_files(
    path: str | Path, parameters: Mapping[str, str] | None = None
) -> dict[str, Path]:
    """Find all files that a scene's file names, as far as they exist.

    Names are those that Mitsuba reads: with the values of ``$NAME``, and looked for in
    the folders of `<path>`, too.

    Args:
        path: XML file; included ones are followed.
        parameters: as of :func:`load_scene`.

    Returns:
        by name as it is written; included files are numbered.

    Raises:
        InputError: the XML cannot be read.
    """
    with _resolved_from(path):
        definitions = dict(parameters or {})
        state = _parsed(path, definitions)
        texts = [Path(str(name)).resolve() for name in state.files]
        names = [
            node.props[key]
            for node in state.nodes
            for key in node.props
            if isinstance(node.props[key], str)
        ]
        # the parser replaces a spectrum's file by its numbers
        names += _spectra([files.read_text(text) for text in texts], definitions)
        resolver = mi.file_resolver()  # pyright: ignore[reportCallIssue]
        paths = {
            name: resolve(name)
            if name.startswith(BUNDLED)
            else Path(str(resolver.resolve(name)))
            for name in names
            if name
        }
    included = {f"included {k}": text for k, text in enumerate(texts[1:])}
    there = {k: file.resolve() for k, file in paths.items() if os.path.isfile(file)}
    return included | there


def plugin_packages(path: str | Path) -> str:
    """Return names and versions of the packages whose plugins a scene's file names.

    Args:
        path: XML file; included ones are followed.

    Returns:
        "" where all plugins are of Mitsuba or of this package.

    Raises:
        InputError: the XML cannot be read, or a package cannot be imported.
    """
    with _resolved_from(path):
        nodes = _parsed(path, {}).nodes
    # Mitsuba's manager knows the plugins in C++ alone.
    known = mi.PluginManager.instance().plugin_type
    names = {node.props.plugin_name() for node in nodes}
    unknown = [x for x in names if known(x) == mi.ObjectType.Unknown]
    if not unknown:
        return ""
    from mi_nerfattack.system import entry_points

    return entry_points.plugin_packages(unknown)


def _parsed(path: str | Path, parameters: Mapping[str, str]) -> Any:
    try:
        return mi.parser.parse_file(_config(), str(path), **parameters)
    except RuntimeError as error:
        raise InputError(f"{path}: {_in_one_line(path, str(error))}") from error


class _Attributes(HTMLParser):
    """Attributes of elements in a text that is as lax as Mitsuba's parser takes it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.defaults: dict[str, str] = {}
        self.filenames: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        if tag == "default" and "name" in attributes:
            self.defaults[attributes["name"]] = attributes.get("value", "")
        elif "filename" in attributes:
            self.filenames.append(attributes["filename"])


def _spectra(texts: list[str], parameters: Mapping[str, str]) -> list[str]:
    """Return the file names of spectra in XML texts."""
    attributes = [_Attributes(text) for text in texts]
    values = {k: v for part in attributes for k, v in part.defaults.items()}
    values |= parameters
    names = [name for part in attributes for name in part.filenames]
    for _ in range(len(values)):  # a default may name others
        names = [
            _PARAMETER.sub(lambda match: values.get(match[1], match[0]), name)
            for name in names
        ]
    return names


def _config() -> Any:
    config = mi.parser.ParserConfig(str(mi.variant()))
    config.parallel = False  # Python plugins
    return config


def _has_rectangles(state: Any) -> bool:
    """Return whether meshes of equal materials must stay apart.

    Mitsuba 3.9.1 leaves rectangles that it merges out of the scene's bounding box, on
    whose size the light of sky, sun and other far emitters depends.
    """
    return any(node.props.plugin_name() == "rectangle" for node in state.nodes)


def _resize_films(path: str | Path, state: Any, size_px: tuple[int, int]) -> None:
    if min(size_px) < 1:
        raise InputError(f"size: {size_px[0]} x {size_px[1]} px; at least 1 x 1")
    if size_px[0] * size_px[1] > files.MAX_IMAGE_PIXELS:
        raise InputError(
            f"size: {size_px[0]} x {size_px[1]} px; at most {files.MAX_IMAGE_PIXELS} "
            "pixels in all"
        )
    for node in state.nodes:
        if node.type != mi.ObjectType.Film:
            continue
        if any(name in node.props for name in _CROP):
            raise InputError(
                f"{path}: a film has a crop window, which another size would move; "
                "remove crop_* from it, or give no size"
            )
        node.props["width"], node.props["height"] = size_px


def _add_layers(state: Any) -> None:
    scene = state.nodes[0].props
    for item in (scene[key] for key in scene):
        if not isinstance(item, mi.Properties.ResolvedReference):
            continue
        props = state.nodes[item.index()].props
        if props.plugin_name() == "field_integrator" and "aovs" not in props:
            props["aovs"] = True


@contextmanager
def _resolved_from(path: str | Path) -> Iterator[None]:
    """Let Mitsuba look for files beside a scene's first, as its own loader does."""
    source = Path(path)
    with files.reported(path):
        is_folder, is_file = source.is_dir(), source.is_file()
    if is_folder:
        raise InputError(f"{path}: is a folder; give a Mitsuba scene (XML)")
    if not is_file:
        raise InputError(f"{path}: does not exist; give a Mitsuba scene (XML)")
    _refuse_devices(source)
    before = mi.file_resolver()  # pyright: ignore[reportCallIssue]
    resolver = mi.FileResolver(before)
    resolver.prepend(str(source.resolve().parent))
    mi.set_file_resolver(resolver)  # pyright: ignore[reportCallIssue]
    try:
        yield
    finally:
        mi.set_file_resolver(before)  # pyright: ignore[reportCallIssue]


def _refuse_empty_bitmaps(path: str | Path, state: Any) -> None:
    """Refuse bitmaps of nothing, for which Mitsuba 3.9.1 ends the process."""
    for node in state.nodes:
        named = any(key in node.props for key in ("filename", "bitmap", "data"))
        if node.props.plugin_name() == "bitmap" and not named:
            raise InputError(f"{path}: a bitmap {node.props.id()!r} without filename")


def _refuse_devices(path: Path) -> None:
    """Refuse pipes and devices, which Mitsuba would wait for, before it opens any."""
    left, visited = [path], {path}
    while left:
        source = left.pop()
        for name in _VALUE.findall(files.read_text(source)):
            file = source.parent / name
            if os.path.isfile(file):
                if file.suffix.lower() == ".xml" and file not in visited:
                    left.append(file)
                    visited.add(file)
            elif os.path.exists(file) and not os.path.isdir(file):
                raise InputError(f"{source}: {name!r} is a pipe or a device; copy it")


def _in_one_line(path: str | Path, text: str) -> str:
    """Strip from an error's text what only developers need, and add a remedy."""
    text = re.sub(r"\[[a-z_]+\.cpp:\d+\] ", "", text)
    traceback = r"(?s)Traceback \(most recent call last\):.*?\n(?=\w+: )"
    text = re.sub(traceback, "", text)
    text = re.sub(r"\b(Input|Setup|Value)Error: ", "", text)
    text = " ".join(text.replace(f"At {path} (", "(").split())
    if "unused parameters" in text:
        return f"{text}; the file has no <default> of this name"
    if "undefined parameter" in text:
        return f"{text}; give it a value, or the file a <default>"
    return text
