"""``python -m bench capture``: photographs placed anew, and ever fewer of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from bench.results import run_command, stamp
from bench.tables import markdown
from mi_nerfattack import variant
from mi_nerfattack.capture.coverage import view_gaps
from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.capture.transforms import read_images, write_poses
from mi_nerfattack.commands.shared.options import check_positive
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.fields import load_field
from mi_nerfattack.fit.scores import FieldRenderer, compare, reference
from mi_nerfattack.io import files

TRANSFORMS = "transforms.json"
FIGURES = "figures.json"
PLACED, ROTATION_DEG, POSITION = 0.96, 1.0, 0.01  # least share, and most


@dataclass(frozen=True)
class BenchPoses:
    """Estimate the poses of a posed folder's photographs alone, and compare.

    Both are brought together by a similarity of the cameras' places. Prints photographs
    placed, and medians of rotation and position, the latter as a share of the greatest
    distance between two cameras. Exit code 1 unless 96 % are placed, within 1 degree
    and 1 %.
    """

    folder: tyro.conf.Positional[Path]
    """Posed photographs, as `fit` reads them; `$NERFATTACK_DATA/fox`, for one."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for photographs and poses, where the same command goes on; of other
    options, another."""
    long_edge: int = 1600
    """Look for features at most at this size, pixels."""
    json: bool = False
    """Print one line of JSON in place of lines."""

    def run(self) -> Result:
        """Estimate, compare and print."""
        variant.ensure()
        work = self.output
        if not (work / "given" / TRANSFORMS).is_file():
            write_photographs(read_images(self.folder, skip_missing=True), work)
        if not (work / "posed" / TRANSFORMS).is_file():
            words = [str(work / "photographs"), "-o", str(work / "posed")]
            edge = ["--long-edge", str(self.long_edge)]
            run_command(["capture", "photographs", *words, *edge])
        original = read_images(work / "given", skip_missing=True)
        estimated = read_images(work / "posed")
        turns, shares = pose_errors(estimated.camera_to_world, original.camera_to_world)
        cameras = [
            (estimated.camera_of(i), original.camera_of(i))
            for i in range(len(estimated))
        ]
        table = files.read_json(work / "posed" / "capture.json")
        document = {
            "photographs": table["photographs"],
            "placed": table["placed"],
            "rotation_deg": float(np.median(turns)),
            "rotation_most_deg": float(turns.max()),
            "position_share": float(np.median(shares)),
            "position_most_share": float(shares.max()),
            "focal_most_share": max(abs(ours.fx / own.fx - 1) for ours, own in cameras),
            "reprojection_error_px": table["reprojection_error_px"],
        }
        good = (
            document["placed"] >= PLACED * document["photographs"]
            and document["rotation_deg"] <= ROTATION_DEG
            and document["position_share"] <= POSITION
        )
        files.write_json(work / FIGURES, stamp(document, "python -m bench poses"))
        rows = [(name, f"{value:.5g}") for name, value in document.items()]
        table = markdown(("figure", "value"), rows)
        return Result(document, lambda: print(table), int(not good))


@dataclass(frozen=True)
class BenchGaps:
    """Fit small fields to ever fewer photographs, and score what they have not seen.

    Prints, for each share of the photographs, how far the others are from those fitted
    to, as seen from what they show, and their PSNR beside that of those fitted to. What
    `capture` and `fit` warn of was set by this.
    """

    folder: tyro.conf.Positional[Path]
    """What `capture` wrote of many photographs of one scene."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the fields, where the same command goes on."""
    every: tuple[int, ...] = (1, 2, 4, 8)
    """Keep every so manieth photograph; of those, every 8th is not fitted to."""
    steps: int = 600
    """Of each fit."""
    long_edge: int = 320
    """Of the photographs, pixels."""
    json: bool = False
    """Print one line of JSON in place of a table."""

    def run(self) -> Result:
        """Fit, score and print."""
        variant.ensure()
        check_positive(self, "steps", "long_edge")
        files.make_folder(self.output)
        figures = [thinned(self, every) for every in self.every]
        document = stamp({"rows": figures}, "python -m bench gaps")
        files.write_json(self.output / FIGURES, document)
        header = (
            "fitted to",
            "PSNR of these",
            "gap of the others",
            "PSNR of the others",
        )
        rows = [
            (
                str(row["fitted"]),
                f"{row['psnr_fitted_db']:.1f} dB",
                f"{row['gap_deg']:.1f} degrees",
                f"{row['psnr_db']:.1f} dB",
            )
            for row in figures
        ]
        return Result({"rows": figures}, lambda: print(markdown(header, rows)))


