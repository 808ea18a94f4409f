"""The surface of an object's field as a mesh with the field's colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from mi_nerfattack.capture.mesh.cube_faces import OBJECT_BOX, object_box, sheet_mesh
from mi_nerfattack.capture.mesh.mesh import TexturedMesh
from mi_nerfattack.errors import InputError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays

_OPAQUE = 0.5  # opacity of one voxel from which there is a surface
_BLOCK = np.ones((3, 3, 3))
_PINHOLE = 3  # voxels, half the width of the largest hole in a shell
_SPECK = 1e-3  # of the largest part's voxels
_SURFACE_OVER, _NORMALS_OVER = 0.6, 1.5  # voxels, standard deviations of smoothing
_OUTSIDE, _BEHIND = 1.5, 4.0  # voxels that colours are looked at from, and beyond
_FAINT = 1e-2
_CHUNK = 1 << 20
_BOX_OFF = 2.0  # voxels that a mesh's box may be off
_MAX_TRIANGLES = 4_000_000


@dataclass(frozen=True, eq=False)
class ColouredMesh:
    """Triangles with a colour at each vertex.

    Attributes:
        vertices: (n, 3), metres, z up.
        faces: (m, 3), counter-clockwise from outside.
        normals: (n, 3), unit vectors to the outside.
        colours: (n, 3), linear Rec. 709 radiance.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


def field_surface(field: GridField) -> ColouredMesh:
    """Return the surface where a field becomes opaque.

    Marching cubes over the opacity of one voxel, `1 - exp(-density voxel)`, at the
    field's finest resolution, at 0.5. Pinholes are closed and hollows that nobody
    sees filled, specks below a thousandth of the largest part left out. The
    surface of a flat object is the face that shows its picture.

    Args:
        field: the object.

    Raises:
        InputError: the field is nowhere opaque.
    """
    if (sheet := sheet_mesh(field)) is not None:
        return painted_mesh(field, sheet)
    measure = load_extra("skimage.measure", "the surface of a field")
    voxel = voxel_m(field)
    solid = _solid(_voxel_opacity(field, voxel))
    grid_vertices, faces, _, _ = measure.marching_cubes(solid, _OPAQUE)
    smooth = ndimage.gaussian_filter(solid, _NORMALS_OVER)
    slope = np.stack(
        [
            ndimage.map_coordinates(along, grid_vertices.T, order=1)
            for along in np.gradient(smooth)
        ],
        axis=1,
    )
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normals = -slope / np.maximum(length, 1e-30)
    # one ring of empty voxels lies around the box
    vertices = field.lower + voxel * (grid_vertices.astype(np.float64) - 1)
    faces = _turned_outward(vertices, faces, normals)
    colours = seen_colours(field, vertices, normals)
    return ColouredMesh(vertices, faces, normals, colours=colours)


def painted_mesh(field: GridField, mesh: TexturedMesh) -> ColouredMesh:
    """Return a mesh's own triangles with a field's colours.

    The triangles are divided until no edge is longer than a voxel. Where they meet at
    an angle each has vertices of its own, so that colours meet sharply there.

    Args:
        field: fitted to the mesh.
        mesh: placed as it was for the fit.

    Raises:
        InputError: the mesh's box is not that of the object, or it is too fine.
    """
    voxel = voxel_m(field)
    check_same_box(field, mesh)
    corners = _divided(mesh, voxel)
    normal = face_normals(corners).repeat(3, axis=0)
    rows = np.concatenate([corners.reshape(-1, 3), normal], axis=1)
    # corners at one point and in one plane are one vertex
    unit = np.repeat([1e-4 * voxel, 1e-4], 3)
    keys = np.round(rows / unit).astype(np.int64)
    _, first, faces = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices, normals = rows[first, :3], rows[first, 3:]
    side = np.where(inside_out(field, vertices, normals)[:, None], -1.0, 1.0)
    # a little inside of its triangles, so that a ray at an edge meets their side
    middle, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for corner in range(3):
        np.add.at(middle, faces[:, corner], corners.mean(1))
        np.add.at(count, faces[:, corner], 1.0)
    inner = 0.9 * vertices + 0.1 * middle / count[:, None]
    colours = seen_colours(field, inner, side * normals)
    return ColouredMesh(vertices, faces, normals, colours=colours)


def check_same_box(field: GridField, mesh: TexturedMesh) -> None:
    """Raise InputError unless the mesh has the box of the object, up to two voxels.

    Where the field's header has no box of the object, the mesh need only lie within
    the field's box, because the field is larger than the mesh by an unknown amount.
    """
    (low, high), (lower, upper) = mesh.bounds, object_box(field)
    beyond = np.concatenate([lower - low, high - upper])
    if set(OBJECT_BOX) <= field.info.keys():
        beyond = np.abs(beyond)
    if beyond.max() > _BOX_OFF * voxel_m(field):
        raise InputError(
            f"{mesh.name}: reaches from {low.round(3)} to {high.round(3)} m, the "
            f"field's object from {lower.round(3)} to {upper.round(3)} m; give the "
            "size and axes that the field was made with"
        )


