"""Where faces belong on a monitor, against an overlay; the server; the page."""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from contextlib import closing

import numpy as np
import pytest
from scipy.ndimage import binary_opening
from scipy.spatial.transform import Rotation
from support.faults.injected import wait_for
from support.pages.browser import browser
from support.worlds.attacks import made_box

from mi_nerfattack.car.devices import AbstractTracker, DeviceLostError, TrackedPose
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.network import Endpoint
from mi_nerfattack.props import follow
from mi_nerfattack.props.attacked import FACES
from mi_nerfattack.props.monitor import Screen
from mi_nerfattack.props.overlay import Overlay
from mi_nerfattack.render.camera.intrinsics import Camera
from mi_nerfattack.render.camera.pose import Pose

TURNED = Rotation.from_euler("z", 25, degrees=True).as_matrix()
BOX = made_box(pose=Pose(TURNED, np.array([2.0, 1.0, 0.4]), 0.25))
SCREEN = Screen(640, 360)  # 598 x 336 mm
STANDING = follow.StandingScreen.on_face(SCREEN, BOX, "front")
#: How the page shows its faces at present.
FACES_SHOWN = """[...document.querySelectorAll("#faces img")].map(
  (image) => image.style.visibility + image.style.transform).join(";")"""
EYES = [[1.4, -0.9, 0.6], [2.6, -0.4, 0.9], [3.0, 0.2, 0.3]]


class ScriptedTracker(AbstractTracker):
    """Has the pose that a test gives it."""

    def __init__(self) -> None:
        self.pose: TrackedPose | None = None
        self.is_over = False

    def at(self, eye, heading: float = 0.0) -> None:
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
        matrix[:3, 3] = eye
        index = 0 if self.pose is None else self.pose.index + 1
        self.pose = TrackedPose(matrix, time.monotonic(), index)

    def newest(self, body: str) -> TrackedPose | None:
        if self.is_over:
            raise DeviceLostError("tracker: is over")
        return self.pose

    def close(self) -> None:
        pass


def virtual_camera(standing: follow.StandingScreen, eye: np.ndarray):
    """Return the pinhole whose image plane is the monitor, and its pose."""
    into = np.cross(standing.right, standing.down)
    away = (standing.middle - eye) @ into
    foot = eye + away * into - standing.middle
    density = 1e3 * np.array(standing.screen.px_per_mm)
    middle = np.array([standing.screen.width_px, standing.screen.height_px]) / 2
    spot = middle + density * [foot @ standing.right, foot @ standing.down]
    pose = np.eye(4)
    pose[:3] = np.stack([standing.right, standing.down, into, eye], axis=1)
    size = standing.screen.width_px, standing.screen.height_px
    return Camera(*size, *(away * density), *spot), pose


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("where", ["face", "upright"])
def test_points_of_faces_lie_behind_their_pixels(eye, where):
    """On the line from the eye; faces that the eye does not see are left out."""
    standing = STANDING
    if where == "upright":
        heading = np.deg2rad(-80.0)
        standing = follow.StandingScreen.upright(
            SCREEN, np.array([2.1, 0.8, 0.5]), heading
        )
        facing = np.cross(standing.down, standing.right)
        np.testing.assert_allclose(facing[:2], [np.cos(heading), np.sin(heading)])
    eye = np.array(eye)
    faces = follow.seen_faces(standing, BOX, eye)
    camera, pose = virtual_camera(standing, eye)
    assert faces
    for face in FACES:
        corner, across, down = BOX.plane(face)
        outward = np.cross(down, across)
        assert (face in faces) == ((eye - corner) @ outward > 0)
    for face, matrix in faces.items():
        corner, across, down = BOX.plane(face)
        for u, v in ((0.0, 0.0), (1.0, 0.0), (0.3, 0.9)):
            x, y, z = (corner + u * across + v * down - eye) @ pose[:3, :3]
            expected = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
            column = matrix @ [u, v, 1]
            assert column[2] > 0
            assert column[:2] / column[2] == pytest.approx(expected, abs=1e-6)


def test_on_its_own_face_a_picture_stands_still():
    """Whoever looks from wherever: the face lies in the monitor's plane."""
    wide, high = 250 * np.array(SCREEN.px_per_mm)
    for eye in np.array(EYES)[:2]:
        matrix = follow.seen_faces(STANDING, BOX, eye)["front"]
        spots = matrix @ np.array([[0, 0, 1], [1, 1, 1]]).T
        spots = (spots[:2] / spots[2]).T
        left, top = 320 - wide / 2, 180 - high / 2
        np.testing.assert_allclose(spots[0], [left, top], atol=1e-6)
        np.testing.assert_allclose(spots[1], [left + wide, top + high], atol=1e-6)
    behind = STANDING.middle - np.cross(STANDING.down, STANDING.right)
    assert follow.seen_faces(STANDING, BOX, behind) == {}


