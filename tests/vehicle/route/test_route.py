"""Route and expert against closed forms."""

from __future__ import annotations

import json

import drjit as dr
import numpy as np
import pytest
from helpers.states import row64, state64

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle import (
    Dubins,
    ExplicitEuler,
    Route,
    load_routes,
    smooth_absolute,
)
from mi_nerfattack.vehicle.expert import LaneFollower

pytestmark = pytest.mark.usefixtures("variant")


def lane(lead=15.0, radius=6.0, turn=np.pi / 2, tail=15.0, step=0.5):
    """Route of a straight, a left (turn > 0) or right arc and a straight."""
    sign, turn = np.sign(turn), abs(turn)
    length = lead + radius * turn + tail
    s = np.linspace(0, length, round(length / step) + 1)
    angle = np.clip((s - lead) / radius, 0, turn)
    after = np.maximum(s - lead - radius * turn, 0)
    x = np.minimum(s, lead) + radius * np.sin(angle) + after * np.cos(turn)
    y = radius * (1 - np.cos(angle)) + after * np.sin(turn)
    return Route("lane", 0, np.stack([x, sign * y], axis=1))


STRAIGHT = Route("straight", 0, [[0, 0], [3, 0], [10, 0]])


def test_pose_at_inverts_projection():
    route = lane(turn=-np.pi / 2)
    s = np.array([-3.0, 0.0, 7.3, 60.0])
    states = route.pose_at(s, [0.4, -0.3, 1.0, -1.0], 0.2)
    arc, error, heading = route.project_numpy(states)
    np.testing.assert_allclose(arc, s, atol=1e-12)
    np.testing.assert_allclose(error, [0.4, -0.3, 1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(heading, 0.2, atol=1e-12)
    assert route.pose_at(2.0).shape == (3,)
    assert route.length == pytest.approx(30 + 3 * np.pi, rel=1e-3)


def test_one_kernel_for_every_route_and_state():
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for route, x in [(STRAIGHT, 1.0), (lane(), 7.0), (lane(turn=-1.0), 3.0)]:
            state = dr.llvm.ad.Array3f(x, 0.5, 0.1)
            dr.make_opaque(state)
            dr.eval(route.cross_track(state))
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len({entry["hash"] for entry in history}) == 1


def test_smooth_absolute():
    error = row64([0.0, 0.3, -40.0])
    dr.enable_grad(error)
    value = smooth_absolute(error, 0.4)
    dr.backward(dr.sum(value))
    np.testing.assert_allclose(value.numpy(), [0, 0.1, 1600.16**0.5 - 0.4])
    np.testing.assert_allclose(dr.grad(error).numpy()[:2], [0, 0.6])


def write_routes(folder, **changes):
    entry = {"goal": 1, "lane_width_m": 3.5, "speed_ms": 5.0}
    entry |= {"points_m": [[0, 0], [1, 0]]} | changes
    path = folder / "routes.json"
    path.write_text(json.dumps({"right": entry}))
    return path


def test_route_file(tmp_path):
    route = Route.from_file(write_routes(tmp_path), "right")
    assert (route.goal, route.lane_width_m, route.length) == (1, 3.5, 1.0)
    assert not route.closed
    loop = {"points_m": [[0, 0], [1, 0], [0, 1]], "closed": True}
    (route,) = load_routes(write_routes(tmp_path, **loop))
    assert route.closed and route.length == pytest.approx(2 + 2**0.5)
    with pytest.raises(InputError, match="no route 'left'; it has 'right'"):
        Route.from_file(tmp_path / "routes.json", "left")
    with pytest.raises(InputError, match="absent"):
        Route.from_file(tmp_path / "absent.json", "left")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points_m": [[0, 0]]}, "at least two"),
        ({"points_m": [[0, 0], [1]]}, "pairs"),
        ({"points_m": [[0, 0], [1, 1], [1, 1]]}, "points 1 and 2"),
        ({"points_m": [[0, 0], [1, None]]}, "finite"),
        ({"points_m": [[0, 0], [1, 1e10]]}, "point 1 .* at most 1e.09 m"),
        ({"lane_width_m": -1}, "lane_width_m: -1"),
        ({"speed_ms": "5"}, "speed_ms"),
        ({"goal": 1.5}, "goal"),
        ({"goal": -1}, "goal"),
        ({"closed": 1}, "closed 1; true or false"),
        ({"closed": True}, "at least three"),
    ],
)
def test_route_file_errors(tmp_path, changes, message):
    path = write_routes(tmp_path, **changes)
    with pytest.raises(InputError, match=message) as error:
        Route.from_file(path, "right")
    assert "routes.json" in str(error.value)


@pytest.mark.parametrize("turn", [np.pi / 2, -np.pi / 2, 1e-9])
def test_a_previewed_heading_follows_and_recovers_by_euler_steps(turn):
    """At 5 m/s with 0.1 s steps, from the lane and from beside it."""
    route = lane(turn=turn)
    expert = LaneFollower(route, 5.0, heading_preview_m=0.25)
    lateral, heading = np.meshgrid([-1.5, -0.5, 1.5], [-0.4, 0.0, 0.4])
    beside = route.pose_at(0.0, lateral.ravel(), heading.ravel())
    states, errors = np.vstack([route.pose_at(0.0), beside]), []
    for _ in range(70):
        control = row64(expert.control(states))
        assert np.abs(control.numpy()).max() <= 1.5
        state = ExplicitEuler().step(Dubins(5.0), state64(states.T), control, 0.1)
        states = state.numpy().T
        errors.append(np.abs(route.cross_track_numpy(states)))
    errors = np.array(errors)
    assert errors[:, 0].mean() < 0.03
    assert errors[28:].max() < 0.1 and errors[-5:].max() < 0.05
