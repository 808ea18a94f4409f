"""Sun and sky of a Mitsuba scene as MuJoCo's lights.

MuJoCo multiplies textures by lights in the encoding of the image, whereas a path tracer
works in linear radiance. For a power law both agree: with the exponent g = 1 / 2.2,
`(albedo E)^g = albedo^g E^g`. A surface that faces the sun shows its texture unchanged.
The ambient light gives every surface the brightness that it has in the shade. The
sun's light adds the rest of the brightness of level ground, so level ground is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.mujoco.map import rgb_rows
from mi_nerfattack.deploy.mujoco.module import mujoco

SUN = "sun"
#: Radius around the camera in which the sun casts shadows, metres.
SHADOW_RADIUS = 60.0
#: Distance from there to where the shadows' light stands, metres.
SUN_DISTANCE = 150.0

_GAMMA = 1 / 2.2
_SAMPLES = 1 << 16
_SUN_DEG = 2.0  # around its middle
_SUN_RATIO = 50.0  # of the brightest radiance to the mean one, where there is a sun
_SKY_PX = 128
# Face by face the axes (right, down, outward) of a cube map of OpenGL, in its own
# frame, which is the world's turned by a quarter about x: (x, y, z) -> (x, z, -y).
_FACES = (
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
    ((0, 0, 1), (0, -1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, -1)),
)


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light from far away, linear.

    Args:
        sun_direction: (3,), unit vector towards the sun; straight up without one.
        sun: (3,), irradiance of a surface that faces the sun; zero without one.
        sky: (3,), irradiance of level ground by all the rest.
        faces: (6, n, n, 3), radiance of the sky on the faces of MuJoCo's cube map.
        has_shadows: whether the sun casts shadows.
    """

    sun_direction: np.ndarray
    sun: np.ndarray
    sky: np.ndarray
    faces: np.ndarray
    has_shadows: bool = True

    def scaled(self, factor: float) -> Lighting:
        """Return the light multiplied by a factor."""
        return Lighting(
            self.sun_direction,
            factor * self.sun,
            factor * self.sky,
            np.float32(factor) * self.faces,
            self.has_shadows,
        )

    @property
    def white(self) -> np.ndarray:
        """Linear colour (3,) of a white surface that sun and sky shine on."""
        return (self.sun + self.sky) / math.pi


def read_lighting(scene: Any) -> Lighting:
    """Measure the light of a Mitsuba scene.

    Outdoors, with an environment or directional emitter, other emitters are drawn but
    light nothing. Without one, the mean light in the scene's lower half is measured:
    what falls on vertical surfaces becomes ambient light, and what level ones get
    besides comes from straight above, without shadows.

    Args:
        scene: `mi.Scene`.
    """
    emitters = [e for e in scene.emitters() if _is_far(e)]
    sun, sky, direction = np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 1.0])
    for emitter in emitters:
        light = _irradiance(emitter, scene)
        if light[0].sum() > sun.sum():
            direction = light[2]
        sun, sky = sun + light[0], sky + light[1]
    if not emitters:
        above, beside = _indoor_irradiance(scene)
        sun, sky = np.maximum(above - beside, 0), beside
        return Lighting(direction, sun, sky, faces=_sky_faces([]), has_shadows=False)
    return Lighting(direction, sun, sky, _sky_faces(emitters))


def add_lighting(spec: mujoco.MjSpec, lighting: Lighting) -> None:
    """Add the ambient light, the sun and the sky's picture."""
    white = np.maximum(lighting.white, 1e-9)
    ambient = (lighting.sky / math.pi / white) ** _GAMMA
    height = max(float(lighting.sun_direction[2]), 0.05)
    level = ((lighting.sky + height * lighting.sun) / math.pi / white) ** _GAMMA
    head = spec.visual.headlight
    head.active = 1
    head.ambient, head.diffuse, head.specular = ambient, [0] * 3, [0] * 3
    if lighting.sun.any():
        spec.worldbody.add_light(
            name=SUN,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=SUN_DISTANCE * lighting.sun_direction,
            dir=-lighting.sun_direction,
            ambient=[0] * 3,
            diffuse=np.clip((level - ambient) / height, 0, 1),
            specular=[0] * 3,
            castshadow=lighting.has_shadows,
        )
    texels = linear_to_uint8(lighting.faces)
    size = texels.shape[1]
    kind = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    texture = spec.add_texture(
        name="sky", type=kind, width=size, height=6 * size, nchannel=3
    )
    texture.data = texels.tobytes()


