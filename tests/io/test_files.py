from __future__ import annotations

import errno
import math
import os
import pickle
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
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


def test_safetensors_round_trip(tmp_path, rng):
    path, metadata = tmp_path / "tensors.safetensors", {"": "é\n", "step": "12"}
    shapes = (), (0,), (3, 0, 2), (2, 3), (1, 2, 3, 4)
    tensors = {
        f"{kind} {shape}": (100 * rng.random(shape)).astype(kind)
        for kind in TYPES
        for shape in shapes
    }
    files.write_safetensors(path, tensors, metadata)
    read, note = files.read_safetensors(path)
    assert note == metadata and read.keys() == tensors.keys()
    for name, value in tensors.items():
        np.testing.assert_array_equal(read[name], value, strict=True)


def test_safetensors_bytes_are_reproducible_and_standard(tmp_path):
    tensors = {"b": np.arange(6.0).reshape(2, 3).T, "a": np.float32(1.5)}
    metadata = {str(i): "x" * i for i in range(20)}
    paths = tmp_path / "a", tmp_path / "b"
    files.write_safetensors(paths[0], tensors, metadata)
    files.write_safetensors(paths[1], tensors, dict(reversed(metadata.items())))
    raw = paths[0].read_bytes()
    assert raw == paths[1].read_bytes()
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


def test_every_truncation_of_safetensors_is_refused(tmp_path):
    path = tmp_path / "tensors.safetensors"
    files.write_safetensors(path, {"a": np.arange(5.0)}, {"kind": "grid"})
    raw = path.read_bytes()
    for length in range(len(raw)):
        path.write_bytes(raw[:length])
        with pytest.raises(InputError, match="truncated"):
            files.read_safetensors(path)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickle_and_zip_are_refused_unread(tmp_path, protocol):
    raw, path = pickle.dumps({"a": [1.0] * 100}, protocol), tmp_path / "a.safetensors"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=f"{path}: .*pickle"):
        files.read_safetensors(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", raw)
    with pytest.raises(InputError, match=f"{path}: .*zip"):
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
        assert str(tmp_path) in caught.value.where or "/dev/null" in caught.value.where


def test_too_large_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "sparse"
    with open(path, "wb") as file:
        file.truncate(files.MAX_TEXT_BYTES + 1)
    with pytest.raises(InputError, match="at most"):
        files.read_text(path)
    monkeypatch.setattr(files, "_check_file", lambda *_: 2)
    with pytest.raises(InputError, match="more than 2 bytes; it grows"):
        files.read_bytes(path, 2)


@pytest.mark.parametrize(
    "value", [None, {}, [], {"é\u2028": [True, -(2**60), 1e-300, 0.1, {"": [None]}]}]
)
def test_json_round_trip(tmp_path, value):
    files.write_json(tmp_path / "value.json", value)
    assert files.read_json(tmp_path / "value.json") == value


CLAIM = b'{"a":{"dtype":"F32","shape":[%d],"data_offsets":[0,%d]}}' % (1 << 38, 1 << 40)
TENSORS = len(CLAIM).to_bytes(8, "little") + CLAIM + bytes(8)


@pytest.mark.parametrize(
    ("read", "content", "reason"),
    [
        (files.read_json, b'{"a": 1, "a": 2}', ".*'a' twice"),
        (files.read_json, b'{"a": NaN}', "a: NaN"),
        (files.read_json, b'{"a": [1, {"b": [0, -Infinity]}]}', r"a\[1\].b\[1\]: -Inf"),
        (files.read_json, b"NaN", "a value: NaN"),
        (files.read_json, b'{"a": NaN', "a value: NaN"),
        (files.read_json, b"[1, 2", ".*line 1, column"),
        (files.read_json, b"[" * 100_000, ".*valid JSON"),
        (files.read_json, b"", ".*line 1"),
        (files.read_toml, b"a = 1\nb = \n", ".*line 2"),
        (files.read_text, "Straße".encode("latin-1"), ".*byte 4 is not UTF-8"),
        (files.read_safetensors, TENSORS, ".*truncated"),
    ],
)
def test_bad_content_is_named(tmp_path, read, content, reason):
    path = tmp_path / "bad"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"{path}: {reason}"):
        read(path)


def test_a_toml_file_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.toml").write_text("\ufeffa = 1\n", encoding="utf-8")
    assert files.read_toml(tmp_path / "a.toml") == {"a": 1}


@pytest.mark.parametrize("shape", [(1, 1, 3), (3, 5, 3), (4, 2, 4)])
def test_png_round_trip(tmp_path, rng, shape):
    image = rng.integers(0, 256, shape, np.uint8)
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
    for length in (0, 20, len(raw) * 3 // 4):
        path.write_bytes(raw[:length])
        with pytest.raises(InputError, match=f"{path}: .*image"):
            files.read_image(path)


def test_sixteen_bit_png_round_trip(tmp_path):
    path = tmp_path / "depth.png"
    values = np.array([[0, 1, 255], [256, 40000, 65535]], np.uint16)
    Image.fromarray(values).save(path)
    np.testing.assert_array_equal(files.read_image16(path), values, strict=True)
    with pytest.raises(InputError, match=f"{path}: .*8 bits"):
        files.read_image(path)
    for name in ("grey.png", "photo.jpg"):
        files.write_image(tmp_path / name, np.zeros((2, 3), np.uint8))
        with pytest.raises(InputError, match=f"{name}: "):
            files.read_image16(tmp_path / name)


def test_image_bomb_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    files.write_image(tmp_path / "image.png", np.zeros((20, 20, 3), np.uint8))
    monkeypatch.setattr(files, "MAX_IMAGE_PIXELS", 399)
    with pytest.raises(InputError, match="20 x 20 pixels"):
        files.read_image(tmp_path / "image.png")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("image.gif", np.zeros((2, 2, 3), np.uint8)),
        ("image.jpg", np.zeros((2, 2, 4), np.uint8)),
        ("image.png", np.zeros((2, 2, 3), np.float32)),
        ("image.png", np.zeros((2, 2, 2), np.uint8)),
        ("image.png", np.zeros((0, 2, 3), np.uint8)),
        ("value.json", {"a": math.nan}),
    ],
)
def test_writers_refuse(tmp_path, name, value):
    write = files.write_json if name.endswith("json") else files.write_image
    with pytest.raises(InputError, match=name):
        write(tmp_path / name, value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, ""), "file.txt: .*no space"),
        (OSError(errno.EROFS, ""), "file.txt: .*read-only"),
        (KeyboardInterrupt(), "^$"),
    ],
)
def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch, call, error, reason):
    def fail(*arguments: object) -> None:
        raise error

    path = tmp_path / "file.txt"
    files.write_text(path, "old")
    with monkeypatch.context() as patch:
        patch.setattr(os, call, fail)
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
    for path in (tmp_path, tmp_path / "no" / "file"):
        with pytest.raises(InputError, match=f"^{path}"):
            files.check_writable(path)
    files.check_writable(tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with pytest.raises(InputError, match="not a folder"):
        files.make_folder(tmp_path / "file")
    for _ in range(2):  # it may be there
        assert files.make_folder(tmp_path / "a" / "b").is_dir()


def test_written_file_has_the_umask_mode_and_keeps_a_link(tmp_path):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    link.symlink_to(target)
    before = os.umask(0o027)
    try:
        files.write_text(link, "x")
    finally:
        os.umask(before)
    assert link.is_symlink() and target.read_text() == "x"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
