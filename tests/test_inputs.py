"""Folders as other programs leave them, and the messages for what cannot be used.

Messages are taken from the command line: exit code 2, one line, nothing written.
"""

from __future__ import annotations

import json
import pickle
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_nerfattack import cli, files
from mi_nerfattack.capture.fit_inputs import read_depth
from mi_nerfattack.capture.frames import read_images
from mi_nerfattack.render.camera import Camera, look_at
from mi_nerfattack.render.conventions import opencv_to_opengl

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 12, 8


def poses(count: int) -> list[list[list[float]]]:
    """OpenGL matrices of cameras that look at the origin."""
    eyes = [[3 * np.cos(i), 3 * np.sin(i), 1.0] for i in range(count)]
    matrices = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    return opencv_to_opengl(matrices).tolist()


def picture(i: int, channels: int = 3, width: int = WIDTH) -> np.ndarray:
    rng = np.random.default_rng(i)
    return rng.integers(0, 255, (HEIGHT, width, channels), dtype=np.uint8)


def write(folder: Path, table: dict, name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(table))
    return folder


def nerfstudio(folder: Path) -> Path:
    """As ns-process-data writes it: intrinsics, depth and more in every frame."""
    for sub in ("images", "depths"):
        (folder / sub).mkdir()
    frames = []
    for i, matrix in enumerate(poses(3)):
        name = f"frame_{i:05d}"
        files.write_image(folder / f"images/{name}.png", picture(i))
        millimetres = np.full((HEIGHT // 2, WIDTH // 2), 1500, np.uint16)
        Image.fromarray(millimetres).save(folder / f"depths/{name}.png")
        frames.append(
            {
                "fl_x": 10.0 + i,
                "fl_y": 11.0 + i,
                "cx": 6.25,
                "cy": 3.75,
                "w": WIDTH,
                "h": HEIGHT,
                "k1": 0.01 * i,
                "k2": 0.0,
                "p1": 0.0,
                "p2": 0.0,
                "file_path": f"images/{name}.png",
                "depth_file_path": f"depths/{name}.png",
                "colmap_im_id": i + 1,
                "transform_matrix": matrix,
            }
        )
    return write(
        folder,
        {
            "camera_model": "OPENCV",
            "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
            "ply_file_path": "sparse_pc.ply",
            "frames": frames,
        },
    )


def instant_ngp(folder: Path) -> Path:
    """As Instant-NGP's colmap2nerf writes it."""
    (folder / "images").mkdir()
    frames = []
    for i, matrix in enumerate(poses(3)):
        files.write_image(folder / f"images/{i}.jpg", picture(i))
        frames.append(
            {
                "file_path": f"./images/{i}.jpg",
                "sharpness": 30.0,
                "transform_matrix": matrix,
            }
        )
    return write(
        folder,
        {
            "camera_angle_x": 1.0,
            "camera_angle_y": 0.7,
            "fl_x": 10.0,
            "fl_y": 11.0,
            "k1": 0.01,
            "k2": 0.002,
            "k3": 0,
            "k4": 0,
            "p1": 0.001,
            "p2": 0.002,
            "is_fisheye": False,
            "cx": 6.5,
            "cy": 3.75,
            "w": float(WIDTH),
            "h": float(HEIGHT),
            "aabb_scale": 4,
            "frames": frames,
        },
    )


def blender(folder: Path) -> Path:
    """As Blender's synthetic scenes: three JSON files, RGBA, no suffix, no size."""
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        (folder / split).mkdir()
        frames = []
        for i, matrix in enumerate(poses(count)):
            files.write_image(folder / f"{split}/r_{i}.png", picture(i, 4))
            frames.append(
                {
                    "file_path": f"./{split}/r_{i}",
                    "rotation": 0.01,
                    "transform_matrix": matrix,
                }
            )
        table = {"camera_angle_x": 0.6911112070083618, "frames": frames}
        write(folder, table, f"transforms_{split}.json")
    return folder


def colmap(folder: Path) -> Path:
    """A binary model in sparse/0 beside its images."""
    (folder / "images").mkdir()
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    camera = struct.pack("<QiiQQ3d", 1, 1, 0, WIDTH, HEIGHT, 10.0, 6.0, 4.0)
    (model / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", 3)
    for i in range(3):
        images += struct.pack("<I7dI", i, 1.0, 0.1 * i, 0.2, 0.0, 0.0, 0.0, 2.0, 1)
        images += f"{i}.png".encode() + b"\0" + struct.pack("<Q", 0)
        files.write_image(folder / f"images/{i}.png", picture(i))
    (model / "images.bin").write_bytes(images)
    return folder


class TestFolders:
    def test_nerfstudio(self, tmp_path):
        read = read_images(nerfstudio(tmp_path))
        assert len(read.cameras) == 3
        for i in range(3):
            expected = Camera(
                WIDTH, HEIGHT, 10.0 + i, 11.0 + i, 6.25, 3.75, k1=0.01 * i
            )
            assert read.camera_of(i) == expected
        half = read_images(tmp_path, long_edge_px=6)
        assert half.camera_of(2).fx == 6.0 and half.camera_of(2).k1 == 0.02
        assert half.images.shape == (3, 4, 6, 3)
        depth = read_depth(tmp_path, half)
        # the optical axis passes (3.125, 1.875); half a pixel beside it, next to 1.5 m
        assert depth[0, 1, 3] == pytest.approx(1.5, abs=0.02)
        assert (depth >= 1.5).all() and depth[0, 0, 0] > 1.55

    def test_equal_numbers_in_frames_are_one_camera(self, tmp_path):
        nerfstudio(tmp_path)
        table = json.loads((tmp_path / "transforms.json").read_text())
        for frame in table["frames"]:
            frame.update(fl_x=10.0, fl_y=11.0, k1=0.0)
        write(tmp_path, table)
        read = read_images(tmp_path)
        assert read.cameras == () and read.camera_of(2) == read.camera

    def test_distortion_params(self, tmp_path):
        nerfstudio(tmp_path)
        table = json.loads((tmp_path / "transforms.json").read_text())
        table["frames"][1]["distortion_params"] = [0.03, 0.01, 0, 0, 1e-3, 2e-3]
        write(tmp_path, table)
        lens = read_images(tmp_path).camera_of(1).distortion
        assert lens == (0.03, 0.01, 1e-3, 2e-3)

    def test_instant_ngp(self, tmp_path):
        read = read_images(instant_ngp(tmp_path))
        lens = (0.01, 0.002, 0.001, 0.002)
        assert read.cameras == () and read.unit == "unknown"
        assert read.camera == Camera(WIDTH, HEIGHT, 10.0, 11.0, 6.5, 3.75, *lens)
        np.testing.assert_allclose(
            read.camera_to_world, np.array(poses(3)) * [1, -1, -1, 1], atol=1e-12
        )

    def test_blender(self, tmp_path):
        read = read_images(blender(tmp_path))
        assert read.images.shape == (3, HEIGHT, WIDTH, 4)
        np.testing.assert_array_equal(read.images[1], picture(1, 4))
        focal = 0.5 * WIDTH / np.tan(0.5 * 0.6911112070083618)
        assert read.camera.fx == read.camera.fy == pytest.approx(focal)
        assert read_depth(tmp_path, read) is None

    def test_colmap(self, tmp_path):
        read = read_images(colmap(tmp_path))
        assert read.camera == Camera(WIDTH, HEIGHT, 10.0, 10.0, 6.0, 4.0)
        assert read_depth(tmp_path, read) is None


def change_frame(**values: object) -> Callable[[Path], None]:
    """Return a change of the second frame of a transforms.json."""

    def change(folder: Path) -> None:
        table = json.loads((folder / "transforms.json").read_text())
        table["frames"][1].update(values)
        write(folder, table)

    return change


def scaled(factors: list[float]) -> list[list[float]]:
    return (np.array(poses(2)[1]) * [*factors, 1.0]).tolist()


def with_nan() -> list[list[float]]:
    matrix = poses(2)[1]
    matrix[0][3] = float("nan")
    return matrix


def with_infinity(folder: Path) -> None:
    change_frame(transform_matrix=scaled([1, 1, 12345]))(folder)
    path = folder / "transforms.json"
    matrix = json.loads(path.read_text())["frames"][1]["transform_matrix"]
    path.write_text(path.read_text().replace(repr(matrix[0][2]), "1e999"))


def cut(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        raw = (folder / name).read_bytes()
        (folder / name).write_bytes(raw[: len(raw) // 2])

    return change


def garbage(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(np.random.default_rng(1).bytes(500))

    return change


def remove(*names: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return change


def image_of_width(name: str, width: int) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        files.write_image(folder / name, picture(9, width=width))

    return change


MATRIX = r"transforms.json: frames\[1\].transform_matrix"
IMAGES = tuple(f"images/{i}.png" for i in range(3))
UNUSABLE = {
    "missing image": (
        instant_ngp,
        remove("images/1.jpg"),
        r"transforms.json: 1 of 3 frames have no image, first './images/1.jpg'",
    ),
    "truncated JPEG": (instant_ngp, cut("images/1.jpg"), "1.jpg: damaged image"),
    "garbage JPEG": (instant_ngp, garbage("images/1.jpg"), "1.jpg: not an image"),
    "scale zero": (
        instant_ngp,
        change_frame(transform_matrix=scaled([0, 0, 0])),
        f"{MATRIX}: not a rigid pose",
    ),
    "reflection": (
        instant_ngp,
        change_frame(transform_matrix=scaled([1, 1, -1])),
        f"{MATRIX}: the pose is a reflection",
    ),
    "NaN": (
        instant_ngp,
        change_frame(transform_matrix=with_nan()),
        rf"{MATRIX}\[0\]\[3\]: NaN is not a JSON number",
    ),
    "infinity": (instant_ngp, with_infinity, f"{MATRIX}: .* NaN or infinity"),
    "mixed sizes": (
        instant_ngp,
        image_of_width("images/1.jpg", 14),
        "1.jpg: 14 x 8 px, but .*0.jpg has 12 x 8 px",
    ),
    "mixed sizes, each with its intrinsics": (
        nerfstudio,
        lambda folder: (
            image_of_width("images/frame_00001.png", 14)(folder),
            change_frame(w=14)(folder),
        ),
        "frame_00001.png: 14 x 8 px, but .*frame_00000.png has 12 x 8 px",
    ),
    "size against intrinsics": (
        instant_ngp,
        lambda folder: write(
            folder,
            {**json.loads((folder / "transforms.json").read_text()), "w": 1080},
        ),
        "transforms.json: w, h: 1080 x 8, but the first image has 12 x 8",
    ),
    "size against intrinsics of a frame": (
        nerfstudio,
        change_frame(w=1080),
        r"frame_00001.png: 12 x 8 px, .*transforms.json are for 1080 x 8",
    ),
    "not JSON": (instant_ngp, garbage("transforms.json"), "transforms.json: .*UTF-8"),
    "depth that is missing": (
        nerfstudio,
        remove("depths/frame_00001.png"),
        "frame_00001.png: does not exist",
    ),
    "truncated cameras.bin": (
        colmap,
        cut("sparse/0/cameras.bin"),
        "cameras.bin: byte 0: 1 cameras need 24 bytes, 20 are left",
    ),
    "truncated images.bin": (
        colmap,
        cut("sparse/0/images.bin"),
        "images.bin: byte .*truncated",
    ),
    "garbage cameras.bin": (
        colmap,
        garbage("sparse/0/cameras.bin"),
        "cameras.bin: byte 0: .* cameras need",
    ),
    "COLMAP without images": (
        colmap,
        remove(*IMAGES),
        "sparse/0: none of the 3 images is there, first '0.png'; put them into",
    ),
    "empty folder": (
        colmap,
        remove("sparse/0/cameras.bin"),
        "no posed images; looked for transforms.json.*3 photographs",
    ),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_fit_refuses(tmp_path, capsys, case):
    make, spoil, message = UNUSABLE[case]
    folder = tmp_path / "in"
    folder.mkdir()
    make(folder)
    spoil(folder)
    before = sorted(tmp_path.rglob("*"))
    code = cli.main(["fit", str(folder), "-o", str(tmp_path / "field.safetensors")])
    check_refusal(code, capsys.readouterr(), message)
    assert sorted(tmp_path.rglob("*")) == before


def check_refusal(code: int, captured, message: str) -> None:
    lines = captured.err.strip().splitlines()
    assert code == 2 and len(lines) == 1, captured.err
    assert lines[0].startswith("mi-nerfattack: error: ")
    assert re.search(message, lines[0]), lines[0]
    assert captured.out == ""


@pytest.mark.parametrize("kind", ["zip", "pickle", "truncated"])
def test_field_files_of_other_formats(tmp_path, capsys, kind):
    """A scene that names a field file of another format, rendered."""
    path = tmp_path / "field.safetensors"
    if kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data.pkl", pickle.dumps({"density": [1.0]}))
    elif kind == "pickle":
        path.write_bytes(pickle.dumps({"density": [1.0]}))
    else:
        path.write_bytes(struct.pack("<Q", 1000) + b"{")
    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><sensor type="perspective"/>'
        '<integrator type="field_integrator"><volume type="grid_field">'
        '<string name="filename" value="field.safetensors"/></volume></integrator>'
        "</scene>"
    )
    before = sorted(tmp_path.rglob("*"))
    code = cli.main(["render", str(scene), "-o", str(tmp_path / "frame.exr")])
    expected = {"zip": "is a zip archive", "pickle": "is a pickle"}
    check_refusal(
        code,
        capsys.readouterr(),
        f"field.safetensors: .*{expected.get(kind, 'truncated')}",
    )
    assert sorted(tmp_path.rglob("*")) == before
