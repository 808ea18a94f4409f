"""What the plugin reference says is what plugins read and show, and its examples load.

The rows of a class docstring, in the format of Mitsuba's own reference, are compared to
the properties that the plugin and its base classes query, and to `mi.traverse`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from support.files import objects as splat_files
from support.worlds import fields as small_fields

from mi_nerfattack import plugins
from mi_nerfattack.fields import save_field

NAMES = [name for names in plugins._REGISTERED.values() for name in names]
NESTED = "(Nested plugin)"
KINDS = {
    "grid_field": "volume",
    "ngp_field": "volume",
    "brick_field": "volume",
    "splat_background": "volume",
    "field_emitter": "emitter",
    "field_integrator": "integrator",
    "opencv_camera": "sensor",
}
# What Mitsuba's own classes read of some plugin: C++ tells nobody what it asks for.
NUMBERS = """aperture_radius far_clip focus_distance fov max_value near_clip timeout
    principal_point_offset_x sampling_weight scale shutter_close shutter_open""".split()
COUNTS = "block_size max_depth rr_depth samples_per_pass".split()
FLAGS = "accel flip_normals hide_emitters raw use_grid_bbox".split()
STOCK: dict[str, Any] = {
    **dict.fromkeys(NUMBERS, 1.0),
    **dict.fromkeys(COUNTS, 4),
    **dict.fromkeys(FLAGS, True),
    **{"filter_type": "nearest", "fov_axis": "x", "wrap_mode": "clamp"},
    "srf": {"type": "d65"},
    "to_world": None,  # the identity: Mitsuba has no transforms before a variant
}


@dataclass(frozen=True)
class Row:
    """One row: names, whether it is a parameter or state alone, and flags."""

    names: tuple[str, ...]
    is_parameter: bool
    flags: frozenset[str]


def read_rows(text: str) -> list[Row]:
    """Read the rows of `pluginparameters`."""
    table = re.search(r"\.\. pluginparameters::\n(.*?)\n    \S", text, re.DOTALL)
    assert table is not None
    count = re.search(r":extra-rows: (\d+)", table[1])
    rows = []
    for k, part in enumerate(re.split(r"^     \* - ", table[1], flags=re.M)[1:]):
        names, _, *columns = re.split(r"^       - ", part, flags=re.M)
        assert columns, f"{names}: no description"
        flags = (
            frozenset(re.findall(r"\|(\w+)\|", columns[1]))
            if columns[1:]
            else frozenset()
        )
        is_parameter = count is None or k < int(count[1])
        rows.append(Row(tuple(names.strip().split(", ")), is_parameter, flags))
    return rows


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The files that the examples name, small."""
    folder = tmp_path_factory.mktemp("fields")
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    save_field(folder / "hydrant.safetensors", small_fields.homogeneous())
    rng = np.random.default_rng(0)
    save_field(folder / "bricks.safetensors", small_fields.small_bricks(rng))
    save_field(folder / "field.safetensors", small_fields.small_ngp())
    columns = splat_files.columns(splat_files.cloud(rng, 3))
    splat_files.write_ply(folder / "street.ply", columns)
    if before is not None:
        mi.set_variant(before)
    return folder


@pytest.fixture(autouse=True)
def in_the_folder(variant, folder, monkeypatch) -> None:
    """Let file names of the examples lead to them."""
    monkeypatch.chdir(folder)


def minimal(name: str) -> dict[str, Any]:
    """Describe a plugin by what it requires."""
    grid = {"type": "grid_field", "filename": "hydrant.safetensors"}
    files = {
        "ngp_field": "field.safetensors",
        "brick_field": "bricks.safetensors",
        "splat_background": "street.ply",
    }
    required: dict[str, Any] = {"filename": files.get(name, "hydrant.safetensors")}
    if name.startswith("field_"):
        required = {"object": grid}
    if name == "opencv_camera":
        required = {"fx": 100.0}
    return {"type": name} | required


