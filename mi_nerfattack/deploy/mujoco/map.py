"""Meshes and textures of a Mitsuba scene, as MuJoCo draws them.

Textures hold what a surface of the scene would show in full light, so that MuJoCo's
lights, whose sum is clipped at one, only darken it; see
:mod:`mi_nerfattack.deploy.mujoco.light`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8, srgb_to_linear_numpy
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, read_mesh
from mi_nerfattack.deploy.built_in import BuiltInObject
from mi_nerfattack.deploy.mujoco.module import mujoco
from mi_nerfattack.errors import InputError

_PROCEDURAL = 512  # texels along an edge of a texture that is no image
_BORDER = 8  # texels
_SAME = 0.01  # mean difference of albedos that counts as none
_NOT_FLAT = ("MeshAttribute", "VolumeAdapter")


@dataclass(frozen=True, eq=False)
class DrawnMesh:
    """Triangles with a texture.

    Args:
        name: of the shape.
        vertices: (n, 3), metres in the world.
        faces: (m, 3), counter-clockwise from outside.
        normals: (n, 3), unit vectors; None for flat triangles.
        uv: (n, 2); v = 0 is the first row of the texture. Beyond [0, 1] it repeats.
        texture: (h, w, 3), linear: albedo, or radiance of what `shines`.
        two_sided: whether the back is drawn as well.
        shines: whether it is drawn in its own light only.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray
    texture: np.ndarray
    two_sided: bool = True
    shines: bool = False


def read_meshes(scene: Any) -> list[DrawnMesh]:
    """Read the shapes of a Mitsuba scene.

    Args:
        scene: `mi.Scene` of an RGB or monochrome variant.

    Raises:
        InputError: a shape that is neither mesh nor rectangle, a transparent material,
            or a spectral variant.
    """
    if mi.is_spectral:
        raise InputError(
            f"variant {mi.variant()}: MuJoCo draws RGB; set an RGB variant"
        )
    return [_read_shape(shape) for shape in scene.shapes()]


def built_in_mesh(index: int, item: BuiltInObject) -> DrawnMesh:
    """Describe an object with a baked texture; `index` makes its name unique."""
    uv = np.stack([item.uv[:, 0], 1 - item.uv[:, 1]], axis=1)
    image = srgb_to_linear_numpy(item.image.astype(np.float32) / 255)
    normals = None if item.normals is None else item.normals @ item.pose.rotation.T
    return DrawnMesh(
        f"built_in_{index:03d}",
        item.world_vertices,
        item.faces,
        normals=normals,
        uv=uv,
        texture=image,
    )


def add_meshes(
    spec: mujoco.MjSpec, meshes: Sequence[DrawnMesh], white: np.ndarray, gain: float
) -> None:
    """Add meshes, their textures and materials; nothing collides with them.

    Args:
        spec: gets them.
        meshes: may be empty.
        white: (3,), linear colour of a white surface in full light.
        gain: of the radiance of what shines.
    """
    for index, mesh in enumerate(map(_padded, meshes)):
        name = f"{index:03d}_{mesh.name}"
        factor = gain if mesh.shines else white
        _add_material(
            spec, name, mesh, texels=_encode(mesh.texture * np.float32(factor))
        )
        _add_mesh(spec, name, mesh)
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=name,
            contype=0,
            conaffinity=0,
            mass=0,
            group=2,
        )


def _encode(linear: np.ndarray) -> np.ndarray:
    """Encode as 8-bit sRGB through a table: a map has millions of texels."""
    table = linear_to_uint8(np.linspace(0, 1, 1 << 16))
    return table[np.rint(np.clip(linear, 0, 1) * 65535).astype(np.uint16)]


def _add_material(spec: Any, name: str, mesh: DrawnMesh, texels: np.ndarray) -> None:
    height, width = texels.shape[:2]
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    texture = spec.add_texture(
        name=name, type=kind, height=height, width=width, nchannel=3
    )
    texture.data = texels.tobytes()
    material = spec.add_material(name=name)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    material.specular = material.shininess = material.reflectance = 0
    material.emission = 1.0 if mesh.shines else 0.0