def _is_far(emitter: Any) -> bool:
    return emitter.is_environment() or mi.has_flag(
        emitter.flags(), mi.EmitterFlags.DeltaDirection
    )


def _irradiance(emitter: Any, scene: Any) -> tuple[np.ndarray, ...]:
    """Return sun (3,), sky (3,) and the direction (3,) to the sun of one emitter."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _SAMPLES)
    si = dr.zeros(mi.SurfaceInteraction3f, _SAMPLES)
    si.p = mi.Point3f(scene.bbox().center())
    sample, weight = emitter.sample_direction(si, sampler.next_2d())
    weight = rgb_rows(weight + dr.zeros(mi.Float, _SAMPLES)).astype(np.float64)
    directions = np.array(sample.d + dr.zeros(mi.Float, _SAMPLES)).T.astype(np.float64)
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection):
        return weight[0], np.zeros(3), directions[0]
    weight[~np.isfinite(weight).all(axis=1)] = 0
    density = np.array(sample.pdf, np.float64)
    radiance = weight.mean(axis=1) * density
    middle = directions[int(np.argmax(radiance))]
    near = directions @ middle > math.cos(math.radians(_SUN_DEG))
    mean = weight[~near].mean() * (~near).mean() / (4 * math.pi)
    if radiance.max() < _SUN_RATIO * mean:
        near[:] = False
    level = weight * np.maximum(directions[:, 2:], 0)
    return (
        np.where(near[:, None], weight, 0).mean(axis=0),
        np.where(near[:, None], 0, level).mean(axis=0),
        middle if near.any() else np.array([0.0, 0.0, 1.0]),
    )


def _indoor_irradiance(scene: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean irradiance (3,) of level and of vertical surfaces.

    The scene's integrator tells it at random points between a twentieth and a half of
    the scene's height; lamps that are points, which no ray meets, are added.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, _SAMPLES)
    box = scene.bbox()
    part = mi.Point3f(sampler.next_2d().x, sampler.next_2d().x, sampler.next_2d().x)
    part = mi.Point3f(part.x, part.y, 0.05 + 0.45 * part.z)
    origin = mi.Point3f(box.min) + mi.Vector3f(box.extents()) * mi.Vector3f(part)
    upward = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    angle = 2 * math.pi * sampler.next_2d().x
    sin, cos = dr.sincos(angle)
    sideways = mi.Vector3f(
        upward.z * cos - upward.x * sin, upward.z * sin + upward.x * cos, upward.y
    )
    result = []
    for normal, direction in (
        (mi.Vector3f(0, 0, 1), upward),
        (mi.Vector3f(cos, sin, 0), sideways),
    ):
        ray = mi.RayDifferential3f(mi.Ray3f(origin, direction))
        radiance, *_ = scene.integrator().sample(scene, sampler, ray)
        irradiance = math.pi * rgb_rows(radiance).mean(axis=0).astype(np.float64)
        result.append(irradiance + _from_points(scene, sampler, origin, normal=normal))
    return result[0], result[1]


def _from_points(scene: Any, sampler: Any, origin: Any, normal: Any) -> np.ndarray:
    """Return the mean irradiance (3,) of surfaces by emitters without extent."""
    si = dr.zeros(mi.SurfaceInteraction3f, _SAMPLES)
    si.p, total = origin, np.zeros(3)
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
            sample, weight = emitter.sample_direction(si, sampler.next_2d())
            visible = ~scene.ray_test(si.spawn_ray_to(sample.p))
            slant = dr.select(visible, dr.maximum(dr.dot(sample.d, normal), 0), 0)
            total += rgb_rows(weight * slant).mean(axis=0)
    return total


def _sky_faces(emitters: list[Any]) -> np.ndarray:
    size = _SKY_PX
    row, column = (2 * (np.mgrid[:size, :size] + 0.5) / size - 1)[..., None]
    faces = np.zeros((6, size, size, 3), np.float32)
    for face, axes in zip(faces, _FACES, strict=True):
        right, down, outward = np.array(axes, np.float64)
        x, z, minus_y = np.moveaxis(outward + column * right + row * down, -1, 0)
        direction = np.stack([x, -minus_y, z]).reshape(3, -1)
        direction /= np.linalg.norm(direction, axis=0)
        si = dr.zeros(mi.SurfaceInteraction3f, size * size)
        si.wi = mi.Vector3f(-direction.astype(np.float32))
        for emitter in emitters:
            if emitter.is_environment():
                value = emitter.eval(si) + dr.zeros(mi.Float, size * size)
                face += rgb_rows(value).reshape(size, size, 3)
    return faces
