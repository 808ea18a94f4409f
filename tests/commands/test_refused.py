"""What commands refuse: code 2, one line on standard error, and nothing written."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import mitsuba as mi
import pytest
from support.files import folders
from support.worlds import films
from support.worlds.fields import small_ngp
from support.worlds.places import PAINTED, ROUTES, STILL, small_grid

from mi_nerfattack import cli
from mi_nerfattack.fields import save_field
from mi_nerfattack.io import files
from mi_nerfattack.policy.pilotnet import PilotNet
from mi_nerfattack.scenes import bundled

CODE = "--set policy.trust_code=true"
PLACE = "--environments mitsuba --scene painted.xml --routes-file routes.json --runs 2"
GOOD = "good.safetensors"
CAR = "car drive --policy expert --set calibration=racecar-j"
SHORT = {
    "@bad": f"evaluate nan.py:Bad {CODE} {PLACE}",
    "@car": f"{CAR} --set tracker=vicon:127.0.0.1",
    "@evaluate": f"evaluate still.py:drive --set policy.kind=callable {CODE} {PLACE}",
    "@good": f"--field {GOOD} --object {GOOD} --routes-file routes.json",
    "@place": PLACE,
    "@room": bundled("room").as_posix(),
    "@train": "train -o policy.safetensors --data data",
}
ROWS = r"""
atack scenario.toml => 'atack': is no command; did you mean 'attack'\?
retarin => 'retarin': is no command; did you mean 'retrain'
drive => 'drive': is no command; did you mean 'car drive'\?
nonsense => 'nonsense': is no command; one of doctor, demo,
render frame none.xml -o a.exr => none.xml: does not exist
render frame bundled:none.xml -o a.exr => none.xml: not a bundled file
render frame path.json -o a.exr => path.json: .*XML
render frame scene.xml -o a.exr --sensor 1 => no sensor 1; it has 0 \(eye3\)
render frame scene.xml -o a.exr --sensor -1 => no sensor -1
render frame scene.xml -o a.exr --spp 0 => spp: 0; at least 1
render frame scene.xml -o a.exr --seed -1 => seed: -1
render frame scene.xml -o a.exr --size 0 6 => at least 1 x 1
render frame scene.xml -o a.exr --size 90000 90000 => at most 134217728 pixels
render frame scene.xml -o a.exr --set width=3 => width=3.*no <default>
render frame scene.xml -o a.exr --set spp => --set spp: needs KEY=VALUE
render frame scene.xml -o a.exr --set spp=x => could not parse integer
render frame scene.xml -o none/a.exr => none/a.exr: does not exist
render frame scene.xml -o . => one frame is written as .exr or .png
render frame scene.xml -o a.mp4 => a.mp4: one frame is .*'mi-nerfattack render path'
render frame no_sensor.xml -o a.exr => has no sensor
render frame no_integrator.xml -o a.exr => has no integrator
render frame no_file.xml -o a.exr => box.safetensors: does not exist; check
render frame bright.xml -o a.exr => channel 'R' reaches 100000.*--precision float
render path scene.xml -o a --route u --path path.json => --path, --route: give one
render path scene.xml -o a.exr --path path.json => a.exr: one image cannot hold
render path scene.xml -o a.avi --path path.json => a.avi: unknown suffix '.avi'
render path scene.xml -o out --path none.json => none.json: does not exist
render path scene.xml -o out --path scene.xml => scene.xml: line 1.*valid JSON
render path scene.xml -o out --path routes.json => routes.json: frames: missing
render path scene.xml -o out --path words.json => frames\[0\].*not a matrix of numbers
render path scene.xml -o out --path rows.json => frames\[0\].*needs 4 x 4
render path scene.xml -o scene.xml/a --path path.json => not a folder
render path scene.xml -o a.mp4 --fps 0 --path path.json => fps: 0
render path scene.xml -o out --route straight => --route, --routes-file: one without
render path scene.xml -o out --route u --routes-file routes.json => no route 'u'
@train --preset desktop => preset: 'desktop'; one of laptop
@train --frames moon 3 => environment: 'moon'; one of surrogate
@train --scene @room/scene.xml --routes-file @room/routes.json => no field; make one
@train --scene none.xml @good => none.xml: does not exist
@train --scene mine.xml => --scene: mine.xml; it needs its --routes-file
@train --skies dusk => sky: 'dusk'
@train --more empty => no frames in it
@train --workers 0 => workers: 0
@train --validate-every 0 => validate_every: 0;
@train --preset intersection --dagger-rounds 2 => without dagger_frames
@train --frames carla 64 => drive in CARLA with 'mi-nerfattack evaluate'
@train --validate-in carla => environment: 'carla'; a server answers to one
@train --frames replay 64 => a recording does not answer to a policy
@evaluate --runs 0 => EvaluateSettings.runs: 0
@evaluate --workers 0 => workers: 0
@evaluate --environments moon => --environments: 'moon'; one of
@evaluate --environments replay => --environments: 'replay'
@evaluate --environments mitsuba mitsuba => each once
@evaluate --routes loop => no route 'loop'; it has 'straight'
@evaluate --conditions night => --conditions: 'night'
@evaluate --conditions day:bright => --conditions: 'day:bright'
@evaluate --conditions blur:1 => give other conditions to transfer
@evaluate --spp 0 => spp: 0
@evaluate --objects -1 => EvaluateSettings.objects: \(-1,\)
@evaluate --scale 1 2 3 => --scale: 1.0 2.0 3.0; least and most
@evaluate --scale 2 1 => 2.0 to 1.0; the smaller comes first
@evaluate --place moon => place: 'moon'
@evaluate --scene none.xml => none.xml: does not exist
@evaluate --routes-file none.json => none.json: does not exist
@evaluate --object none.safetensors => none.safetensors: does not exist
@evaluate --output no/folder/card.json => no/folder/card.json
@evaluate --set policy.goal.kind=integer => still.py:drive: policy.goal:
@evaluate --drives scene.xml --horizon 3 => scene.xml: 
@evaluate --routes-file narrow.json => route 'straight': its lane is 1.7 m wide
@evaluate --routes-file short.json --object good.safetensors => 'straight': places for 0
evaluate nothing.safetensors @place => nothing.safetensors: does not exist
evaluate nothing.toml @place => nothing.toml: does not exist
evaluate empty.toml @place => empty.toml: has no section \[policy\]
evaluate no_policy.toml @place => no_policy.toml: policy: is missing next to \[scene\]
evaluate key.toml @place => key.toml: policy.colour
evaluate table.toml @place => table.toml: vehicles: has no effect without \[scene\];
evaluate noise.bin @place => noise.bin: .*its suffix tells no kind
evaluate noise.safetensors @place => noise.safetensors: 
evaluate damaged.safetensors @place --page out => damaged.json
evaluate car.toml @place => the car of the place takes rad, .* gives rad/s
evaluate angle.toml @place => the car of the place takes rad/s, .* gives rad;
evaluate lag.toml @place => lag.toml: vehicle.lag: unknown key
evaluate flat.toml --environments mitsuba => objects.0: a flat object without a file
asset flat patch --width-m 1 --height-m 4 -o a.npz => ends in .safetensors
asset flat patch --width-m 1 --height-m 0 -o a.safetensors => height_m: 0
asset flat patch --width-m 1 --height-m 1 --picture no.png -o a.safetensors => no.png
evaluate camera.toml @place => camera.toml: camera.width: .*greater
evaluate custom.toml @place --environments mujoco => mujoco drives a car with wheels
evaluate --place room --environments mitsuba => the car .* takes rad, .* gives rad/s
@bad => it must be finite
car drive => --policy: none; give a file, expert, or http://HOST:PORT
car drive --policy gone.safetensors => gone.safetensors
car drive --policy http://127.0.0.1:1 --simulated => in which unit http://127.0.0.1:1
car drive --policy expert --simulated --set control_unit=rad/s => expert says 'rad'
car drive --policy expert => tracker: none; give vicon:ADDRESS
car drive --policy http://a:b@c --simulated --set control_unit=rad => has a name or pass
car drive --policy expert --set speed_ms=nan => drive.speed_ms
@car --set overlay=box.safetensors => overlay: nobody says where the camera is
@car --set camera=webcam => camera 'webcam': must be zed:
car serve --listen 0.0.0.0:8000 => 0.0.0.0:8000: is not this computer alone
car serve --listen here => here:8000: is not this computer alone
car serve --listen a:b => is no place to listen
car serve --token-file token => a token of 5 characters; at least 16
car serve --size 0 4 => --size: \(0, 4\); width and height, 1 or more
car serve none.safetensors => none.safetensors
car calibrate /dev/none -o scene.xml => exists; choose another
car calibrate /dev/none -o b --speed-ms 0 => --speed-ms: 0.0; more than 0.195, at
car calibrate /dev/none -o b --distance-m 50 => --distance-m: 50.0; .* at most 5
check grid.toml --workers 0 => --workers: 0; more than 0
export mesh none.safetensors -o out.glb => none.safetensors: does not exist
export mesh ngp.safetensors -o out.glb => is a ngp_field; a grid_field
export mesh good.safetensors -o out.obj => give a file that ends in .glb
export mesh good.safetensors -o no/a.glb => does not exist
export mesh good.safetensors -o out.glb --height-m 1 => place a mesh; give --mesh
export mesh good.safetensors -o out.glb --mesh none.glb => none.glb: does not
export faces good.safetensors -o scene.xml => give a folder's name
export faces good.safetensors -o out.glb => give a folder's name
fit empty -o f.safetensors => no posed images; looked for transforms.json
fit posed -o f.safetensors => transforms.json: 1 of 3 frames have no image, first './i
"""
FLAT = """\
name = "flat"
policy.file = "bundled:policy/pilotnet.safetensors"
[scene]
field = "bundled:intersection/field.safetensors"
deployment = "bundled:intersection/scene.xml"
routes = "bundled:intersection/routes.json"
route = "right"
[[objects]]
kind = "patch"
id = "patch"
width_m = 1
height_m = 2
position_m = [0, 0, 0]
"""
NAN = """\
from torch import nn
class Bad(nn.Module):
    def forward(self, image):
        return image.mean((1, 2, 3)) * float('nan')
