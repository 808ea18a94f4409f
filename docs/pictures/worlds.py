"""Draw environments, cameras, the room and a net, as a policy or printer sees them."""

from __future__ import annotations

import io
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from images import write_jpeg
from PIL import Image
from run_pictures import below, beside, titled

from mi_nerfattack.fields.random_textures import random_texture
from mi_nerfattack.props.attacked import AttackedBox, box_pictures
from mi_nerfattack.props.net import Net
from mi_nerfattack.props.overlay import Overlay
from mi_nerfattack.props.paper import lay_out, pages
from mi_nerfattack.report.plots.charts import RC
from mi_nerfattack.scenario.scenario import load_scenario
from mi_nerfattack.scenario.world import World, build_world
from mi_nerfattack.scenes import bundled

ARC_M = 17.0  # of the car along the route
TURN = """
name = "a hydrant at a right turn"
[scene]
field = "bundled:intersection/field.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "bundled:intersection/routes.json"
route = "right"
spp = {spp}
[[objects]]
id = "hydrant"
field = "bundled:hydrant/field.safetensors"
position_m = [4.4, -10.5, 0.12]
scale = 3.3
[policy]
file = "bundled:policy/pilotnet.safetensors"
inputs = ["front", "goal"]
"""
CAMERA = '[[cameras]]\nname = "{}"\nyaw_deg = {}\nwidth = {}\nheight = {}\n'
ENVIRONMENTS = """
[[deployment]]
name = "mitsuba"
spp = {spp}
[[deployment]]
name = "mitsuba_built_in"
objects = "built-in"
spp = {spp}
[[deployment]]
kind = "mujoco_gl"
name = "mujoco_gl_built_in"
objects = "built-in"
"""


def draw_worlds(folder: Path, small: bool) -> None:
    """Render one moment in four environments, three cameras, the room, overlay and net.

    Args:
        folder: where `environments.jpg`, `cameras.jpg`, `room.jpg`,
            `overlay.jpg` and `net.jpg` go.
        small: render few rays of small images.
    """
    width, height, spp = (240, 100, 1) if small else (480, 200, 16)
    text = TURN.format(spp=spp) + CAMERA.format("front", 0, width, height)
    world = _world(text + ENVIRONMENTS.format(spp=8 * spp))
    tiles = [titled(_frame(world, label, ARC_M), label) for label in world.labels]
    rows = [beside(tiles[:2]), beside(tiles[2:])]
    write_jpeg(folder / "environments.jpg", below(rows), 720)

    text = TURN.format(spp=spp)
    for name, yaw_deg in ("left", 55), ("front", 0), ("right", -55):
        text += CAMERA.format(name, yaw_deg, width // 2, height)
    world = _world(text)
    frame = _frame(world, "surrogate", ARC_M)
    views = world.scenario.rig().views
    cut = [frame.crop((c.start, 0, c.stop, height)) for _, c in views.values()]
    named = [titled(*pair) for pair in zip(cut, views, strict=True)]
    write_jpeg(folder / "cameras.jpg", beside(named), 800)

    room = bundled("room.toml").read_text("utf-8")
    world = _world(room.replace("spp = 4", f"spp = {4 * spp}"))
    [cube] = world.fields
    cube.set_parameter("texture", random_texture(cube, "blobs", 4))
    tiles = [
        titled(_frame(world, name, 0.4), name) for name in ("surrogate", "mitsuba")
    ]
    write_jpeg(folder / "room.jpg", beside(tiles), 800)

    lower, upper, faces = box_pictures(cube)
    pose = world.surrogate.objects[0].placed
    box = AttackedBox("cube", "none", 64 * "0", lower, upper, pose, faces)
    write_jpeg(folder / "overlay.jpg", _overlaid(world, box), 800)
    write_jpeg(folder / "net.jpg", _net(box, 30 if small else 60))


def _world(text: str) -> World:
    """Build the world of a scenario."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "scenario.toml"
        path.write_text(text, "utf-8")
        scenario, _ = load_scenario(path)
    return build_world(scenario, scenario.build_policy())


def _frame(world: World, label: str, arc_m: float) -> Image.Image:
    """Return the frame of an environment with the car on the route."""
    environment = world.open(label)
    frame = environment.reset(world.route, world.route.pose_at(arc_m), 0)
    environment.close()
    return Image.fromarray(frame.image)


def _overlaid(world: World, box: AttackedBox) -> Image.Image:
    """Draw a frame with a green target beside the one that `car overlay` writes."""
    environment = world.open("mitsuba", empty=True)
    frame = environment.reset(world.route, world.route.pose_at(0.4), 0)
    environment.close()
    # Faces differ a little in their green, as they do in the light of a room.
    green = {
        face: np.full_like(image, (0, 150 + 8 * number, 60))
        for number, (face, image) in enumerate(box.images.items())
    }
    target = Overlay(replace(box, images=green), environment.camera, keyed=False)
    recorded = target.apply(frame.image, frame.camera_to_world)
    written = Overlay(box, environment.camera).apply(recorded, frame.camera_to_world)
    named = {"recorded, with a green target": recorded, "the box in its place": written}
    return beside([titled(Image.fromarray(i), name) for name, i in named.items()])


def _net(box: AttackedBox, dpi: int) -> Image.Image:
    """Draw the net on the page that `export print` writes."""
    edges_mm = box.edges_mm(40)
    net = Net(edges_mm)
    with matplotlib.rc_context(RC):
        [page] = pages(box, net, lay_out(net, "a4"), edges_mm, dpi)
        buffer = io.BytesIO()
        page.savefig(buffer, dpi=dpi)
    page_image = Image.open(buffer)
    width, height = page_image.size
    return page_image.crop((0, round(0.26 * height), width, round(0.74 * height)))
