"""The light of a matt scene, computed once: what its surfaces show from everywhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from mi_nerfattack.capture.mesh.atlas import Atlas, lay_out
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh, read_mesh
from mi_nerfattack.capture.mesh.surface import face_normals, has_area
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, generate_rays, pose_arrays

_CHUNK = 1 << 20  # paths at a time
_NEAR_M = 1e-3  # from the surface, at which the eye of a texel is
_INSIDE_M = 2e-3  # how far it is moved from the rim, beside which others are seen
_LIGHT_M = 0.05  # edge of the texels of the light
_LEAST = 1e-3  # reflectance


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Triangles, and textures that give each of them texels of its own.

    Attributes:
        corners: (m, 3, 3), metres.
        coarse: of the light that arrives, which is smooth.
        fine: of the light that leaves, with the materials' detail.
    """

    corners: np.ndarray
    coarse: Atlas
    fine: Atlas

    @classmethod
    def of(cls, shapes: Sequence[Any], texel_m: float) -> Surfaces:
        """Take those of meshes; texels of materials have an edge of so many metres."""
        meshes = [read_mesh(shape) for shape in shapes]
        corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
        corners = corners[has_area(corners)]
        return cls(corners, lay_out(corners, _LIGHT_M), lay_out(corners, texel_m))

    def light(
        self, scene: Any, paths: int, progress: Callable[[int, int], None]
    ) -> np.ndarray:
        """Return what leaves by what is reflected, a coarse texture (h, w, 3)."""
        eyes, ahead = self._rays(self.coarse)
        values = np.empty((len(eyes), 3), np.float32)
        size = _CHUNK // paths
        for start in range(0, len(eyes), size):
            progress(start, len(eyes))
            part = np.arange(start, start + size) % len(eyes)
            values[part] = _arriving(scene, eyes[part], ahead[part], paths, start)
        progress(len(eyes), len(eyes))
        return self.coarse.image(values / _reflectance(scene, eyes, ahead))

    def shape(self, scene: Any, light: np.ndarray) -> Any:
        """Return the mesh, whose reflectance is the light that leaves."""
        uv = self.fine.interpolate(self.coarse.uv)
        rows, columns = (1 - uv[:, 1]) * len(light), uv[:, 0] * light.shape[1]
        at = np.stack([rows, columns]) - 0.5
        each = [
            ndimage.map_coordinates(c, at, order=1, mode="nearest")
            for c in np.moveaxis(light, 2, 0)
        ]
        eyes, ahead = self._rays(self.fine)
        leaving = np.stack(each, axis=1) * _reflectance(scene, eyes, ahead)
        return self._mesh(self.fine.image(leaving.astype(np.float32)))

    def _rays(self, atlas: Atlas) -> tuple[np.ndarray, np.ndarray]:
        """Return places (k, 3) just before the texels, and directions to them."""
        normals = face_normals(self.corners)[atlas.triangles]
        points = atlas.interpolate(self.corners)
        inward = self.corners.mean(1)[atlas.triangles] - points
        length = np.linalg.norm(inward, axis=1, keepdims=True)
        points += inward * np.minimum(_INSIDE_M / np.maximum(length, 1e-9), 1)
        eyes = points + _NEAR_M * normals
        return eyes.astype(np.float32), -normals.astype(np.float32)

    def _mesh(self, image: np.ndarray) -> Any:
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}
        material = {"type": "diffuse", "reflectance": texture | {"wrap_mode": "clamp"}}
        faces = np.arange(3 * len(self.corners)).reshape(-1, 3)
        uv = self.fine.uv * [1, -1] + [0, 1]  # from the top left
        arrays = MeshArrays(self.corners.reshape(-1, 3), faces, uv=uv.reshape(-1, 2))
        return make_mesh("lit", arrays, mi.load_dict(material))


def _reflectance(scene: Any, eyes: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the diffuse reflectance (n, 3) ahead of places (n, 3)."""
    ray = mi.Ray3f(_point(eyes), mi.Vector3f(_point(ahead)))
    si = scene.ray_intersect(ray)
    seen = si.bsdf().eval_diffuse_reflectance(si, si.is_valid())
    return np.maximum([c.numpy() for c in seen], _LEAST).T


def _point(array: np.ndarray) -> mi.Point3f:
    return mi.Point3f(np.ascontiguousarray(array.T))


def _arriving(
    scene: Any, eyes: np.ndarray, ahead: np.ndarray, spp: int, seed: int
) -> np.ndarray:
    """Return the mean radiance (n, 3) that reaches eyes (n, 3) from ahead of them."""
    n = len(eyes)
    texel = dr.arange(mi.UInt32, n * spp) // spp
    origin = dr.gather(mi.Point3f, _point(eyes), texel)
    towards = mi.Vector3f(_point(ahead))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), n * spp)
    ray = mi.RayDifferential3f(origin, dr.gather(mi.Vector3f, towards, texel))
    found = scene.integrator().sample(scene, sampler, ray)[0]
    return np.stack([dr.block_sum(c, spp).numpy() / spp for c in found], axis=1)


class LitRoom:
    """A scene that shines as its texture says, seen by a camera that moves.

    Args:
        shapes: from `lit`.
        camera: intrinsics.
        rays: through each pixel of a picture, each from a pose of its own.
    """

    def __init__(self, shapes: list[Any], camera: Camera, rays: int) -> None:
        named = {f"shape_{i}": shape for i, shape in enumerate(shapes)}
        self._scene = mi.load_dict({"type": "scene", **named})
        self._camera = camera
        places = [[_radical_inverse(i, base) for base in (2, 3)] for i in range(rays)]
        middle = np.mean(places, axis=0)  # few of them are not around 0.5
        self._offsets = [mi.Point2f(*(p - middle).tolist()) for p in places]

    def picture(self, poses: np.ndarray) -> np.ndarray:
        """Return the mean of what is seen from poses (rays, 4, 4), linear (h, w, 3)."""
        total = mi.Color3f(0.0)
        for pose, offset in zip(poses, self._offsets, strict=True):
            rays = generate_rays(self._camera, *pose_arrays(pose), 1, offset)
            si = self._scene.ray_intersect(mi.Ray3f(*rays))
            total += si.bsdf().eval_diffuse_reflectance(si, si.is_valid())
        mean = (total / len(poses)).numpy().T
        return mean.reshape(self._camera.height, self._camera.width, 3)


def lit(
    folder: Path,
    scene: Any,
    groups: Mapping[str, tuple[Sequence[Any], float]],
    paths: int,
    progress: Callable[[str, int, int], None],
) -> list[Any]:
    """Light groups of a scene's meshes, or read what was lit before.

    Args:
        folder: that keeps the light.
        scene: with its integrator; matt.
        groups: meshes, and the edge of their texels in metres, by name.
        paths: a texel of the light.
        progress: called with the group, done and total.
    """
    result = []
    for name, (shapes, texel_m) in groups.items():
        surfaces, path = Surfaces.of(shapes, texel_m), folder / f"{name}.safetensors"
        if not path.is_file():
            show = partial(progress, f"light of {name}")
            light = surfaces.light(scene, paths, show)
            files.write_safetensors(path, {"light": light.astype(np.float32)})
        light = files.read_safetensors(path)[0]["light"]
        result.append(surfaces.shape(scene, light))
    return result


def _radical_inverse(index: int, base: int) -> float:
    result, share = 0.0, 1.0 / base
    while index:
        result += share * (index % base)
        index, share = index // base, share / base
    return result
