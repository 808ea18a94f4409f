"""Render frames of any Mitsuba scene into named channels, and write them as images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.errors import InputError, NerfAttackError
from mi_nerfattack.io import exr, files
from mi_nerfattack.notebook import picture
from mi_nerfattack.render.camera.conventions import (
    from_mitsuba,
    mitsuba_to_opencv,
    opencv_to_mitsuba,
)
from mi_nerfattack.render.pathtrace.load import load_scene, named_files
from mi_nerfattack.render.pathtrace.views import describe_lens, frame_metadata

SUFFIXES = (".exr", ".png")
Precision = Literal["half", "float"]

_MAX_RAYS = 1 << 24  # of one pass: bounds the memory for samplers and wavefronts
_MAX_SEED = 1 << 32
# What field_integrator calls its totals, and what EXR viewers call them.
_TOTALS = {"opacity": "A", "depth": "Z"}


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered frame.

    Attributes:
        channels: (height, width) each, float32, by EXR channel name: linear Rec. 709
            `R`, `G`, `B` (or `Y`), `A`, `Z`, and `LAYER.NAME` of AOVs.
        metadata: what it was rendered from, as text.
    """

    channels: Mapping[str, np.ndarray]
    metadata: Mapping[str, str]

    def __repr__(self) -> str:
        height, width = next(iter(self.channels.values())).shape
        names = [*self.channels]
        listed = " ".join(names[:5]) + f" and {len(names) - 5} more" * (len(names) > 5)
        return f"Frame({width}x{height}, {listed})"

    def _repr_png_(self) -> bytes | None:
        return picture(self) if {"R", "Y"} & self.channels.keys() else None

    def colour_only(self) -> Frame:
        """Return the frame without AOVs, opacity and depth.

        Raises:
            InputError: the integrator gives AOVs alone.
        """
        names = [name for name in ("R", "G", "B", "Y") if name in self.channels]
        if not names:
            raise InputError(
                f"{self.metadata['scene']}: the integrator gives no colour, only "
                f"{', '.join(self.channels)}; write .exr"
            )
        return replace(self, channels={name: self.channels[name] for name in names})