def write_photographs(original: PosedImages, work: Path) -> None:
    """Write photographs without poses, and a transforms.json with the poses given.

    Args:
        original: the photographs, with their poses.
        work: folder that gets `photographs` and `given`.
    """
    photographs = files.make_folder(work / "photographs")
    names = [f"{i:04d}.png" for i in range(len(original))]
    for image, name in zip(original.images, names, strict=True):
        files.write_image(photographs / name, image[..., :3])
    cameras = [original.camera_of(i) for i in range(len(original))]
    stored = [f"../posed/images/{name}" for name in names]  # upright, if placed
    files.make_folder(work / "given")
    write_poses(
        work / "given" / TRANSFORMS,
        stored,
        cameras,
        camera_to_world=original.camera_to_world,
    )


def pose_errors(
    estimated: np.ndarray, original: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses (n, 4, 4) after a similarity of their places.

    Returns:
        rotations that remain, degrees, and distances by the greatest one between two
        original places, (n,) each.
    """
    eyes, original_eyes = estimated[:, :3, 3], original[:, :3, 3]
    centred, target = eyes - eyes.mean(0), original_eyes - original_eyes.mean(0)
    turn = Rotation.align_vectors(target, centred)[0]
    turned = turn.apply(centred)
    scale = (turned * target).sum() / (turned**2).sum()
    left = turn * Rotation.from_matrix(estimated[:, :3, :3])
    left = left.inv() * Rotation.from_matrix(original[:, :3, :3])
    apart = np.linalg.norm(scale * turned - target, axis=1)
    return np.degrees(left.magnitude()), apart / pdist(original_eyes).max()


def thinned(options: BenchGaps, every: int) -> dict[str, Any]:
    """Fit to every so manieth photograph, unless it is done, and score all others.

    Returns:
        number of photographs that were fitted to; PSNR of these by the loss at the
        end; median gap to these (`view_gaps`, degrees) and mean PSNR of the others, dB.
    """
    images = read_images(options.folder, options.long_edge)
    indices = np.arange(0, len(images), every)
    output = options.output / f"every-{every}-{options.steps}.safetensors"
    if not output.is_file():
        own = files.make_folder(options.output / f"every-{every}")
        table = files.read_json(options.folder / TRANSFORMS)
        table["points_file"] = os.path.relpath(
            options.folder / table["points_file"], own
        )
        table["frames"] = table["frames"][::every]
        for frame in table["frames"]:
            for name in frame.keys() & {"file_path", "mask_path"}:
                frame[name] = os.path.relpath(options.folder / frame[name], own)
        files.write_json(own / TRANSFORMS, table)
        words = ["fit", str(own), "-o", str(output), "--network", "small"]
        words += ["--steps", str(options.steps), "--long-edge", str(options.long_edge)]
        run_command(words)
    fitted = np.zeros(len(images), bool)
    fitted[np.delete(indices, held_out(len(indices)))] = True
    assert images.points is not None
    cameras = [images.camera_of(i) for i in range(len(images))]
    gaps = view_gaps(cameras, images.camera_to_world, images.points, others=fitted)
    renderer, scores = FieldRenderer(load_field(output)), []
    for i in np.flatnonzero(~fitted).tolist():
        shown = renderer.render(cameras[i], images.camera_to_world[i]).image
        scores.append(float(compare(shown, reference(images, i))[0]))
    report = files.read_json(output.with_suffix(".report") / "metrics.json")
    return {
        "every": every,
        "fitted": int(fitted.sum()),
        "psnr_fitted_db": report["psnr_fitted_db"],
        "gap_deg": float(np.median(gaps[~fitted])),
        "psnr_db": float(np.mean(scores)),
    }
