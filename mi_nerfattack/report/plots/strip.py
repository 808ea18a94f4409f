"""Frames in one picture: a strip of what the policy sees, tiles, objects all around."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import drjit as dr
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields.base import AbstractField
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, look_at
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.vehicle.route.route import Route

ELEVATION_DEG = 15.0
DISTANCE = 4.0  # of the eye from the object's centre, in radii of its box
PAPER = np.array([1.0, 1.0, 1.0])


class Around:
    """Eyes around a box, whose frames it just fits in.

    Args:
        lower: (3,), corner of the box in the object's frame, metres.
        upper: (3,), opposite corner of the box in the object's frame, metres.
        azimuths_deg: of the eyes, about z from +x.
        edge_px: longer edge of the frames.
    """

    def __init__(
        self,
        lower: np.ndarray,
        upper: np.ndarray,
        azimuths_deg: Sequence[float],
        edge_px: int,
    ) -> None:
        self._poses = [_pose(lower, upper, azimuth) for azimuth in azimuths_deg]
        self._camera = _camera(lower, upper, self._poses, edge_px=edge_px)

    def views(self, field: AbstractField) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield premultiplied radiance (height, width, 3) and opacity by eye."""
        posed, camera = PosedField(field), self._camera
        height, width = camera.height, camera.width
        for pose in self._poses:
            origin, direction = generate_rays(camera, *pose_arrays(pose), 1)
            marched = march(posed, Rays(origin, direction))
            dr.eval(marched.radiance, marched.opacity)
            radiance = marched.radiance.numpy().T.reshape(height, width, 3)
            yield radiance.copy(), marched.opacity.numpy().reshape(height, width).copy()


def turntable(grid: GridField, count: int, edge_px: int) -> list[np.ndarray]:
    """Render an object from all around.

    Args:
        grid: with the texture that is to be seen.
        count: of the eyes, equally spaced from +x on.
        edge_px: longer edge of the views.

    Returns:
        sRGB images over white, (height, width, 3), uint8.
    """
    azimuths = np.linspace(0, 360, count, endpoint=False)
    around = Around(grid.lower, grid.upper, azimuths.tolist(), edge_px=edge_px)
    views = [over_paper(*look) for look in around.views(grid)]
    return [(255 * view).round().astype(np.uint8) for view in views]


def over_paper(radiance: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Lay a view over white: sRGB in [0, 1]."""
    over = radiance + (1 - opacity[..., None]) * PAPER
    return linear_to_srgb_numpy(over).clip(0, 1)


def _pose(lower: np.ndarray, upper: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Place an eye, camera_to_world (4, 4)."""
    centre = 0.5 * (lower + upper)
    distance = DISTANCE * 0.5 * float(np.linalg.norm(upper - lower))
    azimuth, elevation = np.radians(azimuth_deg), np.radians(ELEVATION_DEG)
    level = np.cos(elevation)
    outwards = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
    return look_at(centre + distance * np.array(outwards), centre)


def _camera(
    lower: np.ndarray, upper: np.ndarray, poses: Sequence[np.ndarray], edge_px: int
) -> Camera:
    """Make the camera whose frame the box just fits in from all poses."""
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), -1)
    corners = corners.reshape(-1, 3)
    slopes = []
    for pose in poses:
        local = (corners - pose[:3, 3]) @ pose[:3, :3]
        slopes.append(np.abs(local[:, :2] / local[:, 2:]).max(axis=0))
    reach = np.max(slopes, axis=0)
    focal = 0.5 * edge_px / reach.max()
    width, height = (max(1, int(size)) for size in np.ceil(2 * focal * reach))
    return Camera(width, height, focal, fy=focal, cx=width / 2, cy=height / 2)


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
    route: Route, drives: Sequence[Drive], count: int, start_m: float = 0.0
) -> tuple[np.ndarray, list[list[int]]]:
    """Choose the steps at which drives pass the same places on their route.

    Args:
        route: of all drives.
        drives: at least one.
        count: of places, equally spaced from the first start to the farthest end.
        start_m: arc length near which all drives start.

    Returns:
        the places, arc lengths (count,) in metres; and of each drive the step nearest
        to each place, in order, without the places that it ends before.
    """
    arcs = [route.project_numpy(drive.states[:-1]).arc_length for drive in drives]
    if route.closed:
        lap, arcs = route.length, [np.unwrap(arc, period=route.length) for arc in arcs]
        # A start just before the beginning of the route is not a lap further
        arcs = [arc - lap * np.round((arc[0] - start_m) / lap) for arc in arcs]
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
