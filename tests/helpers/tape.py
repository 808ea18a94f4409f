"""An image of fields on Dr.Jit's tape, down to the samples of each ray.

Neither products of sensors nor replayed marches are used. Memory: tens of bytes times
the arithmetic of all samples. Time: each step of each march is a kernel of its own.
"""

from __future__ import annotations

import copy
import sys

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.render.composite import depth_composite
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.render.sums import absorption
from mi_nerfattack.render.walk import Path, Walk


def tensor64(values):
    """Upload an array in double precision."""
    return sys.modules[mi.Float.__module__].TensorXf64(values)


def leaf(value):
    """Copy a value to a leaf of the tape."""
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
            walk, here = walk.next([posed], active)
        density, colour = posed.eval(path.at(here.t), path.heading, here.active)
        x = dr.select(here.active, density * here.width, 0)
        weight = dr.exp(-tau) * x * absorption(x)[0]
        radiance += weight * colour
        moment += weight * here.t
        tau += x
        active = here.active & (dr.exp(-dr.detach(tau)) > stop)
    return March(radiance, tau * absorption(tau)[0], moment)
