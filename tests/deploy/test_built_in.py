"""Objects built into scenes: texture, light, shadow and outline against analysis."""

from __future__ import annotations

import pickle
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.small_fields import vertices
from scipy import ndimage

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.atlas import lay_out
from mi_nerfattack.deploy.built_in import BuiltInObject, built_in_shapes, make_built_in
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.render.camera.intrinsics import (
    CameraMount,
    from_fov,
    look_at,
    mount_matrix,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenes import bundled

pytestmark = pytest.mark.usefixtures("variant")

LOWER, UPPER = np.array([-1.0, -0.8, -0.2]), np.array([1.0, 0.8, 1.4])
HALF, MIDDLE = np.array([0.5, 0.4, 0.6]), np.array([0.0, 0.0, 0.6])
#: sRGB of the sides, by (axis, sign).
SIDES = {
    (0, 1): (0.9, 0.2, 0.1),
    (0, -1): (0.1, 0.8, 0.3),
    (1, 1): (0.2, 0.3, 0.9),
    (1, -1): (0.9, 0.8, 0.1),
    (2, 1): (0.5, 0.5, 0.5),
    (2, -1): (0.1, 0.7, 0.8),
}


def box_field() -> GridField:
    """Make a box 1 x 0.8 x 1.2 on z = 0, each point coloured as the nearest side."""
    field = GridField(GridLayout(1, 40, 40), LOWER, UPPER)
    offset = vertices(field) - MIDDLE
    depth = HALF - np.abs(offset)
    axis = depth.argmin(1)
    sign = np.sign(offset[np.arange(len(axis)), axis] + 1e-9).astype(int)
    keys = list(zip(axis.tolist(), sign.tolist(), strict=True))
    colour = np.array([SIDES[key] for key in keys])
    raw = np.clip(400 * depth.min(1), -20, 6)
    field.set_parameter("density", raw.astype(np.float32))
    field.set_parameter("texture", np.log(colour / (1 - colour)).astype(np.float32))
    return field


@pytest.fixture
def box_file(tmp_path):
    """Write the box's mesh, some of its triangles inside out."""
    box = trimesh.creation.box(2 * HALF)
    box.faces[:5] = box.faces[:5, ::-1]
    path = tmp_path / "box.ply"
    trimesh.Trimesh(box.vertices, box.faces, process=False).export(path)
    return path


def lookup(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Look up an sRGB image bilinearly at uv (n, 2), without decoding, (n, c)."""
    texture = mi.load_dict(
        {
            "type": "bitmap",
            "bitmap": mi.Bitmap(image.astype(np.float32)),
            "raw": True,
            "wrap_mode": "clamp",
        }
    )
    si = mi.SurfaceInteraction3f()
    # Mitsuba's origin is the top left
    flipped = np.ascontiguousarray((uv * [1, -1] + [0, 1]).T, np.float32)
    si.uv = mi.Point2f(flipped)
    return np.array(texture.eval(si)).T


def scattered(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw barycentric coordinates (n + 3, 3), the corners among them."""
    return np.concatenate([rng.dirichlet(np.ones(3), n), np.eye(3)])


class TestAtlas:
    def triangles(self, rng: np.random.Generator) -> np.ndarray:
        corners = rng.normal(0, 1, (40, 3, 3))
        corners[:10, 2] = corners[:10, 1] + rng.normal(0, 1e-3, (10, 3))  # slivers
        corners[10:20] *= 0.01
        corners[20] = [[0, 0, 0], [1, 0, 0], [0.3, 1e-17, 0]]
        return corners

    def test_no_colour_bleeds_into_a_neighbour(self, rng):
        corners = self.triangles(rng)
        atlas = lay_out(corners, 0.05)
        own = rng.uniform(0, 1, (len(corners), 3))
        image = atlas.image(own[atlas.triangles])
        weights = scattered(rng, 60)
        for index, uv in enumerate(atlas.uv):
            found = lookup(image, weights @ uv)
            np.testing.assert_allclose(found, own[[index] * len(found)], atol=1e-4)

    def test_texels_lie_where_their_point_is_looked_up(self, rng):
        """Positions, baked and looked up: off by less than a texel."""
        corners = self.triangles(rng)
        atlas = lay_out(corners, 0.02)
        image = atlas.image(atlas.interpolate(corners))
        weights = scattered(rng, 60)
        for triangle, uv in zip(corners, atlas.uv, strict=True):
            found = lookup(image, weights @ uv)
            miss = np.linalg.norm(found - weights @ triangle, axis=1)
            assert miss.max() < 0.02

    @pytest.mark.parametrize("texel", [1e-6, 0.0, np.inf])
    def test_refused(self, texel, rng):
        with pytest.raises(InputError, match="texel_m"):
            lay_out(self.triangles(rng), texel)


def side_points(rng: np.random.Generator, axis: int, sign: int) -> np.ndarray:
    """Draw points (50, 3) of a side, where the field mixes no other side's colour."""
    points = MIDDLE + rng.uniform(-1, 1, (50, 3)) * (HALF - 0.13)
    points[:, axis] = MIDDLE[axis] + sign * HALF[axis]
    return points


def uv_at(item: BuiltInObject, points: np.ndarray) -> np.ndarray:
    """Find the texture coordinates (n, 2) of points on the surface."""
    mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
    _, distance, face = trimesh.proximity.closest_point_naive(mesh, points)
    assert distance.max() < 0.06  # 1.2 voxels
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    return np.einsum("nc,ncd->nd", weights, item.uv[item.faces[face]])


class TestColours:
    @pytest.mark.parametrize("own_mesh", [True, False])
    def test_sides_of_a_box(self, own_mesh, box_file, rng):
        mesh = box_file if own_mesh else None
        item = make_built_in(box_field(), Pose.identity(), mesh)
        for (axis, sign), colour in SIDES.items():
            found = lookup(item.image, uv_at(item, side_points(rng, axis, sign)))
            expected = np.tile(255 * np.array(colour), (len(found), 1))
            np.testing.assert_allclose(found, expected, atol=2)

    def test_triangles_face_outwards(self, box_file):
        item = make_built_in(box_field(), Pose.identity(), box_file)
        solid = trimesh.Trimesh(item.vertices, item.faces)
        assert solid.volume == pytest.approx(8 * HALF.prod())
        assert item.normals is None
        surface = make_built_in(box_field(), Pose.identity())
        solid = trimesh.Trimesh(surface.vertices, surface.faces)
        # the last opaque vertices lie a voxel inside, the surface half-way to them
        shrunk = (2 * HALF - 0.05).prod()
        assert solid.volume == pytest.approx(shrunk, rel=0.03)
        assert surface.normals is not None
        outward = ((surface.vertices - MIDDLE) * surface.normals).sum(1)
        assert outward.min() > 0

    def test_captured_irradiance_divides(self, box_file):
        field = box_field()
        light = make_built_in(field, Pose.identity(), box_file, texel_m=0.2)
        dark = make_built_in(
            field, Pose.identity(), box_file, None, 2 * np.pi, texel_m=0.2
        )
        linear = [srgb_to_linear_numpy(i.image / 255) for i in (light, dark)]
        # a step of 8 bits is at most 2.28 / 255 in linear
        np.testing.assert_allclose(linear[1], 0.5 * linear[0], atol=0.014)
        bright = make_built_in(field, Pose.identity(), box_file, None, 1e-3)
        assert bright.image.max() == 255

    def test_refused(self, box_file, tmp_path):
        field, pose = box_field(), Pose.identity()
        for value in (0.0, -1.0, np.inf, np.nan):
            with pytest.raises(InputError, match="captured_irradiance"):
                make_built_in(field, pose, box_file, None, value)
        with pytest.raises(InputError, match="does not exist"):
            make_built_in(field, pose, tmp_path / "no.ply")
        wide = tmp_path / "wide.ply"
        trimesh.creation.box([3.0, 1, 1]).export(wide)
        with pytest.raises(InputError, match=r"wide\.ply: reaches from"):
            make_built_in(field, pose, wide)
        field.set_parameter("density", np.full(field.n_vertices, -20, np.float32))
        with pytest.raises(InputError, match="nowhere opaque"):
            make_built_in(field, pose)

    def test_transparent_mesh_is_refused(self, tmp_path):
        box = trimesh.creation.box(2 * HALF)
        box.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                alphaMode="BLEND", baseColorFactor=[255, 0, 0, 128]
            )
        )
        path = tmp_path / "glass.glb"
        turn = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
        box.apply_transform(turn)
        box.export(path)
        with pytest.raises(InputError, match="transparent"):
            make_built_in(box_field(), Pose.identity(), path)


