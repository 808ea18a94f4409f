"""Draw the drives of a finished run: with the original colours and with the attack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from images import write_jpeg
from PIL import Image, ImageDraw, ImageFont

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.mesh import MeshPart, TexturedMesh, mitsuba_shapes
from mi_nerfattack.capture.mesh.surface import has_area
from mi_nerfattack.capture.object_views import Placement
from mi_nerfattack.deploy.built_in import built_in_shapes, make_built_in
from mi_nerfattack.deploy.views.above import surrogate_above
from mi_nerfattack.experiment.view.frames import FrameSource
from mi_nerfattack.experiment.view.run import ViewedRun, read_viewed
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.outside import Overhead
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.rollout.drive import ATTACK, OWN, Drive

CAR = Path(__file__).resolve().parents[2] / "scenes/car/car.glb"
CAR_M = 4.2, 1.8  # length and width
AXLE_M = 1.25  # from a vehicle's state, the middle of its rear axle, to its middle
TITLES = {
    OWN: "original colours: the car turns right",
    ATTACK: "repainted: the car misses the turn",
}
COLOURS = {OWN: (0, 114, 178), ATTACK: (213, 94, 0)}
EYE_M, TARGET_M, FOV_DEG = (-2.5, -28.0, 13.5), (-1.5, -8.5, 0.0), 47.0


def draw_banner(run: Path, folder: Path, small: bool) -> None:
    """Path-trace both drives from outside: the object, and the car at several times."""
    viewed = read_viewed(run)
    size = (300, 180) if small else (596, 360)
    panels = []
    for case in TITLES:
        scene = scene_of_drive(viewed, drive_of(viewed, "mitsuba", case))
        renderer = ViewRenderer(scene, from_fov(*size, FOV_DEG))
        rgb = renderer.render(look_at(EYE_M, TARGET_M), 8 if small else 256, 0).rgb
        panels.append(titled(Image.fromarray(linear_to_uint8(rgb)), TITLES[case]))
    write_jpeg(folder / "banner.jpg", beside(panels), 1200)


def draw_drive(run: Path, folder: Path, small: bool) -> None:
    """Animate both drives: what the policy sees, and the car from above."""
    viewed = read_viewed(run)
    drives = [drive_of(viewed, "surrogate", case) for case in TITLES]
    points = np.concatenate([drive.states[:, :2] for drive in drives])
    overhead = Overhead.covering(points, 3.0, 120 if small else 400)
    grounds = []
    for case in TITLES:
        viewed.show(case, {})
        ground = surrogate_above(viewed.world.surrogate, overhead)
        grounds.append(Image.fromarray(ground))
    source, frames = FrameSource(viewed), []
    for step in range(0, len(drives[0].controls) + 1, 5 if small else 2):
        columns = []
        for drive, ground in zip(drives, grounds, strict=True):
            picture = Image.fromarray(source.see(drive, step))
            height = round(picture.height * ground.width / picture.width)
            picture = titled(picture.resize((ground.width, height)), TITLES[drive.case])
            columns.append(below([picture, driven(ground, overhead, drive, step)]))
        frames.append(beside(columns))
    source.close()
    first, *others = frames
    path = folder / "drive.webp"
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=200,
        loop=0,
        quality=50,
        method=6,
    )
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)


def drive_of(viewed: ViewedRun, environment: str, case: str) -> Drive:
    """Return the first drive of a case in an environment."""
    return viewed.drive(f"{environment}: {case}")


def scene_of_drive(viewed: ViewedRun, drive: Drive) -> object:
    """Load the deployment scene with the objects, the path and several cars.

    The objects have the colours of the drive's case, and the light of the scene.
    """
    viewed.show(drive.case, {})
    items = [make_built_in(i.field, i.placed) for i in viewed.world.surrogate.objects]
    shapes = built_in_shapes(items)
    car = solid_car()
    for k, (x, y, theta) in enumerate(drive.poses[10::12]):
        moved = car.transformed(1.0, np.array([AXLE_M, 0, 0]))
        moved = moved.turned(float(np.degrees(theta)))
        moved = moved.transformed(1.0, np.array([x, y, 0]))
        for name, shape in mitsuba_shapes(moved).items():
            shapes[f"car_{k}_{name}"] = shape
    path = mitsuba_shapes(TexturedMesh("path", (path_strip(drive),)))
    shapes["path"] = path["part_000"]
    file = viewed.world.scenario.scene.deployment.file
    return load_scene(file, shapes=shapes)


def solid_car() -> TexturedMesh:
    """Read the car without its triangles of no area, whose normals are not finite."""
    car = Placement(longest_m=CAR_M[0]).mesh(CAR)
    submeshes = (
        replace(submesh, faces=submesh.faces[has_area(submesh.vertices[submesh.faces])])
        for submesh in car.submeshes
    )
    return replace(car, submeshes=tuple(submeshes))


def path_strip(drive: Drive, width_m: float = 0.25, z_m: float = 0.03) -> MeshPart:
    """Make a flat strip along the drive, in the colour of its case."""
    states = drive.poses
    side = 0.5 * width_m * np.stack([-np.sin(states[:, 2]), np.cos(states[:, 2])], 1)
    edges = np.concatenate([states[:, :2] - side, states[:, :2] + side])
    k, n = np.arange(len(states) - 1), len(states)
    faces = np.concatenate(
        [np.stack([k, k + 1, n + k], 1), np.stack([k + 1, n + k + 1, n + k], 1)]
    )
    red, green, blue = srgb_to_linear_numpy(np.array(COLOURS[drive.case]) / 255)
    vertices = np.column_stack([edges, np.full(len(edges), z_m)])
    return MeshPart(vertices, faces, (float(red), float(green), float(blue)))


def driven(
    ground: Image.Image, overhead: Overhead, drive: Drive, step: int
) -> Image.Image:
    """Draw the path until a step, and the car there, on a picture from above."""
    picture = ground.copy()
    draw = ImageDraw.Draw(picture)
    path = overhead.to_px(drive.states[: step + 1, :2])
    colour = COLOURS[drive.case]
    draw.line([tuple(point) for point in path], colour, 3)
    x, y, theta = drive.poses[step]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(CAR_M) / 2
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    outline = overhead.to_px((corners + [AXLE_M, 0]) @ turn.T + [x, y])
    draw.polygon([tuple(point) for point in outline], colour, "white", 2)
    return picture


def titled(image: Image.Image, title: str) -> Image.Image:
    """Write a title on a dark bar at the top of an image."""
    size = max(8, image.width // 28)
    draw = ImageDraw.Draw(image, "RGBA")
    draw.rectangle((0, 0, image.width, 1.6 * size), (0, 0, 0, 150))
    draw.text((size / 2, 0.2 * size), title, "white", ImageFont.load_default(size))
    return image


def beside(images: Sequence[Image.Image], gap_px: int = 8) -> Image.Image:
    """Lay images of one height side by side on white."""
    width = sum(image.width + gap_px for image in images) - gap_px
    canvas, x = Image.new("RGB", (width, images[0].height), "white"), 0
    for image in images:
        canvas.paste(image, (x, 0))
        x += image.width + gap_px
    return canvas


def below(images: Sequence[Image.Image]) -> Image.Image:
    """Lay images of one width below each other."""
    height, y = sum(image.height for image in images), 0
    canvas = Image.new("RGB", (images[0].width, height))
    for image in images:
        canvas.paste(image, (0, y))
        y += image.height
    return canvas
