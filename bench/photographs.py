"""Photographs of a posed folder, placed anew: as they are, or turned and zoomed."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from bench.commands.quality import run_command
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.capture.transforms import read_images, write_poses
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera

KINDS = ("as it is", "turned (EXIF 6)", "zoomed", "turned (EXIF 8)", "on its side")
"""What becomes of photographs 0, 5, 10, ... of a mixed set, of 1, 6, 11, ..., etc."""
POINTS = "points.safetensors"
_ZOOM = 1.5
_FOCAL_MM = 4.0
_ON_SIDE = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_QUALITY = 95


def place(
    given: PosedImages, work: Path, mixed: bool, long_edge: int, seed: int
) -> None:
    """Write photographs without poses, and have `capture` place them.

    Args:
        given: the photographs, with their poses.
        work: folder that gets `photographs`, `given` with a transforms.json of these,
            and `posed`, what `capture` wrote. What it has written is not done again.
        mixed: turn and zoom them by `KINDS`.
        long_edge: look for features at most at this size, pixels.
        seed: of the random choices.
    """
    photographs = files.make_folder(work / "photographs")
    if not (work / "given/transforms.json").is_file():
        names = [f"{i:04d}.{'jpg' if mixed else 'png'}" for i in range(len(given))]
        cameras, poses = [], []
        for i, name in enumerate(names):
            image, camera = given.images[i][..., :3], given.camera_of(i)
            pose, kind = given.camera_to_world[i], KINDS[i % len(KINDS) * mixed]
            if mixed:
                image, camera, pose = write_mixed(
                    photographs / name, image, camera, pose, kind
                )
            else:
                files.write_image(photographs / name, image)
            cameras.append(camera)
            poses.append(pose)
        stored = [f"../posed/images/{name}" for name in names]  # upright, if placed
        files.make_folder(work / "given")
        write_poses(work / "given/transforms.json", stored, cameras, np.stack(poses))
    if not (work / "posed/transforms.json").is_file():
        words = ["capture", str(photographs), "-o", str(work / "posed")]
        run_command([*words, "--long-edge", str(long_edge), "--seed", str(seed)])


def write_mixed(
    path: Path, image: np.ndarray, camera: Camera, pose: np.ndarray, kind: str
) -> tuple[np.ndarray, Camera, np.ndarray]:
    """Store a photograph as if it had been held or zoomed otherwise.

    Returns:
        what it shows, upright as far as EXIF data say so, and its camera and pose.
    """
    exif, focal_mm, turn = Image.Exif(), _FOCAL_MM, 0
    if kind == "zoomed":
        image, camera = zoomed(image, camera)
        focal_mm *= _ZOOM
    elif kind == "on its side":
        image, camera, pose = np.rot90(image), on_side(camera), pose @ _ON_SIDE
    elif kind != "as it is":
        turn = 1 if kind == "turned (EXIF 6)" else 3
        exif[ExifTags.Base.Orientation] = 6 if turn == 1 else 8
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal_mm
    stored = np.ascontiguousarray(np.rot90(image, turn))
    Image.fromarray(stored).save(path, exif=exif, quality=_QUALITY)
    return image, camera, pose


def zoomed(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Cut the middle out of a photograph, and enlarge it to the whole's size."""
    height, width = image.shape[:2]
    w, h = round(width / _ZOOM), round(height / _ZOOM)
    x, y = (width - w) // 2, (height - h) // 2
    part = Image.fromarray(image[y : y + h, x : x + w])
    large = part.resize((width, height), Image.Resampling.LANCZOS)
    a, b = width / w, height / h
    nearer = replace(
        camera,
        fx=a * camera.fx,
        fy=b * camera.fy,
        cx=a * (camera.cx - x),
        cy=b * (camera.cy - y),
    )
    return np.asarray(large), nearer


def on_side(camera: Camera) -> Camera:
    """Return the camera of pictures that were turned by 90 degrees to the left.

    What was at the right is at the top: x' = y and y' = -x, also in the distortion.
    """
    return Camera(
        camera.height,
        camera.width,
        camera.fy,
        camera.fx,
        camera.cy,
        camera.width - camera.cx,
        camera.k1,
        camera.k2,
        -camera.p2,
        camera.p1,
    )


