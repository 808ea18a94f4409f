"""Damage to files: bits, lengths, types, shapes, names and numbers.

A mutation takes the random generator and the content of a good file, and returns that
of a bad one, or of another good one.
"""

from __future__ import annotations

import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

Mutation = Callable[[random.Random, bytes], bytes]

#: Numbers at the edges of types, as text.
NUMBERS = (
    *"0 -0.0 1 -1 2 0.5 -0.5 70 255 256 65536 1e-320 2147483647 2147483648".split(),
    *"4294967295 4294967296 9223372036854775807 9223372036854775808".split(),
    *"18446744073709551616 1e38 1e39 -1e300 1e308 1e400 NaN nan inf -inf".split(),
    *("Infinity", "1" + "0" * 400, "7" * 5000),
)
#: Text where other text is expected.
STRINGS = (
    *". .. / /dev/zero bundled:none bundled:../x http://[::1 x.py:f a.b:c ~ ~x".split(),
    *("", " ", "\n", "\0", "\x1b[31m", "\ud800", "\u202e", "é", "💥", "C:\\x", "\\"),
    *"1 true %s {} a.pt a.pt2 a.onnx a.xml nan 1e400 - :".split(),
    *("a" * 300, "a/" * 3000, "bundled:" + "a" * 300),
)
#: Whole numbers at the edges of types.
WHOLES = (
    *(0, 1, -1, 2, 3, 7, 16, 70, 127, 128, 255, 256, 1000, 65535, 65536, 1 << 24),
    *((1 << bits) + off for bits in (31, 32, 63) for off in (0, -1)),
    *(-1 << bits for bits in (31, 32, 63)),
)
_DTYPES = ("BOOL", "U8", "I8", "I16", "U16", "F16", "BF16", "I32", "F32", "F64", "I64")
_TOKEN = re.compile(rb'"[^"\n]*"|[-+]?[0-9][0-9.eE+-]*|[A-Za-z_][A-Za-z0-9_]*|[^\s]')


def one_of(*mutations: Mutation) -> Mutation:
    """Apply one of several mutations, now and then another one after it."""

    def mutate(rng: random.Random, raw: bytes) -> bytes:
        for _ in range(1 + (rng.random() < 0.3) + (rng.random() < 0.1)):
            try:
                raw = rng.choice(mutations)(rng, raw)
            except Exception:  # a structure that is gone, or cannot be written
                raw = of_bytes(rng, raw)
        return raw

    return mutate


def of_bytes(rng: random.Random, raw: bytes) -> bytes:
    """Flip bits, write numbers, cut, repeat, insert or move bytes."""
    data, at = bytearray(raw), rng.randrange(len(raw) + 1)
    span = slice(at, at + min(len(raw), 1 << rng.randrange(10)))
    kind = rng.randrange(7)
    if kind == 0:
        for _ in range(1 << rng.randrange(4) if data else 0):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        data[at : at + 4] = number_bytes(rng)
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[span]
    elif kind == 4:
        data[at:at] = data[span] * rng.choice((1, 2, 100))
    elif kind == 5:
        data[at:at] = rng.randbytes(1 << rng.randrange(8))
    else:
        data[span] = bytes(reversed(data[span]))
    return bytes(data)


def number_bytes(rng: random.Random) -> bytes:
    if rng.random() < 0.3:
        value = rng.choice((float("nan"), float("inf"), -1e38, 1e38, 1e-40, 0.0))
        return struct.pack(rng.choice("<>") + "f", value)
    size = rng.choice((1, 2, 4, 8))
    order = rng.choice(("little", "big"))
    return (rng.choice(WHOLES) % (1 << 8 * size)).to_bytes(size, order)


def of_text(rng: random.Random, raw: bytes) -> bytes:
    kind = rng.randrange(6)
    if kind < 4:
        tokens = list(_TOKEN.finditer(raw))
        if not tokens:
            return raw + b"x"
        token = rng.choice(tokens)
        return raw[: token.start()] + _token(rng, token[0], tokens) + raw[token.end() :]
    lines = raw.splitlines(keepends=True) or [b""]
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    if kind == 4:
        line = lines[i]
        lines[i : i + 1] = rng.choice(([], [line] * 2, [lines[j]], [line] * 500))
    else:
        insertions = (b"[" * 5000, b"{", b"\0", b"\xff", b"x = 1\n", b"=")
        lines.insert(i, rng.choice(insertions))
    return b"".join(lines)


