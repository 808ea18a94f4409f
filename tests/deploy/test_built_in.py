"""Objects built into scenes: texture, light, shadow and outline against analysis."""

from __future__ import annotations

import pickle
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy import ndimage
from support.faults.refusals import refusals
from support.worlds.fields import vertices

from mi_nerfattack.backend.colour import srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.atlas import lay_out
from mi_nerfattack.deploy.built_in import BuiltInObject, built_in_shapes, make_built_in
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.pathtrace.views import ViewRenderer

pytestmark = pytest.mark.usefixtures("variant")

LOWER, UPPER = np.array([-1.0, -0.8, -0.2]), np.array([1.0, 0.8, 1.4])
POSE = Pose.upright((1.0, 2.0, 0.0), 0.5 * np.pi, 2.0)
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


@cache
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


def write_box(folder: Path, size=2 * HALF, name="box.ply", **material) -> Path:
    """Write a box's mesh, some of its triangles inside out."""
    box = trimesh.creation.box(size)
    box.faces[:5] = box.faces[:5, ::-1]
    if material:
        paint = trimesh.visual.material.PBRMaterial(**material)
        box.visual = trimesh.visual.TextureVisuals(material=paint)
    else:
        box = trimesh.Trimesh(box.vertices, box.faces, process=False)
    box.export(folder / name)
    return folder / name


@pytest.fixture
def box_file(tmp_path):
    return write_box(tmp_path)


def made(irradiance=np.pi, field=box_field, **mesh):
    return lambda folder: make_built_in(
        field(), Pose.identity(), write_box(folder, **mesh), None, irradiance
    )


def transparent() -> GridField:
    field = GridField(GridLayout(1, 4, 4), LOWER, UPPER)
    field.set_parameter("density", np.full(field.n_vertices, -20, np.float32))
    return field


GLASS = {"alphaMode": "BLEND", "baseColorFactor": [255, 0, 0, 128]}
BOTTLE = {"size": 2 * HALF[[0, 2, 1]], "name": "glass.glb", **GLASS}
test_refused = refusals(
    *((lambda t=t: lay_out(np.eye(3)[None], t), "texel_m") for t in (1e-6, np.inf)),
    *((made(value), "captured_irradiance") for value in (0.0, np.inf, np.nan)),
    (lambda at: make_built_in(box_field(), POSE, at / "no.ply"), "does not exist"),
    (made(size=[3.0, 1, 1]), r"box\.ply: reaches from"),
    (lambda: make_built_in(transparent(), POSE), "nowhere opaque"),
    (made(**BOTTLE), "transparent"),
)


