"""Products of the sensor of fields against Dr.Jit's tape of all samples."""

from __future__ import annotations

import copy
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.worlds import loops as toy
from support.worlds.fields import empty_border
from support.worlds.loops import OFFSET

from mi_nerfattack.attack.base import offset_gradients
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import GridLayout
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import depth_composite
from mi_nerfattack.render.posed import PosedField, move_all
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import absorption
from mi_nerfattack.render.walk import Path, Walk
from mi_nerfattack.rollout.sweep import Gradient


def tensor64(values):
    return sys.modules[mi.Float.__module__].TensorXf64(values)


def leaf(value):
    result = type(value)(dr.detach(value))
    dr.enable_grad(result)
    return result


def taped_image(sensor, state, textures, offsets):
    """Render what fields show a `SceneSensor`; their textures stay attached."""
    count, stop = dr.width(state), sensor.integrator.stop
    _, ray, _ = sensor.camera.rays([state[i] for i in range(3)], count, 0)
    rays = Rays(ray.o, ray.d)
    objects = sensor.objects
    scene = [layer for layer in sensor.layers if layer not in objects]
    layers = [taped_march(layer, rays, stop) for layer in scene]
    for k, (posed, texture) in enumerate(zip(objects, textures, strict=True)):
        posed.field.packed = posed.field.pack(mi.Float(texture.array))
        posed = moved(posed, [mi.Float(offsets[k, i].array) for i in range(6)])
        layers.append(taped_march(posed, rays, stop))
    pixels = dr.linear_to_srgb(depth_composite(layers).radiance)  # before black
    width, height = sensor.camera.size
    return mi.TensorXf(dr.ravel(pixels), (count, height, width, 3))


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
            walk, segment = walk.next([posed], active)
        density, colour = posed.eval(path.at(segment.t), path.heading, segment.active)
        x = dr.select(segment.active, density * segment.width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        radiance += weight * colour
        moment += weight * segment.t
        tau += x
        active = segment.active & (dr.exp(-dr.detach(tau)) > stop)
    return March(radiance, tau * absorption(tau)[0], moment)


pytestmark = pytest.mark.usefixtures("variant")

BOTH = np.array([[0.0, 0.35, 0.02], [0.1, -0.2, -0.05]])


def test_products_of_the_sensor_are_those_of_the_tape(rng):
    """Two objects overlap in the image, each with its texture and offset."""
    loop, _ = toy.make_loop(coarse=True)
    old, state = loop.sensor, loop.initial(BOTH)
    near = toy.blob(GridLayout(2, 6, 9), 0.8, 2.0, 0.2, 3)
    objects = [*old.objects, PosedField(near, Pose.upright((5.0, 0.3, 0.9), -0.4))]
    empty_border(near)
    view = old.intrinsics, old.mount
    sensor = field_sensor(old.layers[0], objects, *view, stop=0.0)
    offsets = np.concatenate([OFFSET, -0.5 * OFFSET])
    move_all(sensor.objects, offsets)
    observation = sensor.observe(state, 0)
    layers = observation.integrator_state.marches.layers
    both = (layers[1].opacity > 0.1) & (layers[2].opacity > 0.1)
    assert dr.count(both)[0] > 3
    d_image = mi.TensorXf(rng.normal(size=observation.image.shape).astype(np.float32))
    products = []
    for attached, poses in ((True, True), (False, True), (False, False)):
        sensor.start_gradient(sensor.pose_keys if poses else ())
        by_state = sensor.vjp(observation, state, d_image, attached)
        products += enumerate(np.array(x) for x in sensor.texture_gradients())
        if poses:
            by_pose = Gradient([], None, np.empty(0), None, sensor.gradients())
            products.append((2, offset_gradients(sensor, by_pose)))
        products += [(3, np.array(by_state))] if attached else []
        assert attached or by_state is None

    leaves = [leaf(x) for x in (*sensor.textures(), tensor64(offsets), state)]
    image = taped_image(sensor, leaves[3], leaves[:2], leaves[2])
    np.testing.assert_allclose(image.numpy(), observation.image.numpy(), atol=1e-6)
    dr.backward(dr.sum(image.array * d_image.array))
    for index, value in products:
        expected = np.array(dr.grad(leaves[index]))
        scale = np.abs(expected).max()
        np.testing.assert_allclose(value, expected, rtol=0, atol=2e-5 * scale)
