"""Loading Mitsuba scenes: parameters, film sizes, and messages in one line."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.render.pathtrace.load import load_scene, scene_files

pytestmark = pytest.mark.usefixtures("variant")

CAMERA = """
<sensor type="perspective">
    <float name="fov" value="50"/> <string name="fov_axis" value="y"/>
    <film type="hdrfilm">
        <integer name="width" value="$width"/> <integer name="height" value="6"/>
    </film>
</sensor>"""
PLACES = "".join(f"property float {axis}\n" for axis in "xyz")
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
HEADER = f"ply\nformat ascii 1.0\nelement vertex 3\n{PLACES}{FACES}"
TRIANGLE = HEADER + "0 0 2\n1 0 2\n0 1 2\n3 0 1 2\n"
SHAPE = '<shape type="ply"><string name="filename" value="{}"/>{}</shape>'


def write(folder, body, root="scene"):
    path = folder / "scene.xml"
    path.write_text(f'<{root} version="3.0.0">{body}</{root}>')
    return path


def test_parameters_and_size_are_those_of_a_file_that_has_them(tmp_path):
    default = '<default name="width" value="8"/>'
    path = write(tmp_path, default + CAMERA)
    assert list(load_scene(path).sensors()[0].film().size()) == [8, 6]
    wide = load_scene(path, {"width": "12"}).sensors()[0]
    assert list(wide.film().size()) == [12, 6]
    sized = load_scene(path, size_px=(12, 6)).sensors()[0]
    # fov_axis is y: the field of view in x follows from the new aspect
    x_fov = np.degrees(2 * np.arctan(2 * np.tan(np.radians(25))))
    for sensor in (wide, sized):
        assert mi.traverse(sensor)["x_fov"][0] == pytest.approx(x_fov, rel=1e-5)


def test_a_roof_of_the_grounds_material_keeps_the_sky_out(tmp_path):
    slab = """<shape type="rectangle"><ref id="matt"/><transform name="to_world">
        <scale value="20"/><translate z="{}"/></transform></shape>"""
    path = write(
        tmp_path,
        """<integrator type="path"><integer name="max_depth" value="2"/></integrator>
        <emitter type="constant"/><bsdf type="twosided" id="matt"><bsdf type="diffuse">
        <rgb name="reflectance" value="0.4"/></bsdf></bsdf>"""
        + slab.format(0)
        + slab.format(6),
    )
    scene = load_scene(path)
    assert list(scene.bbox().max) == [20, 20, 6]
    down = mi.RayDifferential3f(mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1 << 15)
    radiance = scene.integrator().sample(scene, sampler, down)[0].numpy().mean()
    half = 20 / 6  # of the roof's edge, in heights
    reach = np.hypot(1, half)
    roof = 4 / np.pi * half / reach * np.arctan(half / reach)  # share of the sky
    assert radiance == pytest.approx(0.4 * (1 - roof), rel=0.05)


def test_files_are_found_beside_the_scene_and_the_resolver_is_put_back(tmp_path):
    (tmp_path / "quad.ply").write_text(TRIANGLE)
    before = list(mi.file_resolver())
    scene = load_scene(write(tmp_path, SHAPE.format("quad.ply", "")))
    assert list(scene.bbox().max) == [1, 1, 2]
    with pytest.raises(InputError):
        load_scene(write(tmp_path, SHAPE.format("none.ply", "")))
    assert list(mi.file_resolver()) == before


def test_all_files_that_a_scene_names_are_listed(tmp_path):
    (tmp_path / "parts").mkdir()
    for name in ("quad.ply", "parts/quad.ply", "sky.exr", "unused.ply"):
        (tmp_path / name).write_text(TRIANGLE)
    (tmp_path / "eta.spd").write_text("400 1\n700 1\n")
    (tmp_path / "parts" / "inner.xml").write_text(
        f'<scene version="3.0.0">{SHAPE.format("parts/quad.ply", "")}</scene>'
    )
    metal = '<bsdf type="conductor"><spectrum name="eta" filename="eta.spd"/></bsdf>'
    body = (
        '<default name="mesh" value="quad.ply"/><default name="all" value="parts"/>'
        '<include filename="parts/inner.xml"/>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        + SHAPE.format("$mesh", metal)
        + SHAPE.format("missing.ply", "").replace("<shape ", '<shape id="none" ')
    )
    paths = scene_files(write(tmp_path, body))
    names = {path.relative_to(tmp_path.resolve()).as_posix() for path in paths}
    xml = {"scene.xml", "parts/inner.xml"}
    assert names == {*xml, "quad.ply", "parts/quad.ply", "sky.exr", "eta.spd"}
    assert len(paths) == len(names)


FIELD = """<integrator type="field_integrator"><volume type="grid_field">
<string name="filename" value="none.safetensors"/></volume></integrator>"""
DEPTH = (
    """<integrator type="path"><integer name="max_depth" value="$d"/></integrator>"""
)


FILM = CAMERA.replace("$width", "8")
CROP = FILM.replace("</film>", '<integer name="crop_width" value="2"/></film>')


@pytest.mark.parametrize(
    ("body", "options", "message"),
    [
        ("<oops", {}, "XML file"),
        ('<shape type="nope"/>', {}, 'Plugin "nope" not found'),
        (DEPTH, {}, "undefined parameter: \\$d; give it a value"),
        (DEPTH.replace("$d", "x"), {}, "could not parse integer value"),
        (FIELD, {}, "none.safetensors: does not exist; check the path"),
        ('<bsdf type="diffuse"><float name="x" value="1"/></bsdf>', {}, '"x"'),
        (FILM, {"parameters": {"width": "3"}}, "width=3.*no <default> of this name"),
        (CROP, {"size_px": (4, 3)}, "crop window"),
        (FILM + SHAPE.format("/dev/null", ""), {}, "is a pipe or a device"),
    ],
)
def test_refusals_are_one_line_with_the_file(tmp_path, body, options, message):
    path = write(tmp_path, body)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(path, **options)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text and "Traceback" not in text and ".cpp" not in text


def test_what_is_no_scene_is_refused(tmp_path):
    root = tmp_path / "scene.xml"
    root.write_text('<bsdf version="3.0.0" type="diffuse"/>')
    for path in (tmp_path / "none.xml", tmp_path, root):
        with pytest.raises(InputError) as caught:
            load_scene(path)
        assert caught.value.where == str(path)
    with pytest.raises(InputError, match="none.xml: does not exist"):
        scene_files(tmp_path / "none.xml")
    with pytest.raises(InputError, match="size: 0 x 3 px; at least 1 x 1"):
        load_scene(write(tmp_path, FILM), size_px=(0, 3))