"""
TABLES = '[policy]\nfile = "net.safetensors"\n[vehicle]\nkind = '
TEXTS = {
    "damaged.json": "{",
    "words.json": '{"frames": [{"transform_matrix": [["a"]]}]}',
    "rows.json": '{"frames": [{"transform_matrix": [[1, 0, 0, 0]]}]}',
    "car.toml": f'{TABLES}"ackermann"\n',
    "camera.toml": '[policy]\nfile = "a.pt2"\n[camera]\nwidth = 0\n',
    "angle.toml": '[policy]\nfile = "a.pt2"\ncontrol_unit = "rad"\n',
    "lag.toml": f'{TABLES}"ackermann"\nlag = 1\n',
    "custom.toml": f'{TABLES}"custom"\nfunction = "a.py:car"\ncontrol_limit = 1.0\n',
    "painted.xml": PAINTED,
    "still.py": STILL,
    "nan.py": NAN,
    "noise.bin": "noise",
    "token": "short",
    "noise.safetensors": "noise",
    "flat.toml": FLAT,
    "empty.toml": "",
    "no_policy.toml": "[scene]\n[camera]\n",
    "grid.toml": 'scenario = "flat.toml"\n',
    "key.toml": '[policy]\nfile = "still.py:drive"\ncolour = "red"\n',
    "table.toml": '[policy]\nfile = "a.pt2"\n[vehicles]\n',
}


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    """A folder of files that are right or wrong, to which no row adds."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("world")
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    for name in ("net", "damaged"):
        PilotNet(1, 0.6, "rad/s").save(folder / f"{name}.safetensors")
    films.write_slab(folder).rename(folder / "no_file.xml")
    (folder / "box.safetensors").unlink()
    films.write_scene(folder, films.PATH, "no_sensor.xml")
    films.write_scene(folder, films.sensor(), "no_integrator.xml")
    scene = films.write_balls(folder)
    (folder / "bright.xml").write_text(scene.read_text().replace("1,0,0", "1e5,0,0"))
    films.write_path(folder, name="path.json")
    line = ROUTES["straight"]
    files.write_json(folder / "routes.json", ROUTES)
    files.write_json(folder / "narrow.json", {"straight": line | {"lane_width_m": 1.7}})
    short = line | {"points_m": [[0, 0], [5, 0]]}
    files.write_json(folder / "short.json", {"straight": short})
    save_field(folder / "good.safetensors", small_grid())
    save_field(folder / "ngp.safetensors", small_ngp())
    (folder / "empty").mkdir()
    (folder / "posed").mkdir()
    folders.instant_ngp(folder / "posed")
    (folder / "posed/images/1.jpg").unlink()
    return folder


def files_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("row", ROWS.strip().split("\n"))
def test_a_refusal_is_one_line_and_writes_nothing(world, row, monkeypatch, capsys):
    line, _, message = row.partition(" =>")
    for short, words in SHORT.items():
        line = line.replace(short, words)
    monkeypatch.chdir(world)
    before = files_in(world)
    code = cli.main(shlex.split(line))
    out, err = capsys.readouterr()
    assert code == 2 and (not out or "car drive" in line), err  # states what it drives
    *others, last = err.splitlines()
    assert re.match(rf"mi-nerfattack: error: .*{message.strip()}", last), err
    assert not others or others[0].startswith("drives are kept in"), err
    assert files_in(world) == before
