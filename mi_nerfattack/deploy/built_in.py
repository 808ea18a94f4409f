"""Attacked textures on real geometry, lit and shadowed by the environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.capture.mesh.atlas import Atlas, lay_out
from mi_nerfattack.capture.mesh.cube_faces import sheet_mesh
from mi_nerfattack.capture.mesh.mesh import MeshPart, TexturedMesh, mitsuba_shapes
from mi_nerfattack.capture.mesh.surface import (
    check_same_box,
    face_normals,
    field_surface,
    has_area,
    inside_out,
    seen_colours,
    voxel_m,
)
from mi_nerfattack.capture.object_views import Placement
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.pose import Pose

_INWARD = 0.1  # voxels, and of the way to a triangle's middle


@dataclass(frozen=True, eq=False)
class BuiltInObject:
    """Triangles with a baked texture, at a pose.

    Attributes:
        vertices: (n, 3) float64, metres in the object's frame; no two triangles
            share one, so that every triangle has texels of its own.
        faces: (m, 3) integer, counter-clockwise from outside.
        uv: (n, 2) in [0, 1], origin at the bottom left of the image.
        image: (h, w, 3) uint8, sRGB albedo; row 0 is the top.
        pose: object to world.
        normals: (n, 3) unit vectors in the object's frame; None for flat triangles.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    image: np.ndarray
    pose: Pose
    normals: np.ndarray | None = None

    @property
    def world_vertices(self) -> np.ndarray:
        """Vertices (n, 3) in the world, metres."""
        return self.pose.apply(self.vertices)


@dataclass(frozen=True, eq=False)
class Shell:
    """Geometry of an object whose texels have no colours yet.

    Attributes:
        corners: (m, 3, 3), of triangles, metres in the object's frame.
        normals: (m, 3, 3), unit vectors at the corners.
        atlas: where the triangles lie in the texture.
        is_smooth: whether the normals differ from those of flat triangles.
    """

    corners: np.ndarray
    normals: np.ndarray
    atlas: Atlas
    is_smooth: bool


def built_in_shapes(objects: Sequence[BuiltInObject]) -> dict[str, Any]:
    """Make Mitsuba meshes, diffuse on both sides, for `load_scene(..., shapes=...)`.

    Args:
        objects: may be empty.

    Returns:
        one `mi.Shape` an object by name, "built_in_000" and so on; all of the active
        variant.
    """
    shapes = {}
    for index, item in enumerate(objects):
        part = MeshPart(
            item.vertices,
            item.faces,
            (1.0, 1.0, 1.0),
            normals=item.normals,
            uv=item.uv,
            texture=item.image,
            wrap="clamp",
        )
        pose = item.pose
        placed = part.placed(pose.scale * pose.rotation, pose.translation)
        meshes = mitsuba_shapes(TexturedMesh("built-in object", (placed,)))
        shapes[f"built_in_{index:03d}"] = meshes["part_000"]
    return shapes


def make_built_in(
    field: GridField,
    pose: Pose,
    mesh: str | Path | None = None,
    placement: Placement | None = None,
    captured_irradiance: float = np.pi,
    texel_m: float | None = None,
) -> BuiltInObject:
    """Bake the colours of an object's field into a texture of real geometry.

    The colours of a field are radiance in the light of its capture, `L = albedo E /
    pi`. With one `E = captured_irradiance` for the whole surface, the albedo is
    `pi L / E`, cut to [0, 1]: shading of the capture stays in the texture.

    Args:
        field: the object, as attacked.
        pose: object to world.
        mesh: the object's own geometry (glTF, OBJ, PLY), which the field was fitted
            to; None for the surface of the field, as `export` extracts it, or the face
            of a flat object.
        placement: size and axes of the mesh that were given to `asset`.
        captured_irradiance: E, in the field's unit of radiance times steradian; pi,
            the default, takes radiance as albedo.
        texel_m: edge of a texel in the object's frame; None for half a voxel.

    Raises:
        InputError: the mesh cannot be read, is transparent or not the field's object,
            the field is nowhere opaque, or a number is not positive.
    """
    if not 0 < captured_irradiance < np.inf:
        raise InputError(
            f"captured_irradiance: {captured_irradiance}; must be positive and finite"
        )
    shell = shell_of(field, mesh, placement, texel_m=texel_m)
    return paint(shell, field, pose, captured_irradiance=captured_irradiance)