def load(name: str, **properties: Any) -> Any:
    return mi.load_dict(minimal(name) | properties, parallel=False)


def queried_in_python(name: str) -> set[str]:
    """Construct a plugin of properties that note what Python asks them for."""
    asked: set[str] = set()

    def noting(method: str) -> Any:
        def note(self: mi.Properties, key: str, *default: Any) -> Any:
            asked.add(key)
            return getattr(mi.Properties, method)(self, key, *default)

        return note

    methods = ("get", "__getitem__", "__contains__", "has_property")
    Recorder = type("Recorder", (mi.Properties,), {m: noting(m) for m in methods})
    cls = type(load(name))
    props = Recorder(name)
    nested = {}
    if name == "opencv_camera":
        nested = {"film": {"type": "hdrfilm"}, "sampler": {"type": "independent"}}
    for key, value in (minimal(name) | nested).items():
        if key != "type":
            is_nested = isinstance(value, dict)
            props[key] = mi.load_dict(value, parallel=False) if is_nested else value
    cls(props)
    return asked


def is_read(name: str, key: str) -> bool:
    """Tell whether a plugin asks for a property: what nobody queried is refused.

    So is what this variant or our plugins refuse by a message of their own.
    """
    value = mi.ScalarTransform4f() if key == "to_world" else STOCK[key]
    try:
        load(name, **{key: value})
    except RuntimeError as err:
        return not re.search("unreferenced|cannot use the nested", str(err))
    return True


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_the_properties_that_are_queried(name):
    rows = read_rows(type(load(name)).__doc__ or "")
    documented = {n for row in rows if row.is_parameter for n in row.names} - {NESTED}
    queried = queried_in_python(name) | {key for key in STOCK if is_read(name, key)}
    assert documented == queried


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_what_traverse_shows(name):
    plugin = load(name)
    shown: dict[str, set[str]] = {}
    for key, flags in _flags(mi.traverse(plugin)).items():
        own = NESTED if "." in key else key
        assert shown.setdefault(own, flags) == flags, f"{key}: other flags"
    documented = {
        key: set(row.flags)
        for row in read_rows(type(plugin).__doc__ or "")
        for key in row.names
        if row.flags
    }
    assert documented == shown


def _flags(params: mi.SceneParameters) -> dict[str, set[str]]:
    """Translate flags to the words of the reference."""
    words_by_key = {}
    for key in params.properties:
        flags = int(params.flags(key))
        words = {"exposed"}
        if not flags & int(mi.ParamFlags.NonDifferentiable):
            words.add("differentiable")
        if flags & int(mi.ParamFlags.Discontinuous):
            words.add("discontinuous")
        words_by_key[key] = words
    return words_by_key


@pytest.mark.parametrize("name", NAMES)
def test_class_has_the_head_that_mitsuba_asks_for(name):
    """Mitsuba's extractor takes a raw string at four spaces, label first."""
    text = type(load(name)).__doc__ or ""
    label, title, line = re.search(r"\n    (.*)\n\n    (.*)\n    (-+)\n", text).groups()
    assert label == f".. _{KINDS[name]}-{name}:"
    assert f"(:monosp:`{name}`)" in title and len(line) == len(title)


@pytest.mark.parametrize("name", NAMES)
def test_examples_load(name):
    text = type(load(name)).__doc__ or ""
    tabs = r"code-tab:: {}\n\n(.*?)\n(?=\n? {{0,8}}\S)"
    xml, python = (
        re.search(tabs.format(kind), text, re.DOTALL)[1] for kind in ("xml", "python")
    )
    if xml.strip().startswith("<volume"):
        xml = f'<integrator type="field_integrator">{xml}</integrator>'
    scene = mi.load_string(f'<scene version="3.0.0">{xml}</scene>', parallel=False)
    made = mi.load_dict(eval(python, {"mi": mi}), parallel=False)
    assert scene is not None and made is not None
    assert f'type="{name}"' in xml and f'"type": "{name}"' in python
