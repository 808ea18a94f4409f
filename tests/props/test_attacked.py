"""Boxes of run folders, and the commands that put them elsewhere."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace
from importlib.metadata import files as installed_files
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.faults.injected import free_port, signalled
from support.worlds import attacks as boxes
from support.worlds.views import write_transforms

from mi_nerfattack import cli
from mi_nerfattack.capture.mesh.cube_faces import flat_share
from mi_nerfattack.capture.mesh.flat import FlatObject
from mi_nerfattack.drives.store import read_drives
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.io.video import open_video, write_video
from mi_nerfattack.props import attacked, openscenario
from mi_nerfattack.props.attacked import FACES, Views, read_box, seen_most
from mi_nerfattack.props.follow import FollowServer
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, look_at
from mi_nerfattack.scenario.section import read_section
from mi_nerfattack.scenario.vehicle import VehicleSection

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    return boxes.attacked_run(tmp_path_factory.mktemp("cube"), boxes.cube_field())


def test_box_of_a_run(run):
    """Pose with the attack's, size with the scale, pictures as the field is seen."""
    box, views = read_box(run, texture_px=24)
    pose = json.loads((run / "metrics.json").read_text())["object_poses"]["ball"]
    np.testing.assert_allclose(box.pose.translation, pose["position_m"], atol=1e-6)
    np.testing.assert_allclose(box.pose.rotation, pose["rotation"], atol=1e-6)
    assert np.abs(box.pose.translation - [7, 4.2, 1.6]).max() > 1e-4
    np.testing.assert_allclose(box.edges_m, 1.5, atol=1e-6)
    assert box.edges_mm(40.0) == pytest.approx([40, 40, 40])
    assert set(box.images) == set(FACES) and len(views.camera_to_world) == 3
    steps = np.linalg.norm(np.diff(views.camera_to_world[:, :3, 3], axis=0), axis=1)
    (attack,) = read_found([run])
    np.testing.assert_allclose(steps, views.period * attack.route.speed_ms, rtol=0.02)
    # colours rise with x, y and z: of the front, red to the right and blue upwards
    front = box.images["front"].astype(int)
    assert front.shape == (24, 24, 3) and front.min() > 5
    assert (front[:, -4, 0] - front[:, 3, 0]).mean() > 30
    assert (front[3, :, 2] - front[-4, :, 2]).mean() > 30


def test_a_billboard_of_a_run_is_its_front(tmp_path):
    run = boxes.attacked_run(tmp_path, FlatObject("billboard", 16.0, 8.0, 2).field())
    box, views = read_box(run, texture_px=24)
    assert box.sheet == "front" == seen_most(box, views)
    assert box.images["front"].shape == (12, 24, 3)
    with pytest.raises(InputError, match="--face: back; ball is flat"):
        box.check_face("back")


def test_the_face_that_is_seen_most():
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    box = boxes.made_box()
    camera, mount = from_fov(64, 32, 90.0), CameraMount()
    for face in FACES:
        corner, across, down = box.plane(face)
        middle = corner + (across + down) / 2
        out = np.cross(down, across)
        eyes = [middle + 4 * turn @ out, middle + 3 * out + 0.3]
        poses = np.stack([look_at(eye, middle) for eye in eyes])
        assert seen_most(box, Views(camera, mount, poses, 0.1)) == face
    away = look_at(np.array([5.0, 0, 0]), np.array([9.0, 0, 0]))[None]
    with pytest.raises(InputError, match=r"1 views .* shows cube; choose with --face"):
        seen_most(box, Views(camera, mount, away, 0.1))


