"""Field files: one safetensors file a field, everything else in its header."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.bricks import BrickField, Codes, check_bricks
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.levels import count_read
from mi_nerfattack.fields.ngp import NGPField, NGPLayout
from mi_nerfattack.fields.occupancy import Occupancy
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import require_near

T = TypeVar("T", int, float)

AnyField: TypeAlias = GridField | NGPField | BrickField

FORMAT = "mi_nerfattack field 1"
_CHANNELS = {"density": (), "texture": (3,)}  # of a grid field's parameters


def save_field(path: str | Path, field: AnyField) -> None:
    """Write a field file atomically.

    Raises:
        InputError: the path cannot be written, or a parameter is not finite in the
            precision of the file.
    """
    metadata = {"format": FORMAT, **field.metadata()}
    with np.errstate(over="ignore"):  # the check says which tensor it is
        tensors = field.tensors()
    _check_finite(path, tensors)
    files.write_safetensors(path, tensors, metadata)


def load_field(path: str | Path) -> AnyField:
    """Read a field file of any kind.

    Raises:
        InputError: the file is missing, truncated, of another format, lacks a
            tensor or header entry, or holds a wrong shape or a value that is not
            finite; the message names file and entry.
    """
    tensors, metadata = files.read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise InputError(
            f"{path}: header entry 'format' is {metadata.get('format')!r}; expected "
            f"{FORMAT!r}; make field files with 'mi-nerfattack fit' or 'asset'"
        )
    _check_finite(path, tensors)
    kinds = {"grid_field": _grid, "ngp_field": _ngp, "brick_field": _bricks}
    kind = metadata.get("kind", "")
    if kind not in kinds:
        raise InputError(
            f"{path}: header entry 'kind' is {kind!r}; allowed: {', '.join(kinds)}"
        )
    try:
        field = kinds[kind](tensors, metadata)
    except KeyError as err:
        raise InputError(f"{path}: entry {err} is missing from the file") from err
    except ValueError as err:
        raise InputError(f"{path}: {err}") from err
    require_near(path, np.stack([field.lower, field.upper]))
    return field


def load_grid(path: str | Path) -> GridField:
    """Read a field file that must be a grid field, as objects are."""
    field = load_field(path)
    if not isinstance(field, GridField):
        raise InputError(f"{path}: is a {field.kind}; a grid_field is needed here")
    return field


def holds_splats(path: Path) -> bool:
    """Tell files of splats from those of grids, by their suffix."""
    return path.suffix.lower() in (".ply", ".spz", ".splat")


def _check_finite(path: str | Path, tensors: Mapping[str, np.ndarray]) -> None:
    for name, value in tensors.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            limit = float(np.finfo(value.dtype).max)
            raise InputError(
                f"{path}: tensor '{name}' holds NaN or infinity; allowed are finite "
                f"values up to {limit:g}, fit the field again"
            )


def _grid(tensors: Mapping[str, np.ndarray], meta: Mapping[str, str]) -> GridField:
    names = ("levels", "base_resolution", "max_resolution")
    layout = GridLayout(**{name: _number(meta, name, int) for name in names})
    cells, octants = _cells(tensors, meta)
    count = count_read(layout.grid_levels, cells)
    for name, channels in _CHANNELS.items():
        shape, number = tensors[name].shape, tensors[name].dtype
        if number.kind != "f":
            raise ValueError(f"{name}: type {number}; expected float16 or float32")
        # files of earlier versions hold all vertices
        if shape not in ((count, *channels), (layout.n_vertices, *channels)):
            raise ValueError(
                f"{name}: shape {shape}; {count} vertices are held by the occupied "
                f"cells, of {layout.n_vertices}; the file is damaged, make or copy it "
                "again"
            )
    field = GridField(
        layout,
        _vector(meta, "lower"),
        _vector(meta, "upper"),
        occupancy=Occupancy(cells, octants),
        density_scale=_number(meta, "density_scale", float),
        step_m=_number(meta, "step_m", float),
        info=_info(meta),
    )
    held = field.held_vertices()
    for name, channels in _CHANNELS.items():
        values = tensors[name]
        if len(values) < len(held):
            values = np.zeros((len(held), *channels), np.float32)
            values[held] = tensors[name]
        field.set_parameter(name, values)
    return field


def _ngp(tensors: Mapping[str, np.ndarray], meta: Mapping[str, str]) -> NGPField:
    names = NGPLayout.__dataclass_fields__
    layout = NGPLayout(**{name: _number(meta, name, int) for name in names})
    layout.check(tensors)  # before the occupancy takes memory
    return NGPField(
        layout,
        _vector(meta, "lower"),
        _vector(meta, "upper"),
        tensors=dict(tensors),
        occupancy=Occupancy(*_cells(tensors, meta)),
        step_m=_number(meta, "step_m", float),
        cone=_number(meta, "cone", float),
        info=_info(meta),
    )


def _bricks(tensors: Mapping[str, np.ndarray], meta: Mapping[str, str]) -> BrickField:
    codes = _vector(meta, "log_density").tolist()
    if len(codes) != len(fields(Codes)):
        raise ValueError(f"log_density: {len(codes)} numbers; expected low and high")
    cells, octants = _cells(tensors, meta)
    names = "subdivisions", "vertices", "sky"
    subdivisions, vertices, sky = (tensors[name] for name in names)
    # before the occupancy takes memory
    check_bricks(int(cells.sum()), subdivisions, vertices, sky=sky)
    return BrickField(
        _vector(meta, "lower"),
        _vector(meta, "upper"),
        occupancy=Occupancy(cells, octants),
        subdivisions=subdivisions,
        vertices=vertices,
        codes=Codes(*codes),
        sky=sky,
        step_m=_number(meta, "step_m", float),
        cone=_number(meta, "cone", float),
        info=_info(meta),
    )


def _vector(meta: Mapping[str, str], name: str) -> np.ndarray:
    return np.array([_number({name: v}, name, float) for v in meta[name].split()])


def _number(meta: Mapping[str, str], name: str, kind: type[T]) -> T:
    try:
        return kind(meta[name])
    except ValueError as err:
        raise ValueError(
            f"header entry '{name}' holds {meta[name]!r}; expected {kind.__name__}"
        ) from err


def _cells(
    tensors: Mapping[str, np.ndarray], meta: Mapping[str, str]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return which cells are occupied, and their octants, (rx, ry, rz) each."""
    bits = tensors["occupancy"]
    name = "occupancy_shape"
    shape = tuple(_number({name: v}, name, int) for v in meta[name].split())
    count = math.prod(shape)
    good = len(shape) == 3 and min(shape) > 0 and bits.dtype == np.uint8
    if not good or bits.size != (count + 7) // 8:
        raise ValueError(
            f"occupancy: {bits.size} bytes for a grid of {shape}; the file is damaged"
        )
    cells = np.unpackbits(bits, count=count).view(bool).reshape(shape)
    if "octants" not in tensors:
        return cells, None
    octant_bytes = tensors["octants"]
    if octant_bytes.shape != (cells.sum(),) or octant_bytes.dtype != np.uint8:
        raise ValueError(
            f"octants: {octant_bytes.dtype} {octant_bytes.shape} for {cells.sum()} "
            "occupied cells; expected a byte each, the file is damaged"
        )
    octants = np.zeros(shape, np.uint8)
    octants[cells] = octant_bytes
    return cells, octants


def _info(meta: Mapping[str, str]) -> dict[str, str]:
    return {k: v for k, v in meta.items() if k.startswith(("provenance", "fit."))}