def _add_mesh(spec: Any, name: str, mesh: DrawnMesh) -> None:
    """Add the triangles with vertices of their own, and once more from behind."""
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(area, axis=1)
    mask = length > 1e-12
    flat = np.repeat((area[mask] / length[mask, None])[:, None], 3, axis=1)
    normals = flat if mesh.normals is None else mesh.normals[mesh.faces[mask]]
    uv = mesh.uv[mesh.faces[mask]]
    corners = corners[mask]
    if mesh.two_sided:
        corners = np.concatenate([corners, corners[:, ::-1]])
        normals = np.concatenate([normals, -normals[:, ::-1]])
        uv = np.concatenate([uv, uv[:, ::-1]])
    faces = np.arange(3 * len(corners))
    spec.add_mesh(
        name=name,
        uservert=corners.ravel(),
        userface=faces,
        usernormal=normals.ravel(),
        userfacenormal=faces,
        usertexcoord=uv.ravel(),
        userfacetexcoord=faces,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _padded(mesh: DrawnMesh) -> DrawnMesh:
    """Continue a texture that does not repeat, whose opposite edges would mix."""
    if mesh.uv.min() < 0 or mesh.uv.max() > 1:
        return mesh
    size = np.array(mesh.texture.shape[1::-1])
    border = ((_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0))
    texture = np.pad(mesh.texture, border, mode="edge")
    uv = (mesh.uv * size + _BORDER) / (size + 2 * _BORDER)
    return replace(mesh, uv=uv, texture=texture)


def _read_shape(shape: Any) -> DrawnMesh:
    name, bsdf = shape.id(), shape.bsdf()
    # a rectangle calls itself a mesh, but has no arrays
    if shape.class_name() == "Rectangle":
        arrays = _rectangle_arrays(shape)
    elif shape.is_mesh():
        arrays = read_mesh(shape)
    else:
        raise InputError(
            f"shape {name!r}: MuJoCo cannot draw a {shape.class_name()}; take a mesh "
            "or a rectangle"
        )
    uv = np.zeros((len(arrays.vertices), 2)) if arrays.uv is None else arrays.uv
    drawn = partial(DrawnMesh, name, arrays.vertices, arrays.faces, arrays.normals)
    if shape.is_emitter():
        return drawn(uv, _emitted(shape), two_sided=False, shines=True)
    flags = bsdf.flags()
    if mi.has_flag(flags, mi.BSDFFlags.Transmission) or mi.has_flag(
        flags, mi.BSDFFlags.Null
    ):
        raise InputError(
            f"shape {name!r}: MuJoCo cannot draw its transparent {bsdf.class_name()}; "
            "take an opaque material"
        )
    for node in mi.traverse(bsdf).hierarchy:
        if node.class_name() in _NOT_FLAT:
            raise InputError(
                f"shape {name!r}: MuJoCo cannot draw its {node.class_name()}, colours "
                "of vertices or of a volume; bake them into an image"
            )
    try:
        uv, albedo = _bake(bsdf, uv)
    except InputError as error:
        raise InputError(f"shape {name!r}: {error}") from error
    return drawn(uv, albedo, two_sided="TwoSided" in bsdf.class_name())


def _rectangle_arrays(shape: Any) -> MeshArrays:
    to_world: Any = mi.traverse(shape)["to_world"]
    matrix = np.array(to_world.matrix, np.float64).reshape(4, 4)
    square = np.array([(-1, -1, 0, 1), (1, -1, 0, 1), (1, 1, 0, 1), (-1, 1, 0, 1)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)
    vertices = (square @ matrix.T)[:, :3]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return MeshArrays(vertices, faces, uv=uv)


def _emitted(shape: Any) -> np.ndarray:
    """Return the radiance (1, 1, 3) of an area emitter at the middle of its texture."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.n = mi.Vector3f(0, 0, 1), mi.Normal3f(0, 0, 1)
    si.uv = mi.Point2f(0.5, 0.5)
    return rgb_rows(shape.emitter().eval(si)).reshape(1, 1, 3)


def _bake(bsdf: Any, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate a material's albedo on the texels of its largest image.

    Returns:
        uv (n, 2) in the image's own frame, and the linear albedo (h, w, 3).
    """
    parameters: Any = mi.traverse(bsdf)
    images = [parameters[k].shape for k in parameters.keys() if k.endswith(".data")]
    to_uv = np.eye(3)
    if images:
        height, width = max(shape[:2] for shape in images)
        to_uv = _common_transform(parameters)
    else:
        varies = any("color" in key for key in parameters.keys())
        height = width = _PROCEDURAL if varies else 1
    v, u = np.mgrid[:height, :width] + 0.5
    grid = np.stack([u.ravel() / width, v.ravel() / height, np.ones(u.size)])
    albedo = _albedo(bsdf, np.linalg.solve(to_uv, grid)).reshape(height, width, 3)
    moved = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ to_uv.T
    beyond = max(-moved[:, :2].min(), moved[:, :2].max() - 1) * max(height, width)
    if beyond > 1:
        grid[:2] += 1
        other = _albedo(bsdf, np.linalg.solve(to_uv, grid)).reshape(albedo.shape)
        if np.abs(albedo - other).mean() > _SAME:
            raise InputError(
                f"coordinates reach {beyond:.1f} texels beyond an image that does not "
                "repeat, but in MuJoCo all do; set wrap_mode to repeat, or bake it"
            )
    return moved[:, :2], np.clip(albedo, 0, 1)


def _albedo(bsdf: Any, uv: np.ndarray) -> np.ndarray:
    """Return a material's albedo (n, 3) at coordinates (3, n), homogeneous."""
    si = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    si.uv = mi.Point2f(uv[:2].astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    # a uniform material answers with one value for all texels
    albedo = bsdf.eval_diffuse_reflectance(si) + dr.zeros(mi.Float, uv.shape[1])
    return rgb_rows(albedo)


def _common_transform(parameters: Any) -> np.ndarray:
    """Return the (3, 3) transform of coordinates that a material's images share."""
    keys = [key for key in parameters.keys() if key.endswith(".to_uv")]
    matrices = [
        np.array(parameters[key].matrix, np.float64).reshape(3, 3) for key in keys
    ]
    if any(not np.allclose(matrix, matrices[0]) for matrix in matrices):
        raise InputError(f"textures {', '.join(keys)}: MuJoCo needs the same to_uv")
    return matrices[0] if matrices else np.eye(3)


def rgb_rows(value: Any) -> np.ndarray:
    """Copy `mi.Color3f` or `mi.Color1f` with n entries to (n, 3) float32."""
    rows = np.array(value, np.float32).T.reshape(dr.width(value), -1)
    return np.ascontiguousarray(np.broadcast_to(rows, (len(rows), 3)))
