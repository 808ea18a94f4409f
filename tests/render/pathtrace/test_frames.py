"""Frames of scenes: channels, closed forms, poses, passes, metadata; and views."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from support.reference.derivatives import nothing_compiled
from support.worlds import films as scenes

from mi_nerfattack.backend.versions import versions
from mi_nerfattack.capture.camera_path import read_path, route_path
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.pathtrace import frames as film
from mi_nerfattack.render.pathtrace.frames import FrameRenderer, write_frame
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import ViewRenderer
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")

AOVS = "dd.y:depth,nn:sh_normal,pp:position"
AOV_NAMES = ["dd.y.T", *(f"{layer}.{c}" for layer in ("nn", "pp") for c in "XYZ")]


def aov(inside: str = "") -> str:
    text = f'<string name="aovs" value="{AOVS}"/>'
    return f'<integrator type="aov">{text}{inside}</integrator>'


def stored(path):
    """Read channels and header as other programs do."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        pixels = {name: channel.pixels for name, channel in file.channels().items()}
        return pixels, dict(file.header())


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_slab_has_its_closed_form_in_every_filter(tmp_path, rfilter):
    path = scenes.write_slab(tmp_path, f'<rfilter type="{rfilter}"/>')
    channels = FrameRenderer(path, spp=4).render().channels
    sigma, length, near = scenes.DENSITY, 2.0, 2.0 - scenes.NEAR
    opacity = 1 - np.exp(-sigma * length)
    moment = (1 - (1 + sigma * length) * np.exp(-sigma * length)) / sigma
    srgb = 1 / (1 + np.exp(-scenes.RAW_COLOUR))
    radiance = ((srgb + 0.055) / 1.055) ** 2.4
    centre = scenes.HEIGHT // 2, scenes.WIDTH // 2
    # rays of one pixel differ by 0.3 degrees from the axis, 1.3e-5 in length
    expected = dict.fromkeys("RGB", opacity * radiance)
    expected |= {"A": opacity, "Z": near + moment / opacity}
    for prefix in ("", "box."):
        actual = {name: channels[prefix + name][centre] for name in expected}
        assert actual == pytest.approx(expected, rel=1e-3)


def test_depth_is_infinite_where_there_is_nothing_and_never_nan(tmp_path):
    path = scenes.write_slab(tmp_path, '<rfilter type="gaussian"/>', fov=120)
    channels = FrameRenderer(path, spp=16).render().channels
    depth, opacity = channels["Z"], channels["A"]
    assert not np.isnan(depth).any()
    assert np.isinf(depth[0, 0]) and opacity[0, 0] == 0
    hit = opacity > 0
    np.testing.assert_array_equal(np.isinf(depth), ~hit)
    # between the nearest face and the farthest corner of the box
    assert depth[hit].min() > 2 and depth[hit].max() < np.sqrt(4**2 + 2)
    write_frame(tmp_path / "a.exr", FrameRenderer(path).render(), "half")


def test_left_is_left_and_up_is_up(tmp_path):
    frame = FrameRenderer(scenes.write_balls(tmp_path), spp=4).render()
    write_frame(tmp_path / "a.png", frame, "half")
    image = np.array(mi.Bitmap(str(tmp_path / "a.png")))
    focal = 0.5 * scenes.WIDTH / np.tan(np.radians(20))
    right, down = np.array([[-0.6, -0.45], [0.6, 0.45]]).T * focal / 3
    columns = (scenes.WIDTH / 2 + right).astype(int)
    rows = (scenes.HEIGHT / 2 + down).astype(int)
    np.testing.assert_array_equal(image[rows[0], columns[0]], [255, 0, 0])
    np.testing.assert_array_equal(image[rows[1], columns[1]], [0, 255, 0])
    assert image[0, -1].max() == 0 and image[-1, 0].max() == 0


@pytest.mark.parametrize("pixels", ["rgb", "rgba", "luminance", "luminance_alpha"])
def test_frame_is_what_mitsuba_renders(tmp_path, pixels):
    text = f'<string name="pixel_format" value="{pixels}"/>{scenes.BOX}'
    path = scenes.write_balls(tmp_path, film=text)
    frame = FrameRenderer(path, spp=3).render(seed=7)
    names = {"rgb": "RGB", "rgba": "RGBA", "luminance": "Y", "luminance_alpha": "YA"}
    assert "".join(frame.channels) == names[pixels]
    scene = mi.load_file(str(path), parallel=False)
    expected = np.array(mi.render(scene, spp=3, seed=7))
    actual = np.stack(list(frame.channels.values()), axis=-1)
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-7)
    write_frame(tmp_path / "a.png", frame, "half")