def _token(rng: random.Random, old: bytes, tokens: list[re.Match[bytes]]) -> bytes:
    kind = rng.randrange(5)
    if kind == 0:
        return b""
    if kind == 1:
        return rng.choice(tokens)[0]
    if kind == 2:
        return rng.choice(NUMBERS).encode()
    if kind == 3 and old[:1] == b'"':
        text = json.dumps(rng.choice(STRINGS), ensure_ascii=False)
        return text.encode("utf-8", "surrogatepass")
    words = (b"true", b"null", b"[]", b"{}", b'""', b"1979-05-27", b"[[[1]]]", b"x")
    return rng.choice(words)


def of_json(rng: random.Random, raw: bytes) -> bytes:
    tree = json.loads(raw)
    change(rng, tree)
    return json.dumps(tree).encode()


def change(rng: random.Random, tree: Any) -> None:
    places = [(tree, key) for key in _keys(tree)]
    for holder, key in places:
        places += [(holder[key], inner) for inner in _keys(holder[key])]
    if not places:
        return
    holder, key = rng.choice(places)
    kind = rng.randrange(8)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[rng.choice(STRINGS)] = holder.pop(key)
    elif kind == 2:
        other, inner = rng.choice(places)
        holder[key] = json.loads(json.dumps(other[inner]))
    elif kind == 3:
        holder[key] = [holder[key]] * rng.choice((1, 2, 3000))
    elif kind == 4 and isinstance(holder[key], list):
        holder[key] = holder[key][: rng.randrange(3)]
    else:
        holder[key] = _value(rng)


def _keys(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value)
    return list(range(len(value))) if isinstance(value, list) else []


def _value(rng: random.Random) -> Any:
    kind = rng.randrange(4)
    if kind == 0:
        return rng.choice(STRINGS)
    if kind == 1:
        return rng.choice((*WHOLES, 10**400))
    if kind == 2:
        return rng.choice((0.5, -0.5, 1e38, 1e308, 1e-320, float("nan"), float("inf")))
    return rng.choice((None, True, False, [], {}, [[]], [None], {"a": 1}))


def of_tensors(rng: random.Random, raw: bytes) -> bytes:
    length = int.from_bytes(raw[:8], "little")
    header, data = json.loads(raw[8 : 8 + length]), raw[8 + length :]
    names = [name for name in header if name != "__metadata__"]
    entry = header[rng.choice(names)]
    kind = rng.randrange(6)
    if kind == 0:
        change(rng, header)
    elif kind == 1 and header.get("__metadata__"):
        metadata = header["__metadata__"]
        key = rng.choice(list(metadata))
        text = of_text(rng, metadata[key].encode()).decode("utf-8", "replace")
        metadata[key] = rng.choice((text, *STRINGS))
    elif kind == 2:
        rng.shuffle(entry["shape"])
        entry["shape"] += [1] * rng.choice((0, 1, 70))
    elif kind == 3:
        entry["dtype"] = rng.choice(_DTYPES)
    elif kind == 4:
        name = rng.choice(names)
        header[rng.choice((*names, *STRINGS))] = header.pop(name)
    else:
        data = of_bytes(rng, data) if rng.random() < 0.2 else _spoilt(rng, data, entry)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def _spoilt(rng: random.Random, data: bytes, entry: dict[str, Any]) -> bytes:
    start, end = entry["data_offsets"]
    at = rng.randrange(start, end) & ~7 if end > start else start
    value = number_bytes(rng)
    return data[:at] + value + data[at + len(value) :]


def of_glb(rng: random.Random, raw: bytes) -> bytes:
    """Change the JSON of a .glb file, whose lengths stay right."""
    size = int.from_bytes(raw[12:16], "little")
    text = rng.choice((of_json, of_text))(rng, raw[20 : 20 + size])
    body = len(text).to_bytes(4, "little") + b"JSON" + text + raw[20 + size :]
    return raw[:8] + (12 + len(body)).to_bytes(4, "little") + body


def of_png(rng: random.Random, raw: bytes) -> bytes:
    """Change, move or take out a chunk of a PNG file, whose checksums stay right."""
    chunks, at = [], 8
    while at + 12 <= len(raw):
        size = int.from_bytes(raw[at : at + 4], "big")
        chunks.append((raw[at + 4 : at + 8], raw[at + 8 : at + 8 + size]))
        at += 12 + size
    place, kind = rng.randrange(len(chunks)), rng.randrange(4)
    name, data = chunks.pop(place)
    if kind == 1:
        chunks.append((name, data))
    elif kind == 2 and name == b"IDAT":
        data = zlib.compress(of_bytes(rng, zlib.decompress(data)))
        chunks.insert(place, (name, data))
    elif kind > 1:
        chunks.insert(place, (name, of_bytes(rng, data)))
    result = raw[:8]
    for name, data in chunks:
        crc = zlib.crc32(name + data).to_bytes(4, "big")
        result += len(data).to_bytes(4, "big") + name + data + crc
    return result
