"""The numbers in the buffers of a glTF file, read and replaced."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import numpy as np

MAX_NUMBERS = 1 << 28
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Accessors:
    """Reads accessors as the format defines them, and adds plain ones.

    Args:
        tree: the file's JSON; `add` changes it.
        load: returns what a buffer's uri names.
        chunks: binary data by name, which trimesh gets; `add` changes it.
    """

    def __init__(
        self, tree: Any, load: Callable[[str], bytes], chunks: dict[str, bytes]
    ) -> None:
        self._tree, self._load, self._chunks = tree, load, chunks
        self._buffers: dict[int, bytes] = {}

    def read(self, index: int) -> np.ndarray:
        """Return an accessor's rows (count, k): sparse, strided, or normalised.

        Returns:
            float64, or the integers as they are stored unless they are normalised.
        """
        accessor = self._tree["accessors"][index]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        count, width = int(accessor["count"]), _WIDTHS[accessor["type"]]
        if not 0 <= count * width <= MAX_NUMBERS:
            raise ValueError(f"accessors[{index}].count: {count}")
        if "bufferView" in accessor:
            rows = self._view(accessor, kind, count, width=width)
        elif "sparse" in accessor:
            rows = np.zeros((count, width), kind)
        else:
            raise ValueError(f"accessors[{index}] has no data")
        if "sparse" in accessor:
            sparse, rows = accessor["sparse"], rows.copy()
            places, values = sparse["indices"], sparse["values"]
            number = int(sparse["count"])
            at = self._view(places, np.dtype(_TYPES[places["componentType"]]), number)
            rows[at[:, 0]] = self._view(values, kind, number, width=width)
        if kind.kind == "f":
            return rows.astype(np.float64)
        if accessor.get("normalized"):
            return np.maximum(rows / np.iinfo(kind).max, -1.0)
        return rows

    def add(self, rows: np.ndarray, is_whole: bool = False) -> int:
        """Store rows (count, k) in single precision, or whole; return the accessor."""
        raw = np.ascontiguousarray(rows, "<u4" if is_whole else "<f4")
        name = f"<decoded {len(self._chunks)}>"
        self._chunks[name] = raw.tobytes()
        width = {size: kind for kind, size in _WIDTHS.items()}[raw.shape[1]]
        view = self._append("buffers", {"uri": name, "byteLength": raw.nbytes})
        view = self._append("bufferViews", {"buffer": view, "byteLength": raw.nbytes})
        entry = {"componentType": 5125 if is_whole else 5126, "type": width}
        return self._append(
            "accessors", {"bufferView": view, "count": len(raw), **entry}
        )

    def _append(self, key: str, entry: dict[str, Any]) -> int:
        self._tree.setdefault(key, []).append(entry)
        return len(self._tree[key]) - 1

    def _view(self, place: Any, kind: np.dtype, count: int, width: int = 1) -> Any:
        """Return rows (count, width) of a view, which reach over no end."""
        view = self._tree["bufferViews"][place["bufferView"]]
        number = view["buffer"]
        if number not in self._buffers:
            uri = self._tree["buffers"][number]["uri"]
            is_inline = uri.startswith("data:")
            self._buffers[number] = (
                base64.b64decode(uri.partition(",")[2])
                if is_inline
                else self._load(uri)
            )
        start = int(view.get("byteOffset", 0)) + int(place.get("byteOffset", 0))
        row = kind.itemsize * width
        strides = int(view.get("byteStride", row)), kind.itemsize
        if min(start, strides[0]) < 0:
            raise ValueError(f"bufferViews[{place['bufferView']}]: a negative offset")
        data = self._buffers[number]
        return np.ndarray((count, width), kind, data, start, strides)