@pytest.mark.parametrize(
    ("pixels", "letters"), [("rgba", "RGBA"), ("luminance", "Y")], ids=["rgba", "mono"]
)
def test_stock_aovs_keep_their_names_and_their_digits(tmp_path, pixels, letters):
    first = scenes.PATH.replace("<integrator", '<integrator name="first"')
    second = '<integrator type="depth" name="second"/>'
    text = f'<string name="pixel_format" value="{pixels}"/>{scenes.BOX}'
    path = scenes.write_balls(tmp_path, aov(first + second), text)
    frame = FrameRenderer(path, spp=1).render()
    others = [f"second.{letter}" for letter in letters]
    assert list(frame.channels) == [*letters, *others, *AOV_NAMES]
    write_frame(tmp_path / "a.exr", frame, "half")
    stored_pixels, _ = stored(tmp_path / "a.exr")
    assert set(stored_pixels) == set(frame.channels)
    for name, values in stored_pixels.items():
        is_short = name[-1] in "RGBA"
        assert values.dtype == (np.float16 if is_short else np.float32), name
        rounded = 2**-11 if is_short else 0
        np.testing.assert_allclose(values, frame.channels[name], rtol=rounded)
    # from the near plane, where Mitsuba's rays start, to the position
    hit = frame.channels["dd.y.T"] > 0
    point = np.stack([frame.channels[f"pp.{c}"][hit] for c in "XYZ"])
    away = point - scenes.EYE[:, None]
    distance = np.linalg.norm(away, axis=0) * (1 - scenes.NEAR / -away[0])
    np.testing.assert_allclose(frame.channels["dd.y.T"][hit], distance, rtol=1e-5)
    other = frame.channels[others[0]][hit]
    np.testing.assert_allclose(other, distance, rtol=1e-5)


def test_seeds_have_32_bits(tmp_path):
    renderer = FrameRenderer(scenes.write_balls(tmp_path))
    assert renderer.render(seed=2**32 - 1).metadata["seed"] == "4294967295"
    for seed in (-1, 2**32):
        with pytest.raises(InputError) as caught:
            renderer.render(seed=seed)
        assert caught.value.where == "seed"


def test_aovs_alone_have_no_colour(tmp_path):
    frame = FrameRenderer(scenes.write_balls(tmp_path, aov())).render()
    assert list(frame.channels) == AOV_NAMES
    with pytest.raises(InputError, match=r"write .exr"):
        write_frame(tmp_path / "a.png", frame, "half")


def test_metadata_tell_camera_pose_and_origin(tmp_path):
    path = scenes.write_slab(tmp_path, fov=40)
    renderer = FrameRenderer(path, 0, 5, {"spp": "2"})
    write_frame(tmp_path / "a.exr", renderer.render(seed=3), "float")
    pixels, header = stored(tmp_path / "a.exr")
    assert {values.dtype for values in pixels.values()} == {np.dtype(np.float32)}
    digests = {
        name: hashlib.sha256((tmp_path / file).read_bytes()).hexdigest()
        for name, file in (("scene", "scene.xml"), ("box.safetensors",) * 2)
    }
    assert json.loads(header["digests"]) == digests
    assert json.loads(header["scene_parameters"]) == {"spp": "2"}
    expected = {"scene": "scene.xml", "spp": "5", "seed": "3", "variant": "llvm_ad_rgb"}
    assert {name: header[name] for name in expected} == expected
    assert json.loads(header["versions"]) == versions()
    read = mi.Bitmap(str(tmp_path / "a.exr")).metadata()
    for name in renderer.metadata(None, 3):
        assert read[name] == header[name]
    camera = json.loads(header["camera"])
    focal = 0.5 * scenes.WIDTH / np.tan(np.radians(20))
    assert camera["fx"] == pytest.approx(focal) == camera["fy"]
    assert (camera["cx"], camera["cy"]) == (scenes.WIDTH / 2, scenes.HEIGHT / 2)
    expected = scenes.opengl_pose(scenes.EYE) * [1, -1, -1, 1]
    np.testing.assert_allclose(camera["to_world"], expected, atol=1e-6)


