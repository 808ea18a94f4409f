from __future__ import annotations

import errno
import math
import os
import pickle
import re
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

READERS = [
    files.read_text,
    files.read_json,
    files.read_toml,
    files.read_image,
    files.read_safetensors,
]
TYPES = ["f2", "f4", "f8", "u1", "i1", "u4", "i4", "i8", "?"]

on_one_file = settings(max_examples=30)
names = st.text(min_size=1, max_size=20).filter(lambda name: name != "__metadata__")
arrays = st.sampled_from(TYPES).flatmap(
    lambda kind: hnp.arrays(kind, hnp.array_shapes(min_dims=0, min_side=0, max_side=4))
)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner) | st.dictionaries(names, inner),
    max_leaves=20,
)


@on_one_file
@given(st.dictionaries(names, arrays, max_size=4), st.dictionaries(names, st.text()))
def test_safetensors_round_trip(tmp_path, tensors, metadata):
    path = tmp_path / "tensors.safetensors"
    files.write_safetensors(path, tensors, metadata)
    read, note = files.read_safetensors(path)
    assert note == metadata
    assert read.keys() == tensors.keys()
    for name, value in tensors.items():
        assert read[name].dtype == value.dtype
        np.testing.assert_array_equal(read[name], value, strict=True)


def test_safetensors_bytes_are_reproducible_and_standard(tmp_path):
    tensors = {"b": np.arange(6.0).reshape(2, 3).T, "a": np.float32(1.5)}
    metadata = {str(i): "x" * i for i in range(20)}
    written = set()
    for order in (metadata, dict(reversed(metadata.items()))):
        files.write_safetensors(tmp_path / "t.safetensors", tensors, order)
        written.add((tmp_path / "t.safetensors").read_bytes())
    (raw,) = written
    read = safetensors.numpy.load(raw)
    np.testing.assert_array_equal(read["b"], tensors["b"])
    assert read["a"].shape == ()
    assert int.from_bytes(raw[:8], "little") % 8 == 0