def test_paper_and_screen(run, tmp_path):
    pdf, png, page = (tmp_path / name for name in ("a.pdf", "a.png", "a.html"))

    def export(what: str, output, *options: object) -> None:
        words = ["export", what, run, "-o", output, "--size-mm", 60, *options]
        assert cli.main(list(map(str, words))) == 0

    export("print", pdf, "--dpi", 40)
    assert pdf.read_bytes().startswith(b"%PDF") and b"run" in pdf.read_bytes()
    export("screen", png, "--face", "left", "--pixels", "640x360")
    image = files.read_image(png)
    wide = np.count_nonzero(image[180].any(1)) / 640 * 27 * 25.4 * 16 / 337**0.5
    assert wide == pytest.approx(60, abs=0.9)  # a pixel is 0.93 mm
    export("screen", page, "--face", "left")
    assert "data:image/png;base64," in page.read_text()


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """Recordings that pass the box, as a folder and as a video, and what fits none."""
    pytest.importorskip("cv2")
    folder = tmp_path_factory.mktemp("recorded")
    box, _ = read_box(run, texture_px=24)
    middle = box.pose.translation
    eyes = [middle + [-4, 0.3 * step, 0.5] for step in range(3)]
    poses = np.stack([look_at(eye, middle) for eye in eyes])
    green = np.zeros((3, 32, 48, 3), np.uint8)
    green[:, 4:] = (40, 160, 60)
    write_transforms(folder / "drive", green, from_fov(48, 32, 60.0), poses, {})
    write_video(folder / "drive.mp4", green, 10)
    shutil.copy(folder / "drive" / "transforms.json", folder / "drive.json")
    shutil.copy(folder / "drive.mp4", folder / "bare.mp4")
    shutil.copytree(folder / "drive", folder / "small")
    files.write_image(next((folder / "small/images").iterdir()), green[0, :9])
    lines = "time_s,x_m,y_m,heading_rad\n0,4,3,0\n0.3,4.1,3,0\n"
    (folder / "poses.csv").write_text(lines)
    (folder / "run").symlink_to(run)
    return folder


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("export print run -o a.png", "give a file that ends in .pdf"),
        ("export print run -o no/a.pdf", "does not exist"),
        ("export print . -o a.pdf", "holds no finished attack"),
        ("export print run -o a.pdf --box car", "--box: 'car'; "),
        ("export screen run -o a.jpg", "ends in .png or .html"),
        ("export screen run -o a.png --pixels 9", "two numbers"),
        ("export screen run -o a.png --aspect 9:0", "--aspect"),
        ("export screen run -o a.png", "give at most 336.2 mm"),
        ("car monitor run --listen nobody/home", "is no place to listen"),
        ("car monitor run --pixels 9", "two numbers"),
        ("car monitor run --background 0 0 256", "--background"),
        ("car monitor run --face left --screen 1 2 3 90", "leave out --face"),
        ("car monitor run --screen 1 2 nan 90", "must be finite"),
        ("car overlay bare.mp4 run -o b.mp4", "no pose file beside it"),
        ("car overlay small run -o b.mp4", "px"),
        ("car overlay drive run -o b.avi", "give FILE.mp4 or a folder"),
        ("car overlay drive run -o drive", "is the recording"),
        ("car overlay drive run -o drive/images", "is the recording or in it"),
        ("car overlay drive.mp4 run -o drive.mp4", "is the recording"),
        ("car overlay drive run -o small", "is not an empty folder"),
        ("car overlay drive run -o drive.mp4/b", "drive.mp4"),
    ],
)
def test_refused(recorded, monkeypatch, capsys, line, message):
    monkeypatch.chdir(recorded)
    before = {p: p.read_bytes() for p in recorded.rglob("*") if p.is_file()}
    tracker = ["--tracker", "replay:poses.csv"] if "monitor" in line else []
    assert cli.main([*line.split(), *tracker]) == 2
    out, error = capsys.readouterr()
    assert not out and message in error and "Traceback" not in error, error
    after = {p: p.read_bytes() for p in recorded.rglob("*") if p.is_file()}
    assert after == before


def test_a_monitor_follows_recorded_poses_to_their_end(recorded, monkeypatch, capsys):
    monkeypatch.chdir(recorded)
    address = f"127.0.0.1:{free_port()}"
    words = f"car monitor run --tracker replay:poses.csv --face left --listen {address}"
    assert cli.main(words.split()) == 2
    out, err = capsys.readouterr()
    assert f"http://{address}/" in out and "recording is over" in err