def shell_of(
    field: GridField,
    mesh: str | Path | None = None,
    placement: Placement | None = None,
    texel_m: float | None = None,
) -> Shell:
    """Lay out an object's geometry, which does not depend on the field's colours.

    See :func:`make_built_in` for arguments and errors.
    """
    texel = 0.5 * voxel_m(field) if texel_m is None else texel_m
    if mesh is None:
        solid = sheet_mesh(field)
    else:
        solid = (placement or Placement()).mesh(mesh)
    if solid is None:
        corners, normals = _field_triangles(field)
    else:
        check_same_box(field, solid)
        corners = _outward(field, _solid_corners(solid))
        normals = _flat_normals(corners)
    return Shell(corners, normals, lay_out(corners, texel), is_smooth=solid is None)


def paint(
    shell: Shell, field: GridField, pose: Pose, captured_irradiance: float = np.pi
) -> BuiltInObject:
    """Bake the colours of a field into the texture of its geometry.

    See :func:`make_built_in`.
    """
    corners, normals, atlas = shell.corners, shell.normals, shell.atlas
    radiance = _texel_colours(field, atlas, corners, normals=normals)
    albedo = linear_to_uint8(np.pi / captured_irradiance * radiance)
    return BuiltInObject(
        vertices=corners.reshape(-1, 3),
        faces=np.arange(3 * len(corners)).reshape(-1, 3),
        uv=atlas.uv.reshape(-1, 2),
        image=atlas.image(albedo),
        pose=pose,
        normals=normals.reshape(-1, 3) if shell.is_smooth else None,
    )


def _field_triangles(field: GridField) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and normals, (m, 3, 3) each, of a field's surface."""
    surface = field_surface(field)
    corners, normals = surface.vertices[surface.faces], surface.normals[surface.faces]
    mask = has_area(corners)
    return corners[mask], normals[mask]


def _solid_corners(mesh: TexturedMesh) -> np.ndarray:
    """Return all triangles that have an area, (m, 3, 3)."""
    if not all(part.is_solid for part in mesh.submeshes):
        raise InputError(
            f"{mesh.name}: is partly transparent, which a built-in object cannot be; "
            "leave out the mesh for the surface of the field"
        )
    corners = np.concatenate([part.vertices[part.faces] for part in mesh.submeshes])
    return corners[has_area(corners)]


def _outward(field: GridField, corners: np.ndarray) -> np.ndarray:
    """Order corners (m, 3, 3) counter-clockwise from where the field is thin."""
    turned = inside_out(field, corners.mean(1), _flat_normals(corners)[:, 0])
    return np.where(turned[:, None, None], corners[:, ::-1], corners)


def _flat_normals(corners: np.ndarray) -> np.ndarray:
    normals = face_normals(corners)
    return np.repeat(normals[:, None], 3, axis=1)


def _texel_colours(
    field: GridField, atlas: Atlas, corners: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the radiance (k, 3) that the field shows at an atlas's texels."""
    points, facing = atlas.interpolate(corners), atlas.interpolate(normals)
    length = np.linalg.norm(facing, axis=1, keepdims=True)
    flat = _flat_normals(corners)[atlas.triangles, 0]
    facing = np.where(length > 1e-3, facing / np.maximum(length, 1e-3), flat)
    # a little inward, so that a ray at an edge meets the triangle's side of it
    offset = corners.mean(1)[atlas.triangles] - points
    away = np.linalg.norm(offset, axis=1, keepdims=True)
    reach = np.minimum(_INWARD, _INWARD * voxel_m(field) / np.maximum(away, 1e-30))
    return seen_colours(field, points + reach * offset, facing)
