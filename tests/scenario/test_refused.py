"""What a scenario file may not say: where each refusal points, and what would help."""

from __future__ import annotations

import re

import pytest
from support.files.runs import HEAD, write_named_files

from mi_nerfattack.errors import InputError
from mi_nerfattack.scenario.scenario import load_scenario

# Lines that follow HEAD, or one of its lines -> another; => what the message must say.
ROWS = r"""
name = "test" -> name = "test"; vehicle = { substeps = 0 } => :2: vehicle.substeps: .*1
name = "test" -> attack.method.max_iterations = 0; name = "a" => :1: attack.method.max
[policy.preprocess]; mean = [; 0.5,; "a",; ] => :14: policy.preprocess.mean
[attack.method]; max_iterations = 3; mean.x = 1 => :15: attack.method.mean: unknown
[attack.method]; mean.x = 1; seed = 3; mean.y = 1 => :14: attack.method.mean: unknown
[mean.x]; y = 1 => :13: mean: unknown
[camera]; fx = 200; fov_x_deg = 70 => camera.fx: .*fov_x_deg
[camera]; fx = 200; fov_x_deg = 90.0 => camera.fx: .*fov_x_deg
[camera]; fy = 200 => camera.fy: .*without fx
[camera]; fx = 0 => camera.fx: .*greater
[camera]; k1 = -3 => camera.k1: .*folds
[camera]; yaw_deg = 200 => camera.yaw_deg: .*180
[camera]; name = "front" => camera.name: unknown key; .*left_m
[[cameras]]; width = 8 => :13: cameras.0.name: is missing
[[cameras]]; name = "a b" => :14: cameras.0.name: .*pattern
[[cameras]]; name = "a"; [camera]; width = 8 => cameras: stands beside .camera.
[[cameras]]; name = "a"; [[cameras]]; name = "a" => cameras: .*must differ
[attack.method]; max_iteratons = 3 => :14: attack.method.max_iteratons: .*max_iterations
[attack.method]; max_iterations = 0 => method.max_iterations: .*0
[attack.method]; max_iterations = "3" => method.max_iterations: .*integer
[attack.method]; opening = "sides"; max_iterations = 15 => opening_share: .* = 16 or
[attack.method]; opening = "left" => method.opening: .*restarts
[attack.method]; kind = "open_loop"; [attack]; attached = true => attached: .*open_l
[attack.method]; follow = "in_turns" => attack.attached: .*in_turns
[[objects]]; scale = -2.0 => :12: objects.1.scale: .*greater.*-2
[[objects]]; scale = nan => objects.1.scale: .*finite
position_m = [1.0, 2.0, 0.0] -> => :7: objects.0.position_m: is missing[^\n]*$
route = "lane" -> => :2: scene.route: is missing
[polisy] => :13: polisy: unknown key
[[objects]]; id = "hydrant"; field = "a"; position_m = [0, 0, 0] => hydrant.*differ
[[objects]]; id = "scene1"; field = "a"; position_m = [0, 0, 0] => scene1.*layers
[[objects]]; id = "background"; field = "a"; position_m = [0, 0, 0] => background.*lay
[[objects]]; id = "b"; colour = 1 => objects.1.colour: unknown key; .*"field": .*scale
[[objects]]; id = "b"; width_m = 1 => objects.1.width_m: .*"billboard" or "patch"
[[objects]]; kind = "wall"; id = "b" => objects.1.kind: is 'wall'; one of .*billboard
[[objects]]; kind = "patch"; id = "b"; width_m = 1 => objects.1.height_m: is missing
[[objects]]; kind = "patch"; id = "b"; width_m = 1; height_m = 2 => 1.position_m: is mi
[[objects]]; kind = "patch"; id = "b"; scale = 2 => objects.1.scale: .*"patch"
[[objects]]; kind = "billboard"; id = "b"; width_m = 1; height_m = 9; pixels_per_m = 99
  => :16: objects.1.pixels_per_m: .*at most 256
[attack => scenario.toml: .*valid TOML
[attack.freedom]; lowest = 0.9; highest = 0.2 => freedom.lowest: .*0.2
[attack.freedom]; fixed_m = [[[0, 0, 0], [0, 1, 1]]] => fixed_m: .*lower < upper
[attack.freedom]; gamut = "none.icc" => freedom.gamut: .*none.icc
[attack.freedom]; pose_limit_m = 2.0 => pose_limit_m: .*both
[attack.freedom]; kind = "pose"; learning_rate = 0.2 => learning_rate: .*pose
[attack.adjoint]; segment = 8 => adjoint.segment: .*checkpointed
[drive]; covariance = [[1, 0, 0], [0, 1, 0.5], [0, 0, 1]] => covariance: .*symmetric
[drive]; covariance = [[1, 2, 0], [2, 1, 0], [0, 0, 1]] => covariance: .*eigenvalue -1;
[drive]; lateral_sd_m = 0.2; covariance = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
  => :15: drive.covariance: .*lateral_sd_m
[drive]; length_m = 3.0; horizon = 60 => drive.horizon: .*length_m
[vehicle]; wheelbase_m = 3.0 => vehicle.wheelbase_m: .*set kind to "ackermann"
[vehicle]; kind = "bicycle"; max_heading_rate = 3.0 => max_heading_rate: .*"dubins"
[vehicle]; kind = "custom"; control_limit = 1.0 => :13: vehicle.function: is missing
[vehicle]; kind = "custom"; function = "a.py:car" => vehicle.control_limit: is missing
[vehicle]; kind = "custom"; function = "a.py" => vehicle.function: .*FILE.py:NAME
[vehicle]; kind = "custom"; state_size = 2 => vehicle.state_size: .*equal to 3
[vehicle]; kind = "custom"; function = "a.py:car"; control_limit = 1.0; state_size = 5
  rest_state = [5.0] => vehicle.rest_state: has 1 numbers; .* 2 or none
[vehicle]; kind = "custom"; function = "a.py:car"; control_limit = 1.0
  control_unit = "rad" => vehicle.wheelbase_m: is missing; control_unit = "rad" needs it
[vehicle]; kind = "custom"; function = "a.py:car"; control_limit = 1.6
  control_unit = "rad"; wheelbase_m = 2.7 => vehicle.control_limit: .*below pi / 2
[vehicle]; kind = "custom"; function = "a.py:car"; control_limit = 1.0
  control_unit = "other"; [policy]; file = "a.pt"; control_unit = "rad"
  => vehicle.kind: custom takes other, and a.pt gives rad; .*control_scale
[vehicle]; kind = "kinematic_single_track"; [policy]; file = "a.pt"
  => policy.output: .*gives 1, .*takes 2: steering, acceleration
[policy]; file = "a.pt"; output = [0, 1] => policy.output: .*gives 2, .*1: heading_rate
[vehicle]; kind = "ackermann"; wheelbase_m = 0.26; [policy]; file = "a.pt"
  [policy.trajectory]; times_s = [1.0]; controls = ["steering"]
  => policy.trajectory.wheelbase_m: is 2.7; the vehicle's is 0.26
[policy]; file = "a.pt"; inputs = ["imaeg"]
  => policy.inputs: 'imaeg'; each of image, speed
[policy]; file = "a.pt"; [policy.trajectory]; times_s = [1.0]; speed_gain = 2.0
  => trajectory.speed_gain: has no effect on heading_rate
[policy]; file = "a.pt"; output = [0, -1] => policy.output.1: .*equal to 0
[vehicle]; delay_steps = -1 => vehicle.delay_steps: .*0
[vehicle]; kind = "ackermann_rate"; steer_time_s = 0.03; substeps = 1
  => :15: vehicle.steer_time_s: .* rk4: .* raise substeps
[deployment]; kind = "gazebo" => deployment.kind: is 'gazebo'; one of mitsuba, .*replay
[deployment]; kind = "replay" => deployment.recording: is missing
[deployment]; kind = "carla"; objects = "built-in" => objects: has no meaning
[deployment]; spp = 0 => deployment.spp: .*greater
[deployment]; sky = "night" => deployment.sky: .*'day'
[deployment]; name = "a/b" => deployment.name: .*match
[deployment]; name = "surrogate" => deployment: .*surrogate.*a name of its own
[[deployment]]; [[deployment]] => deployment: .*\['mitsuba', 'mitsuba'\]; give each
[[deployment]]; [[deployment]]; sky = 1 => :15: deployment.1.sky
[vehicle]; kind = "custom"; function = "car.py:car"; control_limit = 1.0
  [deployment]; kind = "mujoco" => mujoco drives a car with wheels.*take mitsuba
[[objective.term]]; kind = "lateral" => :14: objective.term.0.kind: .*cross_track
[[objective.term]]; knd = "heading" => :14: objective.term.0.knd: unknown .*rounding_m
[[objective.term]]; kind = "target_path" => :13: objective.term.0.target: is missing
[[objective.term]]; target = "t.json" => :14: .*0.target: .*kind = "cross_track"
[[objective.term]]; kind = "function"; function = "f.txt:g" => :15: .*.*f.txt:g
[[objective.term]]; softness_m = 0.1 => softness_m: .*set kind to "departure_time"
[[objective.term]]; kind = "departure_time"; weights.kind = "end"
  => :15: objective.term.0.weights: has no meaning .*softness_m
[[objective.term]]; weights = { kind = "end", last_s = 1.0 }
  => :14: objective.term.0.weights.last_s: .*kind = "end", which allows kind;
[[objective.term]]; weights = { kind = "last" } => :14: .*last_s: is missing.*"last"
[[objective.term]]; weights = { kind = "listed", listed_weights = [1.0, nan] }
  => objective.term.0.weights.listed_weights.1: .*finite
[objective.reduction]; fraction = 0.5 => fraction: .*set kind to "cvar"
[objective.reduction]; kind = "cvar" => reduction.fraction: is missing
[objective.reduction]; kind = "cvr" => :14: objective.reduction.kind: is 'cvr'.*"cvar"
[[objective.term]]; weight = 2.0; [[objective.term]]; last_s = 1 => :16: .*term.1.last_s
[[objective.term]]; [[objective.term]]; kind = "function" => :14: .*term.1.function: is
[[objective.term]]; reduction.kind = "mean" => term.0.reduction: unknown key
[policy]; file = "net.bin" => :12: policy.file: net.bin: .*policy.kind
[policy]; file = "mypkg.policy:Net" => FILE.py:NAME
[policy]; file = "net.py" => FILE.py:NAME
[policy]; kind = "http"; file = "net.onnx"
  => policy.url: is missing(?s:.*)policy.file: has no meaning
[policy]; kind = "onnx"; url = "http://x" => policy.url: .*; set kind to "http"
[policy]; url = "ftp://x" => policy.url: 'ftp://x'; must be http
[policy]; url = "http://x"; batch = 1 => policy.batch: .*http
[policy]; file = "a.pt"; url = "http://x" => policy.file: give either
[policy]; file = "a.pt"; weights_file = "w.pt" => policy.weights_file: .*torchscript
[policy]; file = "a.pt"; goal.kind = "one_hot" => policy.goal.count: is missing
[policy]; file = "a.pt"; goal.count = 2 => policy.goal.kind: is missing; one of
[policy]; file = "a.pt"; kind = "keras" => policy.kind: is 'keras'
[policy]; file = "a.pt"; control_scale = 0.0 => policy.control_scale: .*0
[policy]; file = "a.pt"; control_unit = "rad" => kind: dubins takes rad/s, .* gives rad;
[policy]; file = "a.pt"; control_unit = "deg" => policy.control_unit: .*'rad'.*'other'
[policy]; file = "a.pt"; preprocess = { resize = [1, 2] } => resize: .*allowed: crop_px
[policy]; file = "a.pt"; [policy.preprocess]; crop_px = [1, 2, 3, 4]
  crop_fraction = [0.1, 0.0, 0.0, 0.0] => crop_fraction: .*beside crop_px
[policy]; kind = "onnx" => :11: policy.file: is missing
[policy]; file = "absent.py:Net"; trust_code = true => absent.py: does not exist
[policy]; file = "absent.pt"; trust_code = true => absent.pt: does not exist
[policy]; file = "absent.pt2"; trust_code = true => absent.pt2: does not exist
[policy]; file = "absent.safetensors" => absent.safetensors: does not exist
field = "scene.safetensors" -> => :2: scene.field: is missing; give it, or surrogate
field = "scene.safetensors" -> field = "a"; surrogate = "a.xml" => :3: scene.field: .*
field = "object.safetensors" -> => objects.0.field: is missing
field = "scene.safetensors" -> field = "a"; spp = 2 => :4: scene.spp: .* 1, 4, 9 or 16
[attack.vary]; speed_sd = 1.5 => attack.vary.speed_sd: .* 1
[attack.vary]; delay_s_sd = 100.0 => attack.vary.delay_s_sd: .* 5
[attack.vary]; light_ev_sd = 9 => attack.vary.light_ev_sd: .* 8
[attack.vary]; sun.share = [0.5, 0.96] => attack.vary.sun.share: .* from 0 to 0.95
[attack.vary]; sun.elevation_deg = [40, 20] => elevation_deg: .* from 0 to 90
[attack.vary]; sun.height = 3 => attack.vary.sun.height: unknown key; .* azimuth_deg
field = "scene.safetensors" -> surrogate = "a.xml"; spp = 4 => :4: scene.spp: a.xml says
field = "scene.safetensors" -> surrogate = "a.xml" => :9: objects.0.field: a.xml says it
"""


def rows() -> list[str]:
    joined = re.sub(r"\n  (?!=>)", "; ", ROWS.strip())
    return re.sub(r"\n  (?==>)", " ", joined).split("\n")


@pytest.mark.parametrize("row", rows())
def test_what_a_scenario_may_not_say(tmp_path, row):
    added, _, message = row.partition(" => ")
    old, is_change, new = added.partition(" ->")
    write_named_files(tmp_path)
    (tmp_path / "policy.safetensors").unlink()
    head = HEAD.partition("[policy]")[0] if "[policy]" in added else HEAD
    text = head.replace(old, new.strip()) if is_change else head + added
    path = tmp_path / "scenario.toml"
    path.write_text(text.replace("; ", "\n") + "\n")
    with pytest.raises(InputError, match=message) as caught:
        load_scenario(path)[0].policy.build()
    assert caught.value.where.startswith((str(tmp_path), "policy."))
