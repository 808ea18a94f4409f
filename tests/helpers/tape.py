"""A whole drive through fields on Dr.Jit's tape, down to the samples of each ray.

Neither costates, nor products of sensors, nor replayed marches are used; only the
policy's derivative is the same. Memory: tens of bytes times the arithmetic of all
samples of all frames. Time: each step of each march is a kernel of its own.
"""

from __future__ import annotations

import copy
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.render.composite import depth_composite
from mi_nerfattack.render.rays import March
from mi_nerfattack.render.sums import absorption
from mi_nerfattack.render.walk import Path, Walk
from mi_nerfattack.rollout.objective import StateHistory
from mi_nerfattack.rollout.sweep import Gradient


class FullTape:
    """An adjoint for policies without memory and the depth composite of fields."""

    def keep(self, loop, step):
        """Keep nothing; the tape is made afterwards."""

    def gradient(self, loop, drive, cost, options):
        """Drive again, recording, and let Dr.Jit differentiate the cost."""
        sensor = loop.sensor
        textures = [leaf(texture) for texture in sensor.textures()]
        offsets = leaf(tensor64(sensor.offsets())) if options.offsets else None
        states, controls = [leaf(drive.states[0])], []
        for step in range(drive.horizon):
            state = states[-1]
            viewed = state if options.attached else dr.detach(state)
            image = taped_image(sensor, viewed, step, textures, offsets)
            control = dr.custom(PolicyOp, loop.policy, image, loop.goal)
            controls.append(dr.value_t(type(state))(control))
            pair = loop.transition.controls(controls, step, state)
            states.append(loop.transition._advance(state, *pair)[-1])
            dr.eval(states[-1], controls[-1])
        rows = side_by_side(states[1:])
        history = StateHistory(rows, drive.count, drive.horizon, drive.dt)
        value = cost.reduction.reduce(cost.objective.evaluate(history))
        dr.backward(cost.scale * value, flags=dr.ADFlag.ClearEdges)
        sensor.set_textures([dr.detach(texture) for texture in textures])
        return Gradient(
            [dr.grad(texture) for texture in textures],
            np.array(dr.grad(offsets), np.float64) if options.offsets else None,
            dr.grad(states[0]),
            -np.stack([np.array(dr.grad(state)).T for state in states[1:]]),
            None,
        )


class PolicyOp(dr.CustomOp):
    """A policy without memory, as an operation of Dr.Jit."""

    def eval(self, policy, image, goal):
        self.policy, self.image, self.goal = policy, dr.detach(image), goal
        return policy.control(self.image, goal)

    def backward(self):
        row = dr.array_t(self.image)(self.grad_out())
        dr.eval(row)
        self.set_grad_in("image", self.policy.vjp(self.image, self.goal, row)[1])


def tensor64(values):
    """Upload an array in double precision."""
    return sys.modules[mi.Float.__module__].TensorXf64(values)


def leaf(value):
    """Copy a value to a leaf of the tape."""
    result = type(value)(dr.detach(value))
    dr.enable_grad(result)
    return result


def side_by_side(states):
    """Lay states (m, n) of T periods side by side, drive by drive: (m, n T)."""
    count, horizon, kind = dr.width(states[0]), len(states), type(states[0])
    row = dr.value_t(kind)
    index = dr.arange(dr.uint32_array_t(dr.detached_t(row)), count * horizon)
    source = (index % horizon) * count + index // horizon
    axes = range(len(states[0]))
    rows = [dr.concat([state[axis] for state in states]) for axis in axes]
    return kind(*[dr.gather(row, values, source) for values in rows])


def taped_image(sensor, state, step, textures, offsets):
    """Render what a `FieldSensor` sees; its textures stay attached."""
    key = dr.opaque(mi.UInt32, step)
    rays = sensor._make_rays([state[i] for i in range(3)], key, dr.width(state))
    layers = [taped_march(sensor.scene, rays, sensor.stop)]
    for k, (posed, texture) in enumerate(zip(sensor.objects, textures, strict=True)):
        posed.field.packed = posed.field.pack(mi.Float(texture.array))
        if offsets is not None:
            posed = moved(posed, [mi.Float(offsets[k, i].array) for i in range(6)])
        layers.append(taped_march(posed, rays, sensor.stop))
    pixels = sensor._develop(depth_composite(layers), rays.direction)
    return sensor._tensor(pixels, dr.width(state))


def moved(posed, offset):
    """Return the field moved by an attached offset, (6,), from where it was made."""
    shift, w = mi.Vector3f(*offset[:3]), mi.Vector3f(*offset[3:])
    square = dr.squared_norm(w)
    angle = dr.sqrt(dr.maximum(square, 1e-12))
    small = square < 1e-6
    first = dr.select(small, 1 - square / 6, dr.sin(angle) / angle)
    second = dr.select(small, 0.5 - square / 24, (1 - dr.cos(angle)) / dr.square(angle))
    twin = copy.copy(posed)
    twin._columns = []
    for column in np.asarray(posed.pose.rotation, np.float32).T:
        v = mi.Vector3f(*map(float, column))
        turn = dr.cross(w, v)
        twin._columns.append(v + first * turn + second * dr.cross(w, turn))
    twin._origin = mi.Point3f(*map(float, posed.pose.translation)) + shift
    return twin


@dr.syntax
def taped_march(posed, rays, stop):
    """Do what `render.march.march` does, one evaluated step at a time.

    Differentiable by Dr.Jit in everything that is attached: the field's arrays and
    pose, and the rays. Positions of samples and ends of the interval are constants,
    as for `march_derivative`.
    """
    path = Path.of(posed, rays)
    walk, active = dr.detach(Walk.start(posed, rays))
    count = dr.width(path.d)
    tau = dr.zeros(mi.Float, count)
    radiance = dr.zeros(mi.Color3f, count)
    moment = dr.zeros(mi.Float, count)
    while dr.hint(active, mode="evaluated"):
        with dr.suspend_grad():
            walk, here = walk.next([posed], active)
        density, colour = posed.eval(path.at(here.t), path.heading, here.active)
        x = dr.select(here.active, density * here.width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        radiance += weight * colour
        moment += weight * here.t
        tau += x
        active = here.active & (dr.exp(-dr.detach(tau)) > stop)
    return March(radiance, tau * absorption(tau)[0], moment)
