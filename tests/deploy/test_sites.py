"""What tells the frames and drives of one place from those of another."""

from __future__ import annotations

import importlib.metadata
import json
from dataclasses import replace

import numpy as np
import pytest
from support.faults.refusals import refusals
from support.worlds.places import SCENE, straight, write_place

from mi_nerfattack.deploy.place import Scatter
from mi_nerfattack.deploy.sites import PlaceSite
from mi_nerfattack.render.camera.pose import Pose

pytestmark = pytest.mark.usefixtures("variant")

MESH = """<shape type="ply" id="{0}">
<string name="filename" value="{0}/meshes/block.ply"/></shape>"""


def test_meshes_beside_the_scene_decide_about_the_frames(tmp_path):
    place, shapes = write_place(tmp_path), ""
    for folder in "ab":  # of equal names in folders of equal names
        path = tmp_path / folder / "meshes/block.ply"
        path.parent.mkdir(parents=True)
        path.write_text("one")
        shapes += MESH.format(folder)
    place.scene.write_text(SCENE.replace("</scene>", shapes + "</scene>"))
    site = PlaceSite("mitsuba", place)
    before = site.describe()
    (tmp_path / "unused.ply").write_text("other")
    assert site.describe() == before
    for folder in "ab":
        path = tmp_path / folder / "meshes/block.ply"
        path.write_text("two")
        assert site.describe() != before
        path.unlink()  # rendering says that it is missing
        assert site.describe() != before
        path.write_text("one")
    assert site.describe() == before


SERVER, TURNED = {"server": "127.0.0.1:2000/Town03"}, Pose.upright((1.0, 0, 0), 0.0)


@pytest.mark.parametrize(
    ("name", "change", "is_equal"),
    [
        ("carla", SERVER, False),
        ("mitsuba", SERVER, True),
        ("surrogate", {"field_pose": Pose.identity()}, False),
        ("surrogate", {"field_pose": TURNED}, False),
    ],
)
def test_a_place_counts_where_it_is_used(tmp_path, name, change, is_equal):
    place = write_place(tmp_path)
    one, two = (
        PlaceSite(name, p).describe() for p in (place, replace(place, **change))
    )
    assert (json.dumps(one) == json.dumps(two)) is is_equal


@pytest.mark.parametrize("name", ["mujoco", "mujoco_gl", "carla"])
def test_the_version_of_what_simulates_counts_where_it_simulates(
    name, tmp_path, monkeypatch
):
    place, package = write_place(tmp_path), name.removesuffix("_gl")
    sites = PlaceSite(name, place), PlaceSite("mitsuba", place)
    before = [site.describe() for site in sites]
    for release in ("99.0", "not installed"):

        def version(asked: str, release=release) -> str:
            if release[0].isdigit():
                return release
            raise importlib.metadata.PackageNotFoundError(asked)

        monkeypatch.setattr(importlib.metadata, "version", version)
        assert sites[0].describe() == {**before[0], package: release}
        assert sites[1].describe() == before[1]


def test_there_are_as_many_objects_as_stand_beside_the_road(tmp_path):
    site = PlaceSite("mitsuba", write_place(tmp_path))
    objects = site.load_objects(3)
    assert len({id(item) for item in objects}) == 3  # fields of their own
    assert len(site.load_objects(0)) == len(site.load_objects()) == 1
    bare = replace(site, place=replace(site.place, objects=()))
    assert bare.load_objects(2) == []


def test_the_order_of_several_objects_counts(tmp_path):
    place, other = write_place(tmp_path), tmp_path / "other.safetensors"
    other.write_bytes(b"other")

    def described(*objects):
        return PlaceSite("mitsuba", replace(place, objects=objects)).describe()

    assert described(*place.objects, other) != described(other, *place.objects)
    assert "objects" not in described(other)  # digests from before the key stay


def test_scatter_has_its_deviations_and_cuts(rng):
    for close_share, part in ((0.0, 1.0), (1.0, 0.2)):
        scatter = Scatter(close_share=close_share)
        states = scatter.states(straight(), np.full(4000, 7.0), rng)
        assert np.abs(states[:, 1]).max() <= 1.5 * part
        assert np.abs(states[:, 2]).max() <= 0.4 * part
        # of a normal cut at three standard deviations: 0.9867 of the deviation
        assert states[:, 1].std() == pytest.approx(0.4933 * part, rel=0.04)
        np.testing.assert_allclose(states[:, 0], 7.0)
    states = Scatter(0.0, 0.0, 0.0, 0.0).states(straight(), np.full(3, 7.0), rng)
    np.testing.assert_array_equal(states, [[7.0, 0.0, 0.0]] * 3)


test_scatter_out_of_range_is_refused = refusals(
    (lambda: Scatter(lateral_sd_m=-0.1), "Scatter.lateral_sd_m: -0.1")
)