class FrameRenderer:
    """Renders one sensor of a scene, from its own pose or from others.

    A `field_integrator` renders its AOVs, too, unless the file sets ``aovs`` to false.
    After the first frame no kernel is compiled, whatever the poses and seeds. Not
    differentiable.

    Cost: one render per frame. Samples beyond 2^24 rays are split into passes, and the
    frame is the mean of the passes, so that the device's memory does not grow with
    `spp`.

    Args:
        path: scene file.
        sensor: index of the sensor.
        spp: samples per pixel, rounded up as the sampler needs; None for the scene's.
        parameters: as for `load_scene`.
        size_px: as for `load_scene`.

    Raises:
        InputError: the scene cannot be loaded, or has no such sensor or no integrator.
    """

    def __init__(
        self,
        path: str | Path,
        sensor: int = 0,
        spp: int | None = None,
        parameters: Mapping[str, str] | None = None,
        size_px: tuple[int, int] | None = None,
    ) -> None:
        if spp is not None and spp < 1:
            raise InputError(f"spp: {spp}; at least 1")
        # The scene, with the AOVs of a `field_integrator`, and the sensor
        self.path: Path = Path(path)
        self.scene = load_scene(path, parameters, size_px, layers=True)
        self.sensor = _pick_sensor(path, self.scene, sensor)
        if self.scene.integrator() is None:
            raise InputError(f"{path}: has no integrator; add one, for instance path")
        # Samples and passes of a frame, and the parameters that move the sensor
        self._spp, self._passes = self._plan(spp)
        self._params: Any = mi.traverse(self.sensor)
        self._names: list[str] | None = None
        self._lens = _describe_camera(self.sensor)
        # What the metadata of each frame say about its source
        self._digests = {"scene": files.sha256(self.path)}
        for name, file in named_files(self.path, parameters).items():
            self._digests[name] = files.sha256(file)
        self._origin = {
            "scene": self.path.name,
            "scene_parameters": dict(sorted((parameters or {}).items())),
            "sensor": f"{sensor} {self.sensor.id()}".strip(),
        }

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of a frame, pixels."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    def metadata(self, camera_to_world: np.ndarray | None, seed: int) -> dict[str, str]:
        """Describe the frame that `render` would give; see there."""
        if not 0 <= seed < _MAX_SEED:
            raise InputError(f"seed: {seed}; must be in [0, 2^32)")
        pose = self._own_pose() if camera_to_world is None else camera_to_world
        spp, digests = self._spp * self._passes, self._digests
        return frame_metadata(
            self._lens, pose, seed, spp=spp, digests=digests, **self._origin
        )

    def render(self, camera_to_world: np.ndarray | None = None, seed: int = 0) -> Frame:
        """Render one frame.

        Args:
            camera_to_world: (4, 4), OpenCV axes, world of the scene; None leaves the
                sensor where it is.
            seed: of the samples, in [0, 2^32); the frame is that of `mi.render` with
                the same seed if one pass is enough.

        Raises:
            InputError: the sensor cannot be moved, or the film stores XYZ.
        """
        metadata = self.metadata(camera_to_world, seed)
        if camera_to_world is not None:
            self._move(camera_to_world)
        passes = [self._render_pass(s) for s in _pass_seeds(seed, self._passes)]
        if self._names is None:
            self._names = self._channel_names(passes[0].shape[2])
        pixels = _mean(passes, self._names) if len(passes) > 1 else passes[0]
        planes = np.moveaxis(pixels, 2, 0)
        return Frame(dict(zip(self._names, planes, strict=True)), metadata)

    def _render_pass(self, seed: int) -> np.ndarray:
        try:
            image = mi.render(
                self.scene, sensor=self.sensor, spp=self._spp, seed=mi.UInt32(seed)
            )
            return np.array(image)
        except RuntimeError as error:
            cause: BaseException | None = error
            while cause is not None:  # Dr.Jit wraps what is raised inside loops
                if isinstance(cause, NerfAttackError):
                    raise cause from error
                cause = cause.__cause__ or cause.__context__
            raise

    def _plan(self, spp: int | None) -> tuple[int, int]:
        """Return samples per pixel of a pass, and the number of passes."""
        width, height = self.size_px
        sampler: Any = self.sensor.sampler()
        samples = sampler.sample_count() if spp is None else spp
        passes = max(1, math.ceil(samples * width * height / _MAX_RAYS))
        passes = min(passes, samples)
        sampler.set_sample_count(math.ceil(samples / passes))
        return int(sampler.sample_count()), passes

    def _move(self, camera_to_world: np.ndarray) -> None:
        if "to_world" not in self._params:
            raise InputError(
                f"{self.path}: sensor {self.sensor.id()!r} "
                f"({self.sensor.class_name()}) cannot be moved; take a perspective one"
            )
        to_world = mi.Transform4f(opencv_to_mitsuba(camera_to_world))
        dr.make_opaque(to_world)
        self._params["to_world"] = to_world
        self._params.update()

    def _own_pose(self) -> np.ndarray:
        matrix = np.array(self.sensor.world_transform().matrix, np.float64)
        return mitsuba_to_opencv(matrix.reshape(4, 4))

    def _channel_names(self, count: int) -> list[str]:
        """Name the channels of the tensor that `mi.render` gives."""
        # The film stores its colour first, then the AOVs
        aovs = list(self.scene.integrator().aov_names())
        bitmap: Any = self.sensor.film().bitmap()
        stored = [field.name for field in bitmap.struct_()]
        base = stored[: len(stored) - len(aovs)]
        if base[:3] == ["X", "Y", "Z"]:
            raise InputError(
                f"{self.path}: the film's pixel_format is xyz; take rgb, rgba, "
                "luminance or luminance_alpha"
            )
        # A `field_integrator`: its totals get the names that EXR viewers know
        if set(aovs) >= set(_TOTALS):
            usual = {n: t for n, t in _TOTALS.items() if t not in base}
            aovs = [str(usual.get(name, name)) for name in aovs]
        names = base + aovs
        # The stock `aov` gives another number of channels than the film stores
        if len(names) != count:
            names = _names_of_aov_integrator(base, aovs)
        # Each channel must have one name, and each name one channel
        twice = sorted({name for name in names if names.count(name) > 1})
        if len(names) != count or twice:
            raise InputError(
                f"{self.path}: {count} channels, names {names}; every AOV and every "
                "nested integrator needs a name of its own"
            )
        return names