def test_metadata_tell_the_distortion(tmp_path):
    metadata = FrameRenderer(scenes.write_lens(tmp_path)).render().metadata
    camera = json.loads(metadata["camera"])
    assert camera["fx"] == camera["fy"] == 20
    assert camera["k1"] == pytest.approx(-0.1)


@pytest.mark.parametrize(
    "write", [scenes.write_slab, scenes.write_balls, scenes.write_lens]
)
def test_poses_and_seeds_compile_nothing_after_the_first_frame(tmp_path, write):
    renderer = FrameRenderer(write(tmp_path), spp=2)
    poses = read_path(scenes.write_path(tmp_path, 4))
    renderer.render(poses[0], 0)
    for i in (1, 2, 3):
        with nothing_compiled():
            renderer.render(poses[i], i)


def test_a_pose_of_a_path_is_that_of_a_sensor(tmp_path):
    renderer = FrameRenderer(scenes.write_balls(tmp_path), spp=2)
    poses = read_path(scenes.write_path(tmp_path, 3))
    own = renderer.render(seed=1).channels
    moved = renderer.render(poses[2], 1).channels
    again = renderer.render(poses[0], 1)
    for name in "RGB":
        np.testing.assert_allclose(again.channels[name], own[name], atol=1e-5)
    pose = json.loads(again.metadata["camera"])["to_world"]
    np.testing.assert_allclose(pose, poses[0], atol=1e-8)
    # from the other side red is up and to the right
    red = np.argwhere(moved["R"] > 0.9).mean(axis=0)
    assert red[0] < scenes.HEIGHT / 2 and red[1] > scenes.WIDTH / 2


def test_route_is_driven_at_its_speed(tmp_path):
    route = Route.from_file(scenes.write_route(tmp_path), "straight")
    mount = CameraMount(1.5, 0.25, 0.0)
    poses = route_path(route, mount, fps=10)
    assert len(poses) == 6  # 2 m at 0.4 m a frame
    positions = poses[:, :3, 3]
    np.testing.assert_allclose(positions[:, 1], -0.75 + 0.4 * np.arange(6), atol=1e-12)
    np.testing.assert_allclose(positions[:, [0, 2]], [[5, 1.5]] * 6, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 2], [[0, 1, 0]] * 6, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 0], [[1, 0, 0]] * 6, atol=1e-12)
    with pytest.raises(InputError, match="fps: 0"):
        route_path(route, mount, fps=0)


def test_many_samples_are_the_mean_of_passes(tmp_path, monkeypatch):
    path = scenes.write_slab(tmp_path, fov=60)
    monkeypatch.setattr(film, "_MAX_RAYS", 4 * scenes.WIDTH * scenes.HEIGHT)
    renderer = FrameRenderer(path, spp=10)
    frame = renderer.render(seed=2)
    assert frame.metadata["spp"] == "12"  # three passes of four
    seeds = [int(s) for s in np.random.SeedSequence(2).generate_state(3)]
    scene = load_scene(path, layers=True)
    images = [np.array(mi.render(scene, spp=4, seed=s)) for s in seeds]
    for i, name in enumerate("RGBA"):
        expected = np.mean([image[..., i] for image in images], axis=0)
        np.testing.assert_allclose(frame.channels[name], expected, rtol=1e-5)
    moments = [np.nan_to_num(m[..., 4], posinf=0) * m[..., 3] for m in images]
    opacity = np.mean([image[..., 3] for image in images], axis=0)
    hit = opacity > 0
    assert hit.any() and not hit.all()
    depth = np.mean(moments, axis=0)[hit] / opacity[hit]
    np.testing.assert_allclose(frame.channels["Z"][hit], depth, rtol=1e-5)
    assert np.isinf(frame.channels["Z"][~hit]).all()


def test_depths_of_passes_count_by_the_opacity_of_fields(tmp_path, monkeypatch):
    """Where the film's alpha is 1, since there is a sky behind."""
    rgba = f'<string name="pixel_format" value="rgba"/>{scenes.BOX}'
    behind = '<integrator type="path"/>', '<emitter type="constant"/>'
    path = scenes.write_slab(tmp_path, rgba, 60, *behind)
    monkeypatch.setattr(film, "_MAX_RAYS", 4 * scenes.WIDTH * scenes.HEIGHT)
    channels = FrameRenderer(path, spp=10).render().channels
    assert (channels["A"] == 1).all() and channels["opacity"].max() < 1
    np.testing.assert_allclose(channels["Z"], channels["box.Z"], rtol=1e-5)