def compare_poses(work: Path) -> dict[str, float]:
    """Return how far the poses that `capture` found are from those given.

    Returns:
        photographs and those placed, medians and maxima of `pose_errors`, the mean
        reprojection error, and the greatest relative error of a focal length.
    """
    given, found = _both(work)
    turns, shares = pose_errors(found.camera_to_world, given.camera_to_world)
    focal = [found.camera_of(i).fx / given.camera_of(i).fx for i in range(len(found))]
    table = files.read_json(work / "posed/capture.json")
    return {
        "photographs": table["photographs"],
        "placed": table["placed"],
        "rotation_deg": float(np.median(turns)),
        "rotation_most_deg": float(turns.max()),
        "position_share": float(np.median(shares)),
        "position_most_share": float(shares.max()),
        "focal_most_share": float(np.abs(np.array(focal) - 1).max()),
        "reprojection_error_px": table["reprojection_error_px"],
    }


def _both(work: Path) -> tuple[PosedImages, PosedImages]:
    """Return the photographs that were placed, with the poses given and found."""
    given = read_images(work / "given", skip_missing=True)
    found = read_images(work / "posed")
    ours = [Path(name).name for name in found.names]
    assert ours == [Path(name).name for name in given.names]
    return given, found


def compare_fits(work: Path, steps: int, long_edge: int) -> dict[str, float]:
    """Fit fields to the poses given and to those found, with equal steps.

    All see the photographs that were placed, and hold the same out. Sparse points tell
    another box than poses alone, so both are fitted to in either: in the `cube` around
    what the cameras look at, and in the box of the `points` found.

    Returns:
        mean PSNR of the held-out views, dB, and of which there are how many.
    """
    given, found = _both(work)
    assert found.points is not None
    points = {"found": found.points}
    poses = {"found": found.camera_to_world, "given": given.camera_to_world}
    points["given"] = move(found.points, *poses.values())
    result: dict[str, float] = {}
    for side, box in itertools.product(poses, ("cube", "points")):
        name = f"{side}_{box}"
        output = work / f"{name}-{steps}.safetensors"
        if not output.is_file():
            folder = files.make_folder(work / "fitted" / name)
            extra = {"points_file": POINTS} if box == "points" else {}
            tensors = {"points": points[side].astype(np.float32)}
            files.write_safetensors(folder / POINTS, tensors)
            of = found if side == "found" else given
            cameras = [of.camera_of(i) for i in range(len(of))]
            names = [f"../../posed/{image}" for image in found.names]
            write_poses(folder / "transforms.json", names, cameras, poses[side], extra)
            words = ["fit", str(folder), "-o", str(output), "--network", "small"]
            words += ["--long-edge", str(long_edge), "--steps", str(steps)]
            run_command(words)
        scores = files.read_json(output.with_suffix(".report") / "metrics.json")
        result[f"{name}_psnr_db"] = scores["psnr_heldout_db"]
        result["held_out"] = len(scores["per_view"])
    return result


def pose_errors(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses (n, 4, 4) after a similarity of their places.

    Returns:
        rotations that remain, degrees, and distances by the greatest one between two
        given places, (n,) each.
    """
    _, turn = similarity(found, given)
    wanted = given[:, :3, 3]
    apart = np.linalg.norm(move(found[:, :3, 3], found, given) - wanted, axis=1)
    left = turn * Rotation.from_matrix(found[:, :3, :3])
    left = left.inv() * Rotation.from_matrix(given[:, :3, :3])
    return np.degrees(left.magnitude()), apart / pdist(wanted).max()


def move(points: np.ndarray, found: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Move points (m, 3) as the similarity of places moves poses to others."""
    scale, turn = similarity(found, given)
    centre = found[:, :3, 3].mean(0)
    return scale * turn.apply(points - centre) + given[:, :3, 3].mean(0)


def similarity(found: np.ndarray, given: np.ndarray) -> tuple[float, Rotation]:
    """Return the scale and the rotation that bring the places of poses to others."""
    eyes, wanted = found[:, :3, 3], given[:, :3, 3]
    centred, target = eyes - eyes.mean(0), wanted - wanted.mean(0)
    turn = Rotation.align_vectors(target, centred)[0]
    turned = turn.apply(centred)
    return float((turned * target).sum() / (turned**2).sum()), turn
