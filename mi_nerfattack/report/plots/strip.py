"""First-person frames in one picture: a strip by places, tiles of one time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.vehicle.route.route import Route

SCALE = 2
GAP_PX = 6
FONT_PX = 24
TILE_PX = 400  # to which small images of tiles are enlarged, where a factor fits

_BACKGROUND, _INK, _ABSENT = (255, 255, 255), (20, 20, 20), (225, 225, 225)


def first_person_strip(
    path: str | Path,
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str],
) -> None:
    """Write a labelled grid of frames as an image.

    Pixels are doubled, not interpolated, so that the picture shows what the policy
    saw. A row shorter than the titles (the drive ended) is filled with plain grey.

    Args:
        path: PNG or JPEG file.
        rows: frames of each row by label, sRGB, uint8, (H, W, 3), those of a row of
            one size; a line break in a label starts another line.
        titles: of the columns.
    """
    sizes = [frames[0].shape[:2] for frames in rows.values()]
    width = max(width for _, width in sizes)
    font = _font()
    label_px = 2 * GAP_PX + max(_text_width(font, label) for label in rows)
    header_px = FONT_PX + 2 * GAP_PX
    column_px, row_px = SCALE * width + GAP_PX, [SCALE * h + GAP_PX for h, _ in sizes]
    size = (label_px + column_px * len(titles), header_px + sum(row_px))
    sheet = Image.new("RGB", size, _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for column, text in enumerate(titles):
        centre = label_px + column * column_px + SCALE * width // 2
        draw.text((centre, header_px // 2), text, _INK, font, anchor="mm")
    top = header_px
    for (label, frames), height in zip(rows.items(), row_px, strict=True):
        middle = (GAP_PX, top + height // 2)
        draw.text(middle, label, _INK, font, anchor="lm", spacing=GAP_PX)
        for column in range(len(titles)):
            left = label_px + column * column_px
            if column < len(frames):
                sheet.paste(_enlarged(frames[column]), (left, top))
            else:
                corner = (left + SCALE * width - 1, top + height - GAP_PX - 1)
                draw.rectangle(((left, top), corner), fill=_ABSENT)
        top += height
    files.write_image(path, np.asarray(sheet))


def aligned_steps(
    route: Route, drives: Sequence[Drive], count: int
) -> tuple[np.ndarray, list[list[int]]]:
    """Choose the steps at which drives pass the same places on their route.

    Args:
        route: of all drives.
        drives: at least one.
        count: of places, equally spaced from the first start to the farthest end.

    Returns:
        the places, arc lengths (count,) in metres; and of each drive the step nearest
        to each place, in order, without the places that it ends before.
    """
    arcs = [route.project_numpy(drive.states[:-1]).arc_length for drive in drives]
    if route.closed:
        arcs = [np.unwrap(arc, period=route.length) for arc in arcs]
    low, high = min(arc[0] for arc in arcs), max(arc.max() for arc in arcs)
    places, steps = np.linspace(low, high, count), []
    for arc in arcs:
        last = arc.max() + np.abs(np.diff(arc, append=arc[-1])).max() + 1e-6
        reached = places[places <= last]
        nearest = np.abs(arc - reached[:, None]).argmin(1)
        steps.append(np.maximum.accumulate(nearest).tolist())
    return places, steps


def tiles(images: Mapping[str, np.ndarray], columns: int = 2) -> np.ndarray:
    """Lay images out row by row, each under its title.

    Small ones are enlarged by a whole factor, not interpolated.

    Args:
        images: by title, sRGB, uint8, (H, W, 3), of one size.
        columns: how many.

    Returns:
        the picture, (height, width, 3), uint8; its size depends on that of the images
        and their number alone.
    """
    height, width = next(iter(images.values())).shape[:2]
    scale = max(1, TILE_PX // width)
    font_px = max(10, scale * width // 22)
    font, header_px = _font(font_px), font_px + 2 * GAP_PX
    column_px, row_px = scale * width + GAP_PX, header_px + scale * height
    rows = -(-len(images) // columns)
    size = (GAP_PX + columns * column_px, rows * row_px + GAP_PX)
    sheet = Image.new("RGB", size, _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for index, (title, image) in enumerate(images.items()):
        row, column = divmod(index, columns)
        left, top = GAP_PX + column * column_px, row * row_px
        middle = (left, top + header_px // 2)
        draw.text(middle, title, _INK, font, anchor="lm")
        sheet.paste(_enlarged(image, scale), (left, top + header_px))
    return np.asarray(sheet)


def _enlarged(frame: np.ndarray, scale: int = SCALE) -> Image.Image:
    return Image.fromarray(frame.repeat(scale, axis=0).repeat(scale, axis=1))


def _font(size_px: int = FONT_PX) -> ImageFont.FreeTypeFont:
    fonts = Path(matplotlib.get_data_path(), "fonts", "ttf")
    return ImageFont.truetype(fonts / "DejaVuSans.ttf", size_px)


def _text_width(font: ImageFont.FreeTypeFont, label: str) -> int:
    return max(int(np.ceil(font.getlength(line))) for line in label.split("\n"))
