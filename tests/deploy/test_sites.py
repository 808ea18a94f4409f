"""What tells the frames and drives of one place from those of another."""

from __future__ import annotations

import importlib.metadata
import json
from dataclasses import replace

import pytest
from helpers.tiny_place import SCENE, write_place

from mi_nerfattack.deploy.sites import PlaceSite
from mi_nerfattack.render.camera.pose import Pose

pytestmark = pytest.mark.usefixtures("variant")

MESH = '<shape type="ply"><string name="filename" value="block.ply"/></shape>'


def test_a_mesh_beside_the_scene_decides_about_the_frames(tmp_path):
    place = write_place(tmp_path)
    place.scene.write_text(SCENE.replace("</scene>", MESH + "</scene>"))
    site = PlaceSite("mitsuba", place)
    (tmp_path / "block.ply").write_text("one")
    before = site.describe()
    (tmp_path / "unused.ply").write_text("other")
    assert site.describe() == before
    (tmp_path / "block.ply").write_text("two")
    assert site.describe() != before
    # without it, rendering says so
    (tmp_path / "block.ply").unlink()
    assert site.describe() != before


def test_files_of_equal_names_in_folders_of_equal_names_all_count(tmp_path):
    place = write_place(tmp_path)
    shapes = ""
    for folder in ("a/meshes", "b/meshes"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "block.ply").write_text(folder)
        named = MESH.replace("block.ply", f"{folder}/block.ply")
        shapes += named.replace("<shape ", f'<shape id="{folder[0]}" ')
    place.scene.write_text(SCENE.replace("</scene>", shapes + "</scene>"))
    site = PlaceSite("mitsuba", place)
    seen = [site.describe()]
    for folder in ("a/meshes", "b/meshes"):
        (tmp_path / folder / "block.ply").write_text("changed")
        seen.append(site.describe())
    assert all(one != other for one, other in zip(seen, seen[1:], strict=False))


@pytest.mark.parametrize(
    ("name", "package"),
    [("mujoco", "mujoco"), ("mujoco_gl", "mujoco"), ("carla", "carla")],
)
def test_the_version_of_what_simulates_counts_where_it_simulates(
    name, package, tmp_path, monkeypatch
):
    place = write_place(tmp_path)
    sites = PlaceSite(name, place), PlaceSite("mitsuba", place)
    before = [site.describe() for site in sites]
    whole = importlib.metadata.version

    def version(asked: str) -> str:
        return "99.0" if asked == package else whole(asked)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert sites[0].describe() == {**before[0], package: "99.0"} != before[0]
    assert sites[1].describe() == before[1]


def test_a_package_that_is_not_installed_is_told_by_the_environment(
    tmp_path, monkeypatch
):
    def version(asked: str) -> str:
        raise importlib.metadata.PackageNotFoundError(asked)

    monkeypatch.setattr(importlib.metadata, "version", version)
    described = PlaceSite("carla", write_place(tmp_path)).describe()
    assert described["carla"] == "not installed"


def test_the_server_counts_for_carla_alone(tmp_path):
    place = write_place(tmp_path)
    other = replace(place, server="127.0.0.1:2000/Town03")
    for name, is_equal in (("carla", False), ("mitsuba", True)):
        one, two = (PlaceSite(name, item).describe() for item in (place, other))
        assert (one == two) is is_equal


def test_there_are_as_many_objects_as_stand_beside_the_road(tmp_path):
    site = PlaceSite("mitsuba", write_place(tmp_path))
    objects = site.load_objects(3)
    assert len({id(item) for item in objects}) == 3  # fields of their own
    assert len(site.load_objects(0)) == len(site.load_objects()) == 1
    bare = replace(site, place=replace(site.place, objects=()))
    assert bare.load_objects(2) == []


def test_where_a_field_is_put_decides_about_the_frames(tmp_path):
    place = write_place(tmp_path)
    poses = None, Pose.identity(), Pose.upright((1.0, 0.0, 0.0), 0.0)
    seen = [
        PlaceSite("surrogate", replace(place, field_pose=p)).describe() for p in poses
    ]
    assert all(one != other for one, other in zip(seen, seen[1:], strict=False))
    json.dumps(seen)
