"""Fields of ever fewer photographs, scored on all that they were not fitted to."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from bench.commands.quality import run_command
from mi_nerfattack.capture.coverage import view_gaps
from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.capture.transforms import read_images
from mi_nerfattack.fields import load_field
from mi_nerfattack.fit.scores import FieldRenderer, compare, reference
from mi_nerfattack.io import files

TRANSFORMS = "transforms.json"


def thinned(
    folder: Path, work: Path, every: int, steps: int, long_edge: int
) -> dict[str, Any]:
    """Fit to every so manieth photograph, and score all others.

    Args:
        folder: what `capture` wrote of photographs.
        work: gets `every-N`, folder and field; what is there is not done again.
        every: keep the first of so many.
        steps: of the fit.
        long_edge: of the photographs, pixels.

    Returns:
        number of photographs that were fitted to; PSNR of these by the loss at the
        end; names, gaps to these (`view_gaps`, degrees) and PSNR of the others, dB.
    """
    whole = read_images(folder, long_edge)
    kept = np.arange(0, len(whole), every)
    output = work / f"every-{every}-{steps}.safetensors"
    if not output.is_file():
        own = files.make_folder(work / f"every-{every}")
        _write(folder, own, every)
        words = ["fit", str(own), "-o", str(output), "--network", "small"]
        run_command([*words, "--steps", str(steps), "--long-edge", str(long_edge)])
    fitted = np.zeros(len(whole), bool)
    fitted[np.delete(kept, held_out(len(kept)))] = True
    assert whole.points is not None
    cameras = [whole.camera_of(i) for i in range(len(whole))]
    gaps = view_gaps(cameras, whole.camera_to_world, whole.points, fitted)
    others = np.flatnonzero(~fitted)
    renderer = FieldRenderer(load_field(output))
    scores = [_score(renderer, whole, int(i)) for i in others]
    report = files.read_json(output.with_suffix(".report") / "metrics.json")
    return {
        "every": every,
        "fitted": int(fitted.sum()),
        "psnr_fitted_db": report["psnr_fitted_db"],
        "gap_deg": float(np.median(gaps[others])),
        "psnr_db": float(np.mean(scores)),
        "views": [
            {"name": whole.names[i], "gap_deg": gaps[i], "psnr_db": score}
            for i, score in zip(others.tolist(), scores, strict=True)
        ],
    }


def _write(folder: Path, own: Path, every: int) -> None:
    """Write a `transforms.json` of every so manieth frame of what `capture` wrote."""
    table = files.read_json(folder / TRANSFORMS)
    table["points_file"] = os.path.relpath(folder / table["points_file"], own)
    table["frames"] = table["frames"][::every]
    for frame in table["frames"]:
        for name in frame.keys() & {"file_path", "mask_path"}:
            frame[name] = os.path.relpath(folder / frame[name], own)
    files.write_json(own / TRANSFORMS, table)


def _score(renderer: FieldRenderer, images: PosedImages, index: int) -> float:
    camera, pose = images.camera_of(index), images.camera_to_world[index]
    shown = renderer.render(camera, pose).image
    return float(compare(shown, reference(images, index))[0])
