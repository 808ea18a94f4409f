"""The film through capture and fit, and how far both are from the truth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import pdist

from bench.commands.quality import run_command
from bench.phone.film import FAMILY, MARKER_M
from bench.phone.walk import phone
from bench.photographs import pose_errors, similarity
from mi_nerfattack.backend.colour import linear_to_srgb_numpy, srgb_to_linear_numpy
from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.fields import load_field
from mi_nerfattack.fit.scores import FieldRenderer, compare, reference
from mi_nerfattack.io import files


def capture(folder: Path, seed: int) -> dict[str, Any]:
    """Place the film's frames by its markers, unless it is done; compare.

    Returns:
        frames chosen and placed, markers and their spread; relative error of the
        scale, medians of rotation and position after a similarity, and how high the
        cameras are above their true places on average, when floors are together.
    """
    posed = folder / "posed"
    if not (posed / "transforms.json").is_file():
        words = ["capture", str(folder / "film.mp4"), "-o", str(posed)]
        words += ["--marker-m", str(MARKER_M), "--marker-family", FAMILY]
        run_command([*words, "--markers-flat", "--seed", str(seed)])
    found, given = placed_and_true(folder)
    table = files.read_json(posed / "capture.json")
    poses = found.camera_to_world
    turns, shares = pose_errors(poses, given)
    extent = pdist(given[:, :3, 3]).max()
    return {
        "frames": len(files.read_json(folder / "truth.json")["camera_to_world"]),
        "chosen": table["photographs"],
        "placed": table["placed"],
        "markers": len(table["scale"]["markers"]),
        "marker_spread": table["scale"]["spread"],
        "scale_error": 1 / similarity(poses, given)[0] - 1,
        "rotation_deg": float(np.median(turns)),
        "position_m": float(np.median(shares) * extent),
        "position_most_m": float(shares.max() * extent),
        "height_m": float((poses[:, 2, 3] - given[:, 2, 3]).mean()),
        "focal_error": found.camera.fx / phone().fx - 1,
    }


def placed_and_true(folder: Path) -> tuple[PosedImages, np.ndarray]:
    """Return the frames that were placed, and their true poses (n, 4, 4)."""
    found = read_images(folder / "posed")
    truth = np.array(files.read_json(folder / "truth.json")["camera_to_world"])
    numbers = [re.findall(r"\d+", Path(name).name)[0] for name in found.names]
    return found, truth[np.array(numbers, int)]


def fit(folder: Path, steps: int) -> dict[str, Any]:
    """Fit a field to the placed frames, unless it is done; score it on those held out.

    Returns:
        PSNR of the held-out views, dB: mean by the exposure of the field, and mean and
        least by the exposure of each frame, channel by channel.
    """
    output = folder / f"field-{steps}.safetensors"
    if not output.is_file():
        words = ["fit", str(folder / "posed"), "-o", str(output), "--network", "small"]
        words += ["--steps", str(steps), "--exposure", "--no-sky"]
        run_command(words)
    scores = files.read_json(output.with_suffix(".report") / "metrics.json")
    images, renderer = read_images(folder / "posed"), FieldRenderer(load_field(output))
    exposed = []
    for index in held_out(len(images)).tolist():
        camera, pose = images.camera_of(index), images.camera_to_world[index]
        wanted = reference(images, index)
        shown = exposed_as(renderer.render(camera, pose).image, wanted)
        exposed.append(compare(shown, wanted)[0])
    return {
        "steps": steps,
        "held_out": len(exposed),
        "psnr_db": scores["psnr_heldout_db"],
        "psnr_exposed_db": float(np.mean(exposed)),
        "psnr_exposed_least_db": float(np.min(exposed)),
    }


def exposed_as(image: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 3), sRGB, with the channels' exposure of another."""
    a, b = srgb_to_linear_numpy(image), srgb_to_linear_numpy(wanted)
    gain = (a * b).sum((0, 1)) / np.maximum((a * a).sum((0, 1)), 1e-9)
    return linear_to_srgb_numpy(np.clip(gain * a, 0, 1))