def test_overlay_of_recordings(run, recorded, tmp_path, capsys, monkeypatch):
    """In every frame, from folders and videos."""

    def overlay(source: str, output: str, *options: str) -> int:
        words = ["car", "overlay", recorded / source, run, "-o", tmp_path / output]
        return cli.main([*map(str, words), *options])

    assert overlay("drive.mp4", "out.mp4") == 0
    capsys.readouterr()
    assert overlay("drive", "out", "--json") == 0
    expected = {"output": str(tmp_path / "out"), "frames": 3, "object": "ball"}
    assert json.loads(capsys.readouterr().out) == expected
    for path in sorted((tmp_path / "out").iterdir()):
        frame = files.read_image(path)
        assert (frame[:4] == 0).all()  # above the target
        assert (frame[14:18, 22:26] != (40, 160, 60)).any(-1).all()
        assert (frame[30, 2] == (40, 160, 60)).all()
    # whole frames are kept when Ctrl-C comes, and no part of a video
    for name, number in (("cut", signal.SIGINT), ("cut.mp4", signal.SIGTERM)):
        with signalled("overlaying", number, at=2):
            assert overlay("drive", name) == 130
    paths = sorted((tmp_path / "cut").iterdir())
    assert len(paths) == 2 and not list(tmp_path.glob("cut.mp4*"))
    assert all(files.read_image(path).shape == (32, 48, 3) for path in paths)
    # a folder without times has the run's period
    box, views = read_box(run, texture_px=24)
    for period, code in ((0.2, 0), (1e-4, 2)):
        pair = box, replace(views, period=period)
        monkeypatch.setattr(attacked, "read_box", lambda *_, pair=pair: pair)
        assert overlay("drive", f"{code}.mp4") == code
    assert "fps: " in capsys.readouterr().err and not (tmp_path / "2.mp4").exists()
    with open_video((tmp_path / "0.mp4").read_bytes()) as container:
        assert container.streams.video[0].average_rate == pytest.approx(5)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_monitor_at_work(run, tmp_path, capsys, monkeypatch, number):
    poses = tmp_path / "poses.csv"
    poses.write_text("time_s,x_m,y_m,heading_rad\n0,4,3,0\n900,4.1,3,0\n")
    sent = []

    def send(server, pose) -> None:
        sent.append(pose)
        signal.raise_signal(number)

    monkeypatch.setattr(FollowServer, "_tell", send)
    address = f"127.0.0.1:{free_port()}"
    words = ["car", "monitor", run, "--tracker", f"replay:{poses}", "--listen", address]
    assert cli.main([*map(str, words), "--face", "left"]) == 0
    out, err = capsys.readouterr()
    assert out.endswith("Ended\n") and "Traceback" not in err
    assert len(sent) == 1


def test_what_is_no_box_is_refused(run, tmp_path, monkeypatch):
    def ball(at):
        return 0.5 - np.linalg.norm(at, axis=1)

    assert flat_share(boxes.cube_field()) > 0.97
    field = boxes.solid(ball, [-0.5] * 3, [0.5] * 3)
    assert flat_share(field) < 0.8
    path = run / "objects" / "ball.safetensors"
    before = path.read_bytes()
    try:
        save_field(path, field)
        with pytest.raises(InputError, match=r"no box was attacked: .* ball to \d+ %"):
            read_box(run)
    finally:
        path.write_bytes(before)


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """The folder that the command wrote of a run as OpenSCENARIO."""
    output = tmp_path_factory.mktemp("openscenario") / "out"
    assert cli.main(["export", "openscenario", str(run), "--output", str(output)]) == 0
    return output


