"""How many of our files one frame and its gradient enter: what a reader must open."""

from __future__ import annotations

import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_nerfattack as nf
from mi_nerfattack.vehicle.state import to_state

ROOT = Path(nf.__file__).parents[1]
MOST = 34


@pytest.mark.usefixtures("variant")
def test_a_frame_and_its_gradient_enter_few_files():
    scene: mi.Scene = mi.load_file(
        str(nf.bundled("demo.xml")), parallel=False, width=40, height=13
    )
    mount = nf.bundled_place().mount
    sensor = nf.SceneSensor(scene, mount, ["fields.hydrant.colour"])
    state = to_state(np.array([[-8.0, -1.75, 0.0]]))
    ones, entered = dr.ones(mi.TensorXf, (1, 13, 40, 3)), set()

    def note(frame, event, _):
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(ROOT) and path.suffix == ".py":
            entered.add(path.relative_to(ROOT))

    sys.setprofile(note)
    try:
        seen = sensor.observe(state, 0)
        sensor.start_gradient()
        sensor.vjp(seen, state, ones, attached=False)
        (gradient,) = sensor.gradients().values()
    finally:
        sys.setprofile(None)
    sensor.stop_gradient()
    assert gradient.numpy().any()
    ours = {path for path in entered if path.parts[0] in ("mi_nerfattack", "plugins")}
    assert 20 < len(ours) <= MOST, sorted(map(str, ours))