def _names_of_aov_integrator(base: list[str], aovs: list[str]) -> list[str]:
    """Name the tensor of the stock `aov`: an image a nested integrator, then AOVs.

    The film, and the integrator's own list, have the first image twice and an alpha
    for each, whatever the film's format.
    """
    names: list[str] = []
    while [name.rpartition(".")[2] for name in aovs[:4]] == list("RGBA"):
        prefix = aovs[0][:-1] if names else ""
        names += [prefix + name for name in base]
        aovs = aovs[4:]
    return names + aovs


def write_frame(path: str | Path, frame: Frame, precision: Precision) -> None:
    """Write a frame atomically: all channels as .exr, sRGB colour as .png.

    Args:
        path: the file.
        frame: what to write.
        precision: of colour and opacity in .exr.

    Raises:
        InputError: another suffix, NaN, an infinite value that is no depth, a value
            beyond half precision, or a file that cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".exr":
        exr.write_layers(path, frame.channels, frame.metadata, half=precision == "half")
    elif suffix == ".png":
        files.write_image(path, to_srgb(path, frame))
    else:
        raise InputError(f"{path}: unknown suffix; use {' or '.join(SUFFIXES)}")


def to_srgb(name: str | Path, frame: Frame) -> np.ndarray:
    """Return the colour as (height, width, 3), uint8, sRGB, clipped to [0, 1].

    Raises:
        InputError: with `name`, for a value that is not finite.
    """
    channels = frame.colour_only().channels
    for channel, values in channels.items():
        if not np.all(np.isfinite(values)):
            raise InputError(
                f"{name}: channel {channel!r} holds NaN or infinity, which 8 bits "
                "cannot say; fix its source, or write .exr with --precision float"
            )
    image = np.stack(list(channels.values()), axis=-1)
    return linear_to_uint8(np.broadcast_to(image, (*image.shape[:2], 3)))


def _pick_sensor(path: str | Path, scene: Any, index: int) -> Any:
    sensors = scene.sensors()
    if not sensors:
        raise InputError(f"{path}: has no sensor; add one")
    if not 0 <= index < len(sensors):
        known = ", ".join(f"{i} ({s.id()})" for i, s in enumerate(sensors))
        raise InputError(f"{path}: no sensor {index}; it has {known}")
    return sensors[index]


def _describe_camera(sensor: Any) -> dict[str, Any]:
    try:
        camera, _ = from_mitsuba(sensor)
    except InputError:
        width, height = sensor.film().size()
        values = {"type": sensor.class_name(), "width": width, "height": height}
    else:
        values = describe_lens(camera)
    film = sensor.film()
    if list(film.crop_size()) != list(film.size()):
        values["crop"] = [*film.crop_offset(), *film.crop_size()]
    return values


def _mean(passes: list[np.ndarray], names: list[str]) -> np.ndarray:
    """Average images; depths are weighted by the opacities beside them."""
    # The plain mean over the passes, of (passes, height, width, channels)
    stack = np.stack(passes).astype(np.float64)
    result = stack.mean(axis=0)
    for i, name in enumerate(names):
        # The opacity that belongs to a depth; other channels keep the plain mean
        of_all = name == "Z" and "opacity" in names  # where A is the film's alpha
        opacity = "opacity" if of_all else name[:-1] + "A"
        if name.rpartition(".")[2] != "Z" or opacity not in names:
            continue
        # Mean of depth times opacity, by the mean opacity; infinite where that is 0
        weight = stack[..., names.index(opacity)]
        hit = weight > 0
        moment = np.where(hit, stack[..., i], 0) * weight
        total = np.where(hit, weight, 0).sum(axis=0)
        depth = moment.sum(axis=0) / np.where(total > 0, total, 1)
        result[..., i] = np.where(total > 0, depth, np.inf)
    return result.astype(np.float32)


def _pass_seeds(seed: int, passes: int) -> list[int]:
    if passes == 1:
        return [seed]
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(passes)]