POSE = Pose.upright((1.0, 2.0, 0.0), 0.5 * np.pi, 2.0)


def test_radiance_of_a_side(box_file):
    """On white ground; turned by 90 degrees, the side of +y faces -x, the sun's."""
    cosine, irradiance = 0.6, 2.0
    item = make_built_in(box_field(), POSE, box_file)
    reach = mi.ScalarTransform4f().scale([20, 20, 1])
    white = {"type": "diffuse", "reflectance": 1.0}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "ground": {"type": "rectangle", "to_world": reach, "bsdf": white},
        "sun": {
            "type": "directional",
            "direction": [cosine, 0.0, -0.8],  # where its light goes
            "irradiance": irradiance,
        },
    }
    lit = mi.load_dict(scene | built_in_shapes([item]), parallel=False)
    renderer = ViewRenderer(lit, from_fov(48, 48, 20.0))
    seen = renderer.render(look_at([-4.0, 2.0, 1.2], [1.0, 2.0, 1.2]), 4, 0).rgb
    albedo = srgb_to_linear_numpy(np.array(SIDES[1, 1]))
    expected = albedo * irradiance * cosine / np.pi
    middle = seen[14:34, 14:34].reshape(-1, 3)
    # 2 of 255 steps at a slope of at most 2.28
    tolerance = 2 / 255 * 2.28 * irradiance * cosine / np.pi
    assert np.abs(middle - expected).max() < tolerance


