"""Photographs made ready for structure from motion: upright, grouped by camera."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image, ImageOps

from mi_nerfattack.capture.colmap.follow import StageCallback
from mi_nerfattack.capture.colmap.process import LEAST_IMAGES
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files

_SHOWN = 3  # names in a message


class HeldCamera(NamedTuple):
    """How a photograph was taken: photographs with equal values share intrinsics.

    Attributes:
        make, model: of the camera, from EXIF data; empty where EXIF data lack them.
        focal_mm, focal_35mm, zoom: focal length from EXIF data, as text; empty where
            EXIF data lack it.
        orientation: how EXIF data turn the stored picture, 1 to 8; 1 is not at all.
        width, height: of the upright picture, pixels.
    """

    make: str
    model: str
    focal_mm: str
    focal_35mm: str
    zoom: str
    orientation: int
    width: int
    height: int

    def __str__(self) -> str:
        fields = [" ".join((self.make, self.model)).strip()]
        fields += [f"{self.focal_mm} mm"] * bool(self.focal_mm)
        fields += [f"zoom {self.zoom}"] * bool(self.zoom)
        fields += [f"{self.width} x {self.height} px"]
        fields += [f"turned by EXIF data ({self.orientation})"] * (
            self.orientation != 1
        )
        return ", ".join(field for field in fields if field)


def list_photographs(root: Path) -> list[str]:
    """Return the names of a folder's photographs, sorted.

    Raises:
        InputError: it is not a folder, or there are fewer than 3.
    """
    with files.reported(root):
        inside = list(root.iterdir()) if root.is_dir() else None
    if inside is None:
        raise InputError(f"{root}: is not a folder; give the folder of the photographs")
    names = sorted(p.name for p in inside if p.suffix.lower() in files.IMAGE_SUFFIXES)
    if len(names) < LEAST_IMAGES:
        raise InputError(
            f"{root}: {len(names)} photographs "
            f"({', '.join(files.IMAGE_SUFFIXES)}); at least "
            f"{LEAST_IMAGES} are needed, 20 or more are better"
        )
    return names


def stage(
    root: Path, names: Sequence[str], target: Path, progress: StageCallback
) -> dict[HeldCamera, list[str]]:
    """Copy photographs upright.

    Args:
        root: folder of the photographs.
        names: in it.
        target: folder of the copies, which keep their names; HEIC becomes JPEG.
        progress: called with stage, done and total.

    Returns:
        the copies' names by the camera, its focal length and the way it was held.

    Raises:
        InputError: one cannot be read, or a camera held one way took fewer than 3.
    """
    groups: dict[HeldCamera, list[str]] = {}
    for done, name in enumerate(names):
        progress("photographs", done, len(names))
        copy = copied(name)
        if copy != name and copy in names:
            raise InputError(f"{root / copy}: a copy of {name}; remove it")
        held = copy_upright(root / name, target / copy)
        groups.setdefault(held, []).append(copy)
    progress("photographs", len(names), len(names))
    check_groups(root, groups)
    return groups


def copied(name: str) -> str:
    """Return the name of a photograph's copy, which COLMAP reads."""
    return name + ".jpg" * (Path(name).suffix.lower() in files.HEIC_SUFFIXES)


def check_groups(root: Path, groups: Mapping[HeldCamera, Sequence[str]]) -> None:
    """Raise InputError, naming them, if photographs of a camera are too few."""
    for held, names in groups.items():
        if len(names) < LEAST_IMAGES:
            others = f"; there are {len(groups)} such groups" * (len(groups) > 1)
            raise InputError(
                f"{root}: only {_some(names)} of {held}; a camera, at one focal length "
                f"and held one way, is calibrated from at least {LEAST_IMAGES} "
                f"photographs: leave out those, or take more{others}"
            )


def _some(names: Sequence[str]) -> str:
    suffix = f" and {len(names) - _SHOWN} more" * (len(names) > _SHOWN)
    return ", ".join(names[:_SHOWN]) + suffix


def check_in_place(root: Path, names: Sequence[str], staged: Path, out: Path) -> None:
    """Refuse to write turned copies over the photographs themselves."""
    if not (out.is_dir() and out.samefile(root)):
        return
    for name in names:
        if not (staged / name).exists():  # HEIC, whose copy has another name
            continue
        limit = files.MAX_IMAGE_BYTES
        if files.read_bytes(root / name, limit) != files.read_bytes(
            staged / name, limit
        ):
            raise InputError(
                f"{root / name}: its EXIF data turn it, and the upright copy would "
                "replace it; choose another output folder"
            )


def copy_upright(source: Path, target: Path) -> HeldCamera:
    """Copy an image, turned if EXIF data say so; return the camera that took it."""
    height, width = files.read_image(source).shape[:2]
    raw = files.read_bytes(source, files.MAX_IMAGE_BYTES)
    with Image.open(io.BytesIO(raw), formats=files.image_formats(source, raw)) as image:
        kind, exif = image.format, image.getexif()
        turned = ImageOps.exif_transpose(image)
        held = _held(exif, *turned.size)
        upright = turned.size == (width, height) and held.orientation == 1
        if kind == "HEIF":
            kind = "JPEG"
        elif upright:
            files.write_bytes(target, raw)
            return held
    buffer = io.BytesIO()
    turned.save(buffer, kind, quality=95, exif=turned.getexif())
    files.write_bytes(target, buffer.getvalue())
    return held


def _held(exif: Image.Exif, width: int, height: int) -> HeldCamera:
    taken = exif.get_ifd(ExifTags.IFD.Exif)

    def text(table: Mapping[int, Any], tag: ExifTags.Base) -> str:
        return str(table.get(tag, "")).strip().strip("\0").strip()

    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return HeldCamera(
        make=text(exif, ExifTags.Base.Make),
        model=text(exif, ExifTags.Base.Model),
        focal_mm=text(taken, ExifTags.Base.FocalLength),
        focal_35mm=text(taken, ExifTags.Base.FocalLengthIn35mmFilm),
        zoom=text(taken, ExifTags.Base.DigitalZoomRatio),
        orientation=orientation if orientation in range(1, 9) else 1,
        width=width,
        height=height,
    )