@pytest.mark.parametrize(
    ("name", "schema"),
    [
        ("scenario.xosc", "OpenSCENARIO_1_2.xsd"),
        ("route.xodr", "opendrive_17_core.xsd"),
    ],
)
def test_files_obey_the_schema_of_the_standard(exported, name, schema):
    xmlschema = pytest.importorskip("xmlschema")
    there = installed_files("scenariogeneration") or ()
    (schema_file,) = [path for path in there if path.name == schema]
    xmlschema.validate(str(exported / name), str(schema_file.locate()))


def test_another_reader_finds_car_object_and_route(run, exported):
    xosc = pytest.importorskip("scenariogeneration").xosc
    read = xosc.ParseOpenScenario(str(exported / "scenario.xosc"))
    (attack,) = read_found([run])
    objects = {each.name: each.entityobject for each in read.entities.scenario_objects}
    assert set(objects) == {"ego", "ball"}
    assert objects["ball"].model3d == "ball.glb"
    assert read.roadnetwork.road_file == "route.xodr"
    car = attack.scenario.vehicle.car()
    assert objects["ego"].axles.frontaxle.maxsteer == pytest.approx(car.max_steer)
    assert objects["ego"].boundingbox.boundingbox.width == pytest.approx(car.width)
    actions = read.storyboard.init.initactions
    teleport, speed, route = actions["ego"]
    start, drives = teleport.position, read_drives(run / "drives")
    worst = max(
        (each for each in drives if each.case == "attack"),
        key=lambda each: np.abs(each.cross_track_m).max(),
    )
    assert [start.x, start.y, start.h] == pytest.approx(worst.states[0].tolist())
    assert speed.speed == attack.route.speed_ms
    points = [[each.position.x, each.position.y] for each in route.route.waypoints]
    np.testing.assert_allclose(points, attack.route.points)
    # the object stands where the attack left it
    (teleport,) = actions["ball"]
    place = teleport.position
    pose = json.loads((run / "metrics.json").read_text())["object_poses"]["ball"]
    assert [place.x, place.y, place.z] == pytest.approx(pose["position_m"])
    turned = Rotation.from_euler("ZYX", [place.h, place.p, place.r]).as_matrix()
    np.testing.assert_allclose(turned, pose["rotation"], atol=1e-6)
    mesh = trimesh.load(exported / "ball.glb", force="mesh")
    # the cube of 1.5 m, by its surface at half opacity
    np.testing.assert_allclose(mesh.extents, 1.5, atol=0.1)
    # the lane is centred on the route
    road = ElementTree.parse(exported / "route.xodr").getroot().find("road")
    assert float(road.get("length")) == pytest.approx(attack.route.length)
    offset, width = road.find("lanes/laneOffset"), road.find(".//right/lane/width")
    lane, shift = float(width.get("a")), float(offset.get("a"))
    assert lane == attack.route.lane_width_m and shift - lane / 2 == 0


def test_the_car_stands_on_its_rear_axle(run, monkeypatch, tmp_path):
    """A bicycle's state is of its centre of gravity."""
    (attack,) = read_found([run])
    bicycle = {"kind": "bicycle", "front_axle_m": 1.0, "rear_axle_m": 1.5}
    section = read_section("vehicle", VehicleSection, bicycle, tmp_path)
    scenario = attack.scenario.model_copy(update={"vehicle": section})
    other = replace(attack, scenario=scenario)
    mounts = [attacked.placed(item)[1].mount.forward_m for item in (attack, other)]
    assert mounts[1] - mounts[0] == pytest.approx(1.5)  # as trackers see it
    monkeypatch.setattr(openscenario, "read_found", lambda runs: [other])
    starts = []
    for folder in (tmp_path / "bicycle", tmp_path / "before"):
        path = openscenario.write_openscenario(run, folder)[0]
        (place,) = ElementTree.parse(path).iterfind(
            ".//Private[@entityRef='ego']//TeleportAction/Position/WorldPosition"
        )
        starts.append([float(place.get(key)) for key in "xyh"])
        monkeypatch.undo()
    (x, y, heading), (cx, cy, _) = starts
    gap = 1.5 * np.array([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose([x, y] + gap, [cx, cy])