def test_world_vertices(box_file):
    pose = Pose.upright((1.0, 2.0, 3.0), 0.5 * np.pi, 2.0)
    item = make_built_in(box_field(), pose, box_file, texel_m=0.3)
    expected = np.array([[0.2, 1.0, 3.0], [1.8, 3.0, 5.4]])
    low, high = item.world_vertices.min(0), item.world_vertices.max(0)
    np.testing.assert_allclose([low, high], expected, atol=1e-9)
    box = built_in_shapes([item])["built_in_000"].bbox()
    np.testing.assert_allclose([box.min, box.max], expected, atol=1e-6)
    again = pickle.loads(pickle.dumps(item))  # as worker processes get it
    np.testing.assert_array_equal(again.world_vertices, item.world_vertices)
    moved = replace(item, pose=Pose.identity())
    np.testing.assert_array_equal(moved.world_vertices, item.vertices)


@pytest.mark.slow
def test_hydrant_covers_the_pixels_that_it_is_pasted_over():
    field = load_grid(bundled("hydrant/field.safetensors"))
    pose = Pose.upright((-8.0, -5.6, 0.12), 0.3, 2.0)
    item = make_built_in(field, pose, bundled("hydrant/hydrant.glb"), texel_m=0.03)
    path, camera = bundled("intersection/scene.xml"), from_fov(240, 120, 60.0)
    eye = mount_matrix(np.array([[-13.0, -1.75, -0.5]]), CameraMount())[0]
    plain = MitsubaView(load_scene(path), camera, spp=4)
    empty = plain.render(eye, 0)
    plain.show([PosedField(field, pose)])
    pasted = plain.render(eye, 0)
    scene = load_scene(path, shapes=built_in_shapes([item]))
    built = MitsubaView(scene, camera, spp=4).render(eye, 0)
    over, under = (frame.depth < empty.depth - 1e-3 for frame in (pasted, built))
    both = over & under
    assert both.sum() > 900
    assert both.sum() / (over | under).sum() > 0.9
    # a voxel of the enlarged hydrant is 0.025 m
    assert np.median(np.abs(pasted.depth[both] - built.depth[both])) < 0.025
    # where it stands in the sun, red stays red
    assert built.image[both].mean(0).argmax() == 0


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("side", [-1, 1])
def test_mujoco_draws_it_as_mitsuba_does(side, box_file):
    """Three sides at a time: the outline, and each side's own colour on it."""
    from mi_nerfattack.deploy.mujoco.view import MujocoView

    item = make_built_in(box_field(), POSE, box_file)
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sky": {"type": "constant"},
        "ground": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -9]),
        },
    }
    built = mi.load_dict({**scene, **built_in_shapes([item])}, parallel=False)
    middle = np.array([1.0, 2.0, 1.2])
    eye = look_at(middle + side * np.array([4.0, 5.0, 6.0]), middle)
    camera = from_fov(80, 60, 40.0)
    truth = MitsubaView(built, camera, 16).render(eye, 0)
    view = MujocoView(mi.load_dict(scene, parallel=False), camera, [item])
    drawn = view.render(eye, 0)
    view.close()
    near = [frame.depth < 12 for frame in (truth, drawn)]
    assert near[0].sum() > 600
    assert (near[0] & near[1]).sum() / (near[0] | near[1]).sum() > 0.95
    both = ndimage.binary_erosion(near[0] & near[1])
    assert np.median(np.abs(truth.depth[both] - drawn.depth[both])) < 0.01
    hues = [
        frame.image[both]
        / np.linalg.norm(frame.image[both].astype(float), axis=1)[:, None]
        for frame in (truth, drawn)
    ]
    # less than 8 degrees between the colours, but at the sides' edges
    assert np.mean((hues[0] * hues[1]).sum(1) > np.cos(np.radians(8))) > 0.9