def test_layers_are_left_out_where_the_scene_says_so(tmp_path):
    off = '<boolean name="aovs" value="false"/>'
    path = scenes.write_slab(tmp_path, inside=off)
    assert "".join(FrameRenderer(path).render().channels) == "RGB"


def test_fields_in_a_stock_integrator_have_no_layers(tmp_path):
    inside = '<integrator type="aov"><string name="aovs" value="dd:depth"/>'
    path = scenes.write_slab(tmp_path)
    text = path.read_text().replace("<integrator", f"{inside}<integrator", 1)
    path.write_text(text.replace("</integrator>", "</integrator></integrator>", 1))
    frame = FrameRenderer(path, spp=4).render()
    assert list(frame.channels) == [*"RGB", "dd.T"]
    write_frame(tmp_path / "a.exr", frame, "half")


@pytest.mark.parametrize(("suffix", "value"), [("exr", np.nan), ("png", np.inf)])
def test_what_is_not_finite_is_refused_by_channel(tmp_path, suffix, value):
    frame = FrameRenderer(scenes.write_balls(tmp_path)).render()
    frame.channels["G"][2, 3] = value
    path = tmp_path / f"a.{suffix}"
    with pytest.raises(InputError, match="channel 'G'") as caught:
        write_frame(path, frame, "half")
    assert caught.value.where == str(path)
    assert not path.exists()


# Views


def _renderer(**keys: bool) -> ViewRenderer:
    """Show a ball through an integrator that can or cannot be recorded."""

    class Counting(mi.SamplingIntegrator):
        """Paints what a ray hits, and counts how often it is traced."""

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.gain, self.traced = mi.Float(1.0), 0
            self.reads = props.get("reads", False)
            self.fails = props.get("fails", False)

        def sample(
            self, scene: Any, _: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float]]:
            self.traced += 1
            if self.fails:
                raise RuntimeError("of the plugin's own")
            gain = self.gain[0] if self.reads else self.gain
            hit = scene.ray_test(ray, active)
            return mi.Color3f(dr.select(hit, gain, 0)), hit, []

    mi.register_integrator("counting", Counting)
    ball = {"type": "sphere", "center": [0, 0, 4]}
    integrator = {"type": "counting", **keys}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "ball": ball})
    return ViewRenderer(scene, from_fov(24, 16, 40.0))


def _means(renderer: ViewRenderer) -> list[float]:
    """Render four views, each with twice the gain of the one before."""
    means = []
    for seed in range(4):
        renderer.scene.integrator().gain = mi.Float(2.0**seed)
        means.append(float(renderer.render(np.eye(4), 4, seed).rgb.mean()))
    return means


def test_launches_are_recorded_unless_an_integrator_reads_values() -> None:
    """What a plugin holds may change between views, although it is not traced again."""
    recorded, traced = _renderer(), _renderer(reads=True)
    means = _means(recorded)
    np.testing.assert_allclose(means, means[0] * 2.0 ** np.arange(4), rtol=0.1)
    assert means[0] > 0.05
    assert _means(traced) == means
    counts = [item.scene.integrator().traced for item in (recorded, traced)]
    assert counts[0] <= 2 and counts[1] >= 4


def test_no_mean_of_a_bitmap_is_left_to_the_recording() -> None:
    """It would evaluate all of them in one kernel, in an order of the process."""
    image = mi.TensorXf(np.full((4, 4, 3), 0.25))
    texture = {"type": "bitmap", "data": image, "raw": True}
    bsdf = {"type": "diffuse", "reflectance": texture}
    ball = {"type": "sphere", "center": [0, 0, 4], "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    nodes = mi.traverse(scene).hierarchy
    (bitmap,) = [node for node in nodes if node.class_name().startswith("Bitmap")]
    assert bitmap.mean().state == dr.VarState.Unevaluated
    ViewRenderer(scene, from_fov(24, 16, 40.0))
    assert bitmap.mean().state == dr.VarState.Evaluated


def test_errors_of_an_integrator_are_its_own() -> None:
    """Not those of a recording."""
    with pytest.raises(RuntimeError) as caught:
        _renderer(fails=True).render(np.eye(4), 4, 0)
    causes = str(caught.value), str(caught.value.__cause__)
    assert any("of the plugin's own" in text for text in causes)
    assert "record" not in causes[0]