@pytest.mark.skipif(sys.platform != "linux", reason="reads the size from /proc")
def test_reading_asks_for_no_more_memory_than_the_file_has(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    code = (
        "import resource\n"
        "from mi_nerfattack.io import files\n"
        "pages = int(open('/proc/self/statm').read().split()[0])\n"
        "most = pages * resource.getpagesize() + (256 << 20)\n"
        "resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
        "raw = files.read_bytes('a', files.MAX_TENSOR_BYTES)\n"
        "print(raw, files.sha256('a')[:8])\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    # SHA-256 of "abc" as printed in FIPS 180-2, appendix B.1
    assert done.stdout == "b'abc' ba7816bf\n", done.stderr


def test_a_file_that_grows_while_it_is_read(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"abc")
    monkeypatch.setattr(files, "_check_file", lambda *_: 2)
    with pytest.raises(InputError, match="more than 2 bytes; it grows"):
        files.read_bytes(tmp_path / "a", 2)


@on_one_file
@given(st.data())
def test_damaged_safetensors_raise_or_read(tmp_path, data):
    path = tmp_path / "tensors.safetensors"
    files.write_safetensors(path, {"a": np.arange(5.0), "b": np.ones((2, 3))})
    raw = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    try:
        read, _ = files.read_safetensors(path)
    except InputError as err:
        assert str(path) in str(err)
    else:
        assert sum(value.nbytes for value in read.values()) <= len(raw)


@on_one_file
@given(raw=st.binary(max_size=200))
@pytest.mark.parametrize("read", READERS[1:])
def test_arbitrary_bytes_raise_or_read(tmp_path, read, raw):
    path = tmp_path / "any"
    path.write_bytes(raw)
    try:
        read(path)
    except InputError as err:
        assert str(path) in str(err)


def test_every_truncation_of_safetensors_is_refused(tmp_path):
    path = tmp_path / "tensors.safetensors"
    files.write_safetensors(path, {"a": np.arange(5.0)}, {"kind": "grid"})
    raw = path.read_bytes()
    for length in range(len(raw)):
        path.write_bytes(raw[:length])
        with pytest.raises(InputError, match="truncated"):
            files.read_safetensors(path)


def test_header_that_claims_more_than_the_file_holds_is_refused(tmp_path):
    path = tmp_path / "tensors.safetensors"
    size = 1 << 40
    header = b'{"a":{"dtype":"F32","shape":[%d],"data_offsets":[0,%d]}}' % (
        size // 4,
        size,
    )
    path.write_bytes(len(header).to_bytes(8, "little") + header + b"\0" * 8)
    with pytest.raises(InputError, match="truncated"):
        files.read_safetensors(path)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickle_and_zip_are_refused_unread(tmp_path, protocol):
    raw, path = pickle.dumps({"a": [1.0] * 100}, protocol), tmp_path / "a.safetensors"
    path.write_bytes(raw)
    with pytest.raises(InputError, match="pickle"):
        files.read_safetensors(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", raw)
    with pytest.raises(InputError, match="zip"):
        files.read_safetensors(path)


@pytest.mark.parametrize("read", READERS)
def test_reader_names_a_path_that_cannot_be_read(tmp_path, read):
    os.mkfifo(tmp_path / "fifo")  # which nobody writes to: opening it would block
    for path, reason in [
        (tmp_path / "missing", "does not exist"),
        (tmp_path, "is a folder"),
        (Path("/dev/null"), "not a regular file"),
        (tmp_path / "fifo", "not a regular file"),
        (tmp_path / ("x" * 300), "too long"),
        (f"{tmp_path}/nul\0byte", "null byte"),
    ]:
        with pytest.raises(InputError, match=reason) as caught:
            read(path)
        assert str(tmp_path) in str(caught.value) or "/dev/null" in str(caught.value)


def test_unreadable_file_is_named(tmp_path, monkeypatch):
    (tmp_path / "secret").write_text("x")
    # modes do not stop root, whom the tests may run as
    monkeypatch.setattr("builtins.open", _fail(PermissionError(errno.EACCES, "")))
    with pytest.raises(InputError, match="secret: permission denied"):
        files.read_text(tmp_path / "secret")


def test_too_large_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "sparse"
    with open(path, "wb") as file:
        file.truncate(files.MAX_TEXT_BYTES + 1)
    with pytest.raises(InputError, match="at most"):
        files.read_text(path)


@on_one_file
@given(value=json_values)
def test_json_round_trip(tmp_path, value):
    files.write_json(tmp_path / "value.json", value)
    assert files.read_json(tmp_path / "value.json") == value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"a": 1, "a": 2}', "'a' twice"),
        ('{"a": NaN}', "a: NaN is not a JSON number"),
        ('{"a": [1, {"b": [0, -Infinity]}]}', r"a\[1\].b\[1\]: -Infinity"),
        ("NaN", "a value: NaN"),
        ('{"a": NaN', "a value: NaN"),
        ("[1, 2", "line 1, column"),
        ("[" * 100_000, "valid JSON"),
        ("1" * 5000, "not a JSON number"),
        ("", "line 1"),
    ],
)
def test_bad_json_is_named(tmp_path, text, reason):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=reason) as caught:
        files.read_json(path)
    assert str(path) in str(caught.value)


def test_json_writer_refuses_nan(tmp_path):
    with pytest.raises(InputError, match="finite"):
        files.write_json(tmp_path / "value.json", {"a": math.nan})
    assert not list(tmp_path.iterdir())


