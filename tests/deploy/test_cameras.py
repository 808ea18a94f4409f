"""Environments of a vehicle with several cameras, against those of one."""

from __future__ import annotations

import numpy as np
import pytest
from support.worlds.fields import blob
from support.worlds.places import write_place

from mi_nerfattack.deploy.environment import first_frame
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import make_environment
from mi_nerfattack.deploy.sites import PlaceSite
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.camera.rig import Rig, camera_seed
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.dynamics import to_state
from mi_nerfattack.vehicle.route.route import load_routes

pytestmark = pytest.mark.usefixtures("variant")

LEFT = CameraMount(1.2, 0.2, 10.0, left_m=0.5, yaw_deg=40.0)
RIG = Rig(
    ("front", "left"),
    (from_fov(12, 6, 90.0), from_fov(9, 8, 70.0)),
    (CameraMount(), LEFT),
)
START = np.array([0.0, 0.3, 0.1])


def several(place: Place) -> Place:
    return place.with_rig(RIG)


def objects() -> list[PosedField]:
    field = blob(np.random.default_rng(1), peak=12.0)
    return [PosedField(field, Pose.upright((4.0, 3.0, 1.0), 0.3, 1.0))]


def drive(name: str, place: Place, conditions: Conditions, seed: int = 5):
    environment = make_environment(name, place, conditions)
    environment.show(objects())
    route = load_routes(place.routes)[0]
    environment.reset(route, START, seed)
    frame = environment.step(0.4)
    return environment, frame


@pytest.mark.parametrize("name", ["surrogate", "mitsuba", "mujoco", "mujoco_gl"])
def test_a_frame_is_the_frames_of_cameras_alone(name, tmp_path):
    place, conditions = write_place(tmp_path), Conditions(spp=2, blur_px=1.0)
    environment, frame = drive(name, several(place), conditions)
    assert environment.camera == RIG.cameras[0] and environment.rig.size == (21, 8)
    first_env, first = drive(name, place, conditions)
    for actual, expected in (
        (first_frame(frame, RIG.layout).image, first.image),
        (first_frame(frame, RIG.layout).depth, first.depth),
        (first_frame(frame, RIG.layout).light, first.light),
        (frame.camera_to_world, first.camera_to_world),
    ):
        assert np.array_equal(actual, expected)
    assert not frame.image[6:, :12].any() and np.isinf(frame.depth[6:, :12]).all()
    # the same place seen by the second camera alone, but for its random numbers
    second = place.with_rig(Rig.of_one(RIG.cameras[1], LEFT))
    second_env, alone = drive(name, second, conditions)
    depth = RIG.split(frame.depth[..., None])["left"][..., 0]
    assert np.array_equal(depth, alone.depth) and np.isfinite(depth).any()
    if name in ("surrogate", "mujoco_gl"):
        assert np.array_equal(RIG.split(frame.image)["left"], alone.image)
    else:
        state = np.random.SeedSequence([5, 1]).generate_state(1)
        body = environment.vehicle.body_to_world
        pose = body @ np.linalg.inv(second_env.vehicle.body_to_world)
        pose = pose @ alone.camera_to_world
        view = second_env.views[0].render(pose, camera_seed(int(state[0]), 1))
        assert np.array_equal(RIG.split(frame.light)["left"], view.light)
    layers = frame.layers(["ball"])
    for key, layer in first.layers(["ball"]).items():
        part = layers[key] if layer.ndim == 3 else layers[key][..., None]
        part = RIG.split(part)["front"]
        assert np.array_equal(part, layer.reshape(part.shape))
    assert layers["ball"][:, 12:, 3].any() and not layers[""][6:, :12].any()
    for each in (environment, first_env, second_env):
        each.close()


def test_the_surrogate_shows_what_a_loop_does(tmp_path):
    place = several(write_place(tmp_path))
    environment, frame = drive("surrogate", place, Conditions())
    observation = environment.sensor.observe(to_state(environment.state[None]), 1)
    image = np.round(255 * observation.image.numpy()[0]).astype(np.uint8)
    assert np.array_equal(image, frame.image)


def test_all_cameras_decide_about_the_frames_of_a_site(tmp_path):
    place = write_place(tmp_path)
    one, two = (PlaceSite("mitsuba", p).describe() for p in (place, several(place)))
    assert set(one["mount"]) == {"height_m", "forward_m", "pitch_deg"}
    assert [each["name"] for each in two.pop("cameras")] == ["front", "left"]
    assert one == two
