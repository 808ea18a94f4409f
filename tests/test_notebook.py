"""What a notebook shows of objects: one short line, and a small picture."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.files.runs import make_drive, make_run
from support.worlds import loops as toy
from support.worlds.attacks import write_scenario
from support.worlds.loops import make_rollout

import mi_nerfattack as nf
from mi_nerfattack.evaluation.work import Evaluation
from mi_nerfattack.render.pathtrace.frames import Frame
from mi_nerfattack.report.small import draw

pytestmark = pytest.mark.usefixtures("variant")
MOST = 200  # characters of a line

GREY = np.full((20, 30), 0.5, np.float32)
NAMES = ["R", "G", "B", "A", "Z", "ball.R", "ball.G"]
FRAME = Frame({name: GREY * k for k, name in enumerate(NAMES)}, {"scene": "a.xml"})
BEND = replace(toy.ROUTE, points=np.array([[0.0, 0], [40, 0], [40, 30]]))


@pytest.fixture
def driven():
    """Return a loop, its rollout and two drives of three periods."""
    loop, _ = toy.make_loop(coarse=True)
    rollout = make_rollout(loop, 3)
    return loop, rollout, rollout.run(loop.initial(np.zeros((2, 3))))


def image_of(data: bytes) -> np.ndarray:
    """Decode a PNG file that shows something."""
    assert data.startswith(b"\x89PNG")
    image = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    assert image.std() > 3
    return image


def check_short(thing: object, *words: str) -> None:
    line = repr(thing)
    assert len(line) <= MOST and "\n" not in line
    assert " at 0x" not in line and "array(" not in line
    assert line.startswith(type(thing).__name__)
    assert not [word for word in words if word not in line]


def test_reprs_are_short(driven, tmp_path):
    loop, rollout, evaluation = driven
    check_short(loop, "0.1 s")
    check_short(rollout, "3 periods", "detached")
    check_short(evaluation, f"{evaluation.value:.6g}", "2 drives")
    check_short(evaluation.trajectory, "2 drives, 3 periods of 0.1 s")
    check_short(loop.sensor, "24x10")
    check_short(loop.sensor.fields[0], "2 x 2 x 2 m")
    check_short(loop.policy)
    check_short(loop.sensor.observe(evaluation.trajectory.states[0], 0), "2 images")
    scenario, _ = nf.load_scenario(write_scenario(tmp_path, {}) / "scenario.toml")
    world = nf.build_world(scenario, nf.TorchPolicy(toy.SmoothPolicy()))
    check_short(world, "objects: 1", f"{world.horizon} periods")
    check_short(scenario, world.route.name)
    check_short(BEND, "3 points", "70.0 m", "lane 3.5 m")
    check_short(replace(BEND, closed=True), "closed")
    drive = make_drive([0.1, -0.3])
    check_short(drive, "0.200 m")
    check_short(FRAME, "30x20", "R G B A Z")
    check_short(Evaluation({}, {("mitsuba", "left", "own"): [drive]}, {}), "1 drives")
    make_run(tmp_path / "run")
    check_short(nf.Run(tmp_path / "run"))


def test_objects_show_pictures(driven):
    _, _, evaluation = driven
    field = toy.blob(toy.GridLayout(2, 6, 9), 1.0, 2.5, 0.1, 2)
    image_of(BEND._repr_png_())
    alone = image_of(make_drive([0.1, -0.3, 0.2])._repr_png_())
    assert alone.shape == image_of(evaluation._repr_png_()).shape
    assert evaluation._repr_png_() == evaluation.trajectory._repr_png_()
    views = np.split(image_of(field._repr_png_()), 4, axis=1)  # from four sides
    assert not np.array_equal(views[0], views[2])
    image = image_of(FRAME._repr_png_() or b"")
    assert image.shape == (20, 30, 3) and (image[..., 2] > image[..., 1]).all()
    assert Frame({"Z": GREY}, {"scene": "a.xml"})._repr_png_() is None
    with pytest.raises(TypeError, match="int: has no picture"):
        draw(1)


def test_a_run_shows_verdict_table_and_map(tmp_path):
    document = make_run(tmp_path / "run")
    picture = tmp_path / "run" / "overhead.png"
    Image.new("RGB", (8, 4), "red").save(picture)
    shown = nf.Run(tmp_path / "run")._repr_html_()
    assert document["verdict"][0] in shown and "attack" in shown
    assert re.search(r'src="data:image/png;base64,iVBOR[\w+/=]+"', shown)
    frames = tmp_path / "run" / "frames"
    names = {str(path.relative_to(frames)) for path in nf.Run(tmp_path / "run").frames}
    assert len(names) == 3 * 4
    assert {"surrogate_no_object/0000.png", "surrogate_random/0003.png"} <= names
    picture.unlink()
    assert "<img" not in nf.Run(tmp_path / "run")._repr_html_()