def test_toml_errors_carry_the_line(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("a = 1\nb = \n")
    with pytest.raises(InputError, match="line 2"):
        files.read_toml(path)
    path.write_text("\ufeffa = 1\n", encoding="utf-8")
    assert files.read_toml(path) == {"a": 1}


def test_text_that_is_not_utf8_is_named(tmp_path):
    path = tmp_path / "latin1.txt"
    path.write_bytes("Straße".encode("latin-1"))
    with pytest.raises(InputError, match="byte 4 is not UTF-8"):
        files.read_text(path)


@on_one_file
@given(hnp.arrays("u1", st.sampled_from([(1, 1, 3), (3, 5, 3), (4, 2, 4)])))
def test_png_round_trip(tmp_path, image):
    files.write_image(tmp_path / "image.png", image)
    np.testing.assert_array_equal(files.read_image(tmp_path / "image.png"), image)


def test_grey_palette_and_webp_images_become_rgb(tmp_path):
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    files.write_image(tmp_path / "grey.png", grey)
    expected = np.repeat(grey[..., None], 3, axis=2)
    np.testing.assert_array_equal(files.read_image(tmp_path / "grey.png"), expected)
    red = Image.new("RGB", (4, 3), (255, 0, 0)).convert("P")
    red.save(tmp_path / "palette.png")
    assert (files.read_image(tmp_path / "palette.png") == (255, 0, 0)).all()
    red.convert("RGB").save(tmp_path / "image.webp", lossless=True)
    assert (files.read_image(tmp_path / "image.webp") == (255, 0, 0)).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_image_is_refused(tmp_path, rng, suffix):
    path = tmp_path / f"image{suffix}"
    files.write_image(path, rng.integers(0, 256, (40, 50, 3), dtype=np.uint8))
    raw = path.read_bytes()
    for length in (0, 3, 20, len(raw) // 2, len(raw) * 3 // 4):
        path.write_bytes(raw[:length])
        with pytest.raises(InputError, match="image"):
            files.read_image(path)


def test_sixteen_bit_png_round_trip(tmp_path):
    values = np.array([[0, 1, 255], [256, 40000, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "depth.png")
    found = files.read_image16(tmp_path / "depth.png")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, values)
    with pytest.raises(InputError, match="8 bits"):
        files.read_image(tmp_path / "depth.png")


@pytest.mark.parametrize("name", ["grey.png", "photo.jpg"])
def test_sixteen_bit_reader_refuses_others(tmp_path, name):
    files.write_image(tmp_path / name, np.zeros((2, 3), np.uint8))
    with pytest.raises(InputError, match=name):
        files.read_image16(tmp_path / name)


def test_image_bomb_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    files.write_image(tmp_path / "image.png", np.zeros((20, 20, 3), np.uint8))
    monkeypatch.setattr(files, "MAX_IMAGE_PIXELS", 399)
    with pytest.raises(InputError, match="20 x 20 pixels"):
        files.read_image(tmp_path / "image.png")


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("image.gif", np.zeros((2, 2, 3), np.uint8)),
        ("image.jpg", np.zeros((2, 2, 4), np.uint8)),
        ("image.png", np.zeros((2, 2, 3), np.float32)),
        ("image.png", np.zeros((2, 2, 2), np.uint8)),
        ("image.png", np.zeros((0, 2, 3), np.uint8)),
    ],
)
def test_image_writer_refuses(tmp_path, name, image):
    with pytest.raises(InputError, match=name):
        files.write_image(tmp_path / name, image)
    assert not list(tmp_path.iterdir())


def _fail(error: BaseException):
    def raise_error(*arguments: object) -> None:
        raise error

    return raise_error


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, ""), "file.txt: .*no space"),
        (OSError(errno.EROFS, ""), "file.txt: .*read-only"),
        (OSError(errno.EIO, ""), "file.txt: .*check"),
        (KeyboardInterrupt(), "^$"),
    ],
)
def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch, call, error, reason):
    path = tmp_path / "file.txt"
    files.write_text(path, "old")
    with monkeypatch.context() as patch:
        patch.setattr(os, call, _fail(error))
        with pytest.raises((InputError, KeyboardInterrupt), match=reason):
            files.write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_short_writes_are_continued(tmp_path, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: write(fd, bytes(data[:3])))
    files.write_text(tmp_path / "file.txt", "0123456789")
    assert (tmp_path / "file.txt").read_text() == "0123456789"


def test_writer_names_a_path_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    for path, reason in [
        (tmp_path, "is a folder"),
        (tmp_path / "no" / "file", "does not exist"),
        (tmp_path / "file" / "below", "not a folder"),
        (Path("/dev/null"), "not a regular file"),
    ]:
        with pytest.raises(InputError, match=reason):
            files.write_text(path, "x")
    with pytest.raises(InputError, match="not a folder"):
        files.make_folder(tmp_path / "file")
    for _ in range(2):  # it may be there
        assert files.make_folder(tmp_path / "a" / "b").is_dir()


def test_written_file_has_the_umask_mode_and_keeps_a_link(tmp_path):
    target = tmp_path / "target.txt"
    link = tmp_path / "link.txt"
    link.symlink_to(target)
    before = os.umask(0o027)
    try:
        files.write_text(link, "x")
    finally:
        os.umask(before)
    assert link.is_symlink()
    assert target.read_text() == "x"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_check_writable(tmp_path):
    target = tmp_path / "a.bin"
    files.check_writable(target)
    assert not list(tmp_path.iterdir())
    for wrong in (tmp_path, tmp_path / "none" / "a.bin"):
        with pytest.raises(InputError, match=re.escape(str(wrong))):
            files.check_writable(wrong)
