"""What a notebook shows of objects: one short line, and a small picture."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import toy_loop as toy
from helpers.attack_jobs import write_scenario
from helpers.made_drives import make_drive
from helpers.made_runs import make_run
from helpers.rollouts import make_rollout
from PIL import Image

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


@pytest.fixture
def world(tmp_path):
    folder = write_scenario(tmp_path, {})
    scenario, _ = nf.load_scenario(folder / "scenario.toml")
    return nf.build_world(scenario, nf.TorchPolicy(toy.SmoothPolicy()))


def image_of(data: bytes) -> np.ndarray:
    """Decode a PNG file that shows something."""
    assert data.startswith(b"\x89PNG")
    image = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    assert image.std() > 3
    return image


def assert_short(thing, *words):
    line = repr(thing)
    assert len(line) <= MOST and "\n" not in line
    assert " at 0x" not in line and "array(" not in line
    assert line.startswith(type(thing).__name__)
    for word in words:
        assert word in line


def test_reprs_of_a_loop_are_short(driven):
    loop, rollout, evaluation = driven
    observation = loop.sensor.observe(evaluation.trajectory.states[0], 0)
    assert_short(loop, "SceneSensor", "Dubins", "0.1 s")
    assert_short(rollout, "3 periods", "detached")
    assert_short(evaluation, f"{evaluation.value:.6g}", "2 drives")
    assert_short(evaluation.trajectory, "2 drives, 3 periods of 0.1 s")
    assert_short(loop.sensor, "24x10", "fields.object.colour")
    assert_short(loop.sensor.fields[0], "2 x 2 x 2 m")
    assert_short(loop.policy, "SmoothPolicy", "IntegerGoal(count=3)")
    assert_short(observation, "2 images 24x10")


def test_reprs_of_a_scenario_and_its_results_are_short(world, tmp_path):
    drives = {("mitsuba", "left", "own"): [make_drive([0.1, 0.2], case="own")]}
    assert_short(world, "objects: 1", "surrogate", f"{world.horizon} periods")
    assert_short(world.scenario, world.route.name, "gradient attack")
    assert_short(BEND, "3 points", "70.0 m", "lane 3.5 m")
    assert_short(replace(BEND, closed=True), "closed")
    assert_short(make_drive([0.1, -0.3]), "run 0", "0.200 m in the mean")
    assert_short(FRAME, "30x20", "R G B A Z and 2 more")
    assert_short(Evaluation({}, drives, {}), "1 drives", "mitsuba", "left")
    make_run(tmp_path / "run")
    assert_short(nf.Run.read(tmp_path / "run"))


def test_a_route_shows_its_lane():
    image = image_of(BEND._repr_png_())
    grey = np.all(image == 0xEC, axis=2)  # the lane, as wide as the map's scale says
    assert 0.005 < grey.mean() < 0.2


def test_a_drive_shows_its_path_and_its_error(driven):
    _, _, evaluation = driven
    alone = image_of(make_drive([0.1, -0.3, 0.2])._repr_png_())
    assert alone.shape == image_of(evaluation._repr_png_()).shape
    assert evaluation._repr_png_() == evaluation.trajectory._repr_png_()


def test_a_field_is_shown_from_four_sides():
    image = image_of(toy.blob(toy.GridLayout(2, 6, 9), 1.0, 2.5, 0.1, 2)._repr_png_())
    views = np.split(image, 4, axis=1)
    assert all(view.std() > 3 for view in views)
    assert not np.array_equal(views[0], views[2])


def test_a_frame_shows_its_colour():
    image = image_of(FRAME._repr_png_() or b"")
    assert image.shape == (20, 30, 3) and (image[..., 2] > image[..., 1]).all()
    assert Frame({"Z": GREY}, {"scene": "a.xml"})._repr_png_() is None


def test_a_run_shows_verdict_table_and_map(tmp_path):
    document = make_run(tmp_path / "run")
    image = Image.new("RGB", (8, 4), "red")
    image.save(tmp_path / "run" / "overhead.png")
    shown = nf.Run.read(tmp_path / "run")._repr_html_()
    assert document["verdict"][0] in shown
    assert "straight" in shown and "attack" in shown
    assert re.search(r'src="data:image/png;base64,iVBOR[\w+/=]+"', shown)
    (tmp_path / "run" / "overhead.png").unlink()
    assert "<img" not in nf.Run.read(tmp_path / "run")._repr_html_()


def test_other_objects_have_no_picture():
    with pytest.raises(TypeError, match="int: has no picture"):
        draw(1)
