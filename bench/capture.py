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
            write_given(read_images(self.folder, skip_missing=True), work)
        if not (work / "posed" / TRANSFORMS).is_file():
            words = [str(work / "photographs"), "-o", str(work / "posed")]
            edge = ["--long-edge", str(self.long_edge)]
            run_command(["capture", "photographs", *words, *edge])
        given = read_images(work / "given", skip_missing=True)
        found = read_images(work / "posed")
        turns, shares = pose_errors(found.camera_to_world, given.camera_to_world)
        cameras = [(found.camera_of(i), given.camera_of(i)) for i in range(len(found))]
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
        found = [thinned(self, every) for every in self.every]
        told = stamp({"rows": found}, "python -m bench gaps")
        files.write_json(self.output / FIGURES, told)
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
            for row in found
        ]
        return Result({"rows": found}, lambda: print(markdown(header, rows)))


def write_given(given: PosedImages, work: Path) -> None:
    """Write photographs without poses, and a transforms.json with the poses given.

    Args:
        given: the photographs, with their poses.
        work: folder that gets `photographs` and `given`.
    """
    photographs = files.make_folder(work / "photographs")
    names = [f"{i:04d}.png" for i in range(len(given))]
    for image, name in zip(given.images, names, strict=True):
        files.write_image(photographs / name, image[..., :3])
    cameras = [given.camera_of(i) for i in range(len(given))]
    stored = [f"../posed/images/{name}" for name in names]  # upright, if placed
    files.make_folder(work / "given")
    write_poses(work / "given" / TRANSFORMS, stored, cameras, given.camera_to_world)


def pose_errors(found: np.ndarray, given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compare poses (n, 4, 4) after a similarity of their places.

    Returns:
        rotations that remain, degrees, and distances by the greatest one between two
        given places, (n,) each.
    """
    eyes, wanted = found[:, :3, 3], given[:, :3, 3]
    centred, target = eyes - eyes.mean(0), wanted - wanted.mean(0)
    turn = Rotation.align_vectors(target, centred)[0]
    turned = turn.apply(centred)
    scale = (turned * target).sum() / (turned**2).sum()
    left = turn * Rotation.from_matrix(found[:, :3, :3])
    left = left.inv() * Rotation.from_matrix(given[:, :3, :3])
    apart = np.linalg.norm(scale * turned - target, axis=1)
    return np.degrees(left.magnitude()), apart / pdist(wanted).max()


def thinned(options: BenchGaps, every: int) -> dict[str, Any]:
    """Fit to every so manieth photograph, unless it is done, and score all others.

    Returns:
        number of photographs that were fitted to; PSNR of these by the loss at the
        end; median gap to these (`view_gaps`, degrees) and mean PSNR of the others, dB.
    """
    whole = read_images(options.folder, options.long_edge)
    kept = np.arange(0, len(whole), every)
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
    fitted = np.zeros(len(whole), bool)
    fitted[np.delete(kept, held_out(len(kept)))] = True
    assert whole.points is not None
    cameras = [whole.camera_of(i) for i in range(len(whole))]
    gaps = view_gaps(cameras, whole.camera_to_world, whole.points, fitted)
    renderer, scores = FieldRenderer(load_field(output)), []
    for i in np.flatnonzero(~fitted).tolist():
        shown = renderer.render(cameras[i], whole.camera_to_world[i]).image
        scores.append(float(compare(shown, reference(whole, i))[0]))
    report = files.read_json(output.with_suffix(".report") / "metrics.json")
    return {
        "every": every,
        "fitted": int(fitted.sum()),
        "psnr_fitted_db": report["psnr_fitted_db"],
        "gap_deg": float(np.median(gaps[~fitted])),
        "psnr_db": float(np.mean(scores)),
    }