def serve(
    tracker: ScriptedTracker,
    say=print,
    page: str = "",
    port: int = 0,
    camera=(0.0,) * 3,
):
    """Make a server of this computer; the tests' one call of its nine arguments."""
    endpoint, place = Endpoint("127.0.0.1", port), np.array(camera)
    return follow.FollowServer(
        endpoint, page, STANDING, BOX, tracker, "car", place, say
    )


@pytest.fixture
def served():
    """A server, its tracker, what it says, and what ends it."""
    tracker, said, errors = ScriptedTracker(), [], []
    page = follow.follow_page(STANDING, BOX, (9, 8, 7))
    server = serve(tracker, said.append, page, camera=(0.1, 0.0, 0.2))

    def run() -> None:
        try:
            server.run()
        except DeviceLostError as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    with closing(server):
        yield server, tracker, said, errors
    thread.join(10)
    assert not thread.is_alive()


def test_each_new_pose_is_an_event(served):
    server, tracker, said, errors = served
    wait_for(lambda: said)
    with urllib.request.urlopen(server.address, timeout=20) as answer:
        page = answer.read().decode()
    assert "#090807" in page and page.count("data:image/png") == 6
    with urllib.request.urlopen(server.address + "eye", timeout=20) as events:
        for eye, heading in zip(EYES, (0.0, np.pi / 2, 0.0), strict=True):
            tracker.at(eye, heading)
            line = b""
            while not line.startswith(b"data: "):
                line = events.readline()
            matrices = json.loads(line[6:])
            turned = [-0.0, 0.1, 0.2] if heading else [0.1, 0.0, 0.2]
            expected = follow.seen_faces(STANDING, BOX, np.array(eye) + turned)
            assert list(matrices) == list(expected)
            for face, matrix in expected.items():
                actual = np.reshape(matrices[face], (3, 3))
                np.testing.assert_allclose(actual, matrix, atol=1e-9)
    wait_for(lambda: len(said) == 2)  # lost at first, then seen again
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(server.address + "other", timeout=20)
    tracker.is_over = True
    wait_for(lambda: errors)
    port = int(server.address.rstrip("/").rpartition(":")[2])
    with pytest.raises(InputError, match="cannot listen there .* give another"):
        serve(tracker, port=port)


def test_it_ends_though_it_was_never_run():
    """As where nobody can be told its address, or by Ctrl-C meanwhile."""
    thread = threading.Thread(target=serve(ScriptedTracker()).close, daemon=True)
    thread.start()
    thread.join(10)
    assert not thread.is_alive()


@pytest.mark.slow
def test_a_browser_shows_what_the_camera_would_see(tmp_path):
    """Pixel by pixel, but for edges, as the overlay by the monitor's own camera."""
    rng, tracker = np.random.default_rng(0), ScriptedTracker()
    tiles = {face: rng.integers(30, 255, (8, 8, 3)) for face in FACES}
    block = np.ones((32, 32, 1))
    images = {
        face: np.kron(tile, block).astype(np.uint8) for face, tile in tiles.items()
    }
    box = made_box(images, pose=BOX.pose)
    standing = follow.StandingScreen.on_face(SCREEN, box, "front")
    text, endpoint = follow.follow_page(standing, box), Endpoint("127.0.0.1", 0)
    server = follow.FollowServer(
        endpoint, text, standing, box, tracker, "car", np.zeros(3), print
    )
    with closing(server), browser(tmp_path) as page:
        page.resize(SCREEN.width_px, SCREEN.height_px)
        page.go(server.address)
        page.wait('document.readyState === "complete"')
        for eye in EYES:
            before, shot = page.ask(FACES_SHOWN), tmp_path / "shot.png"
            tracker.at(eye)
            page.wait(f"{FACES_SHOWN} !== {before!r}")
            page.shot(shot)
            shown = files.read_image(shot)[..., :3]
            camera, pose = virtual_camera(standing, np.array(eye))
            overlay = Overlay(box, camera, keyed=False)
            expected = overlay.apply(np.zeros((360, 640, 3), np.uint8), pose)
            far = np.abs(shown.astype(int) - expected).max(2) > 60
            covered = expected.any(2)
            assert covered.mean() > 0.3
            # tiles are some 25 pixels wide, and all differ
            assert far.sum() < 0.02 * covered.sum()
            assert not binary_opening(far, np.ones((3, 3))).any()
        assert page.messages == []