def lookup(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Look up an sRGB image bilinearly at uv (n, 2), without decoding, (n, c)."""
    bitmap = mi.Bitmap(image.astype(np.float32))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
    si = mi.SurfaceInteraction3f()
    # Mitsuba's origin is the top left
    flipped = np.ascontiguousarray((uv * [1, -1] + [0, 1]).T, np.float32)
    si.uv = mi.Point2f(flipped)
    return np.array(mi.load_dict(texture).eval(si)).T


def test_texels_lie_where_their_point_is_looked_up(rng):
    """Positions off by less than a texel; no colour bleeds into a neighbour."""
    corners = rng.normal(0, 1, (40, 3, 3))
    corners[:10, 2] = corners[:10, 1] + rng.normal(0, 1e-3, (10, 3))  # slivers
    corners[10:20] *= 0.01
    corners[20] = [[0, 0, 0], [1, 0, 0], [0.3, 1e-17, 0]]
    atlas, own = lay_out(corners, 0.02), rng.uniform(0, 1, (len(corners), 3))
    painted, baked = own[atlas.triangles], atlas.interpolate(corners)
    weights = np.concatenate([rng.dirichlet(np.ones(3), 60), np.eye(3)])
    for triangle, colour, uv in zip(corners, own, atlas.uv, strict=True):
        colours = lookup(atlas.image(painted), weights @ uv)
        np.testing.assert_allclose(colours, [colour] * len(colours), atol=1e-4)
        miss = lookup(atlas.image(baked), weights @ uv) - weights @ triangle
        assert np.linalg.norm(miss, axis=1).max() < 0.02


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
            colours = lookup(item.image, uv_at(item, side_points(rng, axis, sign)))
            expected = np.tile(255 * np.array(colour), (len(colours), 1))
            np.testing.assert_allclose(colours, expected, atol=2)

    def test_triangles_face_outwards(self, box_file):
        item = make_built_in(box_field(), Pose.identity(), box_file)
        solid = trimesh.Trimesh(item.vertices, item.faces)
        assert solid.volume == pytest.approx(8 * HALF.prod())
        surface = make_built_in(box_field(), Pose.identity())
        solid = trimesh.Trimesh(surface.vertices, surface.faces)
        # the last opaque vertices lie a voxel inside, the surface half-way to them
        shrunk = (2 * HALF - 0.05).prod()
        assert solid.volume == pytest.approx(shrunk, rel=0.03)
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


def test_radiance_of_a_side(box_file):
    """On white ground; turned by 90 degrees, the side of +y faces -x, the sun's."""
    cosine, irradiance = 0.6, 2.0
    item = make_built_in(box_field(), POSE, box_file)
    again = pickle.loads(pickle.dumps(item))  # as worker processes get it
    np.testing.assert_array_equal(again.world_vertices, item.world_vertices)
    expected = np.array([[0.2, 1.0, 0.0], [1.8, 3.0, 2.4]])
    low, high = item.world_vertices.min(0), item.world_vertices.max(0)
    np.testing.assert_allclose([low, high], expected, atol=1e-9)
    box = built_in_shapes([item])["built_in_000"].bbox()
    np.testing.assert_allclose([box.min, box.max], expected, atol=1e-6)
    reach = mi.ScalarTransform4f().scale([20, 20, 1])
    white = {"type": "diffuse", "reflectance": 1.0}
    sun = {"type": "directional", "direction": [cosine, 0.0, -0.8]}  # of its light
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "ground": {"type": "rectangle", "to_world": reach, "bsdf": white},
        "sun": sun | {"irradiance": irradiance},
    }
    lit = mi.load_dict(scene | built_in_shapes([item]), parallel=False)
    renderer = ViewRenderer(lit, from_fov(48, 48, 20.0))
    radiance = renderer.render(look_at([-4.0, 2.0, 1.2], [1.0, 2.0, 1.2]), 4, 0).rgb
    albedo = srgb_to_linear_numpy(np.array(SIDES[1, 1]))
    expected = albedo * irradiance * cosine / np.pi
    middle = radiance[14:34, 14:34].reshape(-1, 3)
    # 2 of 255 steps at a slope of at most 2.28
    tolerance = 2 / 255 * 2.28 * irradiance * cosine / np.pi
    assert np.abs(middle - expected).max() < tolerance


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("side", [-1, 1])
def test_mujoco_draws_it_as_mitsuba_does(side, box_file):
    """Three sides at a time: the outline, and each side's own colour on it."""
    from mi_nerfattack.deploy.mujoco.view import MujocoView

    item = make_built_in(box_field(), POSE, box_file)
    below = mi.ScalarTransform4f().translate([0, 0, -9])
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sky": {"type": "constant"},
        "ground": {"type": "rectangle", "to_world": below},
    }
    built = mi.load_dict({**scene, **built_in_shapes([item])}, parallel=False)
    middle, camera = np.array([1.0, 2.0, 1.2]), from_fov(80, 60, 40.0)
    eye = look_at(middle + side * np.array([4.0, 5.0, 6.0]), middle)
    view = MujocoView(mi.load_dict(scene, parallel=False), camera, [item])
    truth, drawn = MitsubaView(built, camera, 16).render(eye, 0), view.render(eye, 0)
    view.close()
    near = [frame.depth < 12 for frame in (truth, drawn)]
    assert near[0].sum() > 600
    assert (near[0] & near[1]).sum() / (near[0] | near[1]).sum() > 0.95
    both = ndimage.binary_erosion(near[0] & near[1])
    assert np.median(np.abs(truth.depth[both] - drawn.depth[both])) < 0.01
    colours = np.array([frame.image[both].astype(float) for frame in (truth, drawn)])
    hues = colours / np.linalg.norm(colours, axis=2, keepdims=True)
    # less than 8 degrees between the colours, but at the sides' edges
    assert np.mean((hues[0] * hues[1]).sum(1) > np.cos(np.radians(8))) > 0.9