def inside_out(field: GridField, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Tell where a field is denser in front of a surface than behind it, (n,).

    Args:
        field: the object.
        points: (n, 3) on the surface, metres.
        normals: (n, 3), unit vectors.
    """
    step = voxel_m(field) * normals
    return _density(field, points + step) > _density(field, points - step)


def _divided(mesh: TexturedMesh, edge_m: float) -> np.ndarray:
    """Divide triangles until no edge is longer: corners (n, 3, 3), none degenerate."""
    remesh = load_extra("trimesh.remesh", "the surface of a mesh")
    triangles = []
    for part in mesh.submeshes:
        corners = part.vertices[part.faces]
        edges = corners - np.roll(corners, 1, axis=1)
        longest = float(np.linalg.norm(edges, axis=2).max())
        rounds = int(np.ceil(np.log2(max(1.0, longest / edge_m)))) + 1
        divided = remesh.subdivide_to_size(
            part.vertices, part.faces[has_area(corners)], edge_m, max_iter=rounds
        )
        triangles.append(divided[0][divided[1]])
        if sum(map(len, triangles)) > _MAX_TRIANGLES:
            raise InputError(
                f"{mesh.name}: more than {_MAX_TRIANGLES} triangles; simplify it"
            )
    corners = np.concatenate(triangles)
    return corners[has_area(corners)]


def has_area(corners: np.ndarray) -> np.ndarray:
    """Tell which triangles (m, 3, 3) have an area, (m,)."""
    return np.linalg.norm(_cross(corners), axis=1) > 0


def face_normals(corners: np.ndarray) -> np.ndarray:
    """Return the unit vectors (m, 3) across triangles (m, 3, 3) that have an area."""
    across = _cross(corners)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def _cross(corners: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(corners, 1, 0)
    return np.cross(b - a, c - a)


def seen_colours(
    field: GridField, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return the colours that a field shows at points of its surface.

    A ray comes from 1.5 voxels outside and goes on for 4 behind the point; its radiance
    is divided by its opacity. Where it meets next to nothing, the field's
    colour at the point itself is taken.

    Args:
        field: the object.
        points: (n, 3), metres.
        normals: (n, 3), unit vectors to the outside.

    Returns:
        (n, 3), float64, linear.
    """
    voxel, posed = voxel_m(field), PosedField(field)
    far, half = mi.Float((_OUTSIDE + _BEHIND) * voxel), mi.Float(0.5)
    dr.make_opaque(far, half)
    result = np.empty((len(points), 3))
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        eye = points[part] + _OUTSIDE * voxel * normals[part]
        origin, direction = _point(eye), mi.Vector3f(_point(-normals[part]))
        with dr.suspend_grad():
            integrals = march(posed, Rays(origin, direction, far, jitter=half))
            point = _point(points[part])
            _, own = field.eval(point, direction, mi.Bool(True))
            clear = integrals.opacity > _FAINT
            weight = dr.select(clear, integrals.opacity, 1)
            colour = dr.select(clear, integrals.radiance / weight, own)
        result[part] = colour.numpy().T
    return result


def voxel_m(field: GridField) -> float:
    """Return the edge of a voxel of the finest level, metres."""
    return float((field.upper - field.lower).max()) / field.layout.max_resolution


def _voxel_opacity(field: GridField, voxel: float) -> np.ndarray:
    """Sample the opacity of one voxel, with a ring of zeros around the box."""
    counts = np.ceil((field.upper - field.lower) / voxel - 1e-6).astype(int) + 3
    axes = [
        low + voxel * (np.arange(count) - 1)
        for low, count in zip(field.lower, counts, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    opacity = -np.expm1(-voxel * _density(field, grid)).reshape(counts)
    for axis in range(3):
        for end in (0, -1):
            np.moveaxis(opacity, axis, 0)[end] = 0
    return opacity


def _density(field: GridField, points: np.ndarray) -> np.ndarray:
    """Evaluate the density (n,), 0 outside the box."""
    result = np.empty(len(points))
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        point = _point(points[part])
        unit = field.unit(point)
        inside = dr.all((unit >= 0) & (unit <= 1))
        result[part] = field.density(point, inside).numpy()
    return result


def _point(array: np.ndarray) -> mi.Point3f:
    return mi.Point3f(np.ascontiguousarray(array.T, np.float32))


def _solid(opacity: np.ndarray) -> np.ndarray:
    """Fill hollows behind pinholes and leave out specks; values of about 0 and 1."""
    opaque = opacity > _OPAQUE
    filled = opaque | _hollows(opaque)
    if not filled.any():
        raise InputError("the field is nowhere opaque, so that it has no surface")
    labels = np.zeros(filled.shape, np.int32)
    ndimage.label(filled, _BLOCK, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    bodies = (sizes >= _SPECK * sizes.max())[labels] & filled
    near = ndimage.binary_dilation(bodies, _BLOCK)
    solid = np.maximum(np.where(near, opacity, 0), bodies)
    return ndimage.gaussian_filter(solid, _SURFACE_OVER)


def _hollows(opaque: np.ndarray) -> np.ndarray:
    """Find what shells enclose, with their pinholes of up to six voxels.

    Thickening a shell closes its pinholes; what it then encloses is grown back to the
    inside of the shell. Dents that are open to the outside stay open.
    """
    hollows = np.zeros_like(opaque)
    for reach in range(1, _PINHOLE + 1):
        # room for the thickened shell, so that the outside stays connected
        thick: Any = ndimage.binary_dilation(np.pad(opaque, reach), _BLOCK, reach)
        core: Any = ndimage.binary_fill_holes(thick)
        core &= ~thick
        grown = ndimage.binary_dilation(core, _BLOCK, reach + 1)
        hollows |= grown[(slice(reach, -reach),) * 3]
    return hollows


def _turned_outward(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Order corners counter-clockwise as seen from where the normals point."""
    outward = (_cross(vertices[faces]) * normals[faces].mean(1)).sum()
    return faces if outward > 0 else faces[:, ::-1]
