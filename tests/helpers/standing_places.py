"""A judgement of drawn places that shares nothing with the rule that drew them.

Where objects stand is told by `experiment.checks.standing`, by their solid points; in
view is what a z-buffer of the solid parts' own triangles shows in front of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.capture.mesh.mitsuba_mesh import MeshArrays, make_mesh
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.experiment.checks.standing import (
    Solid,
    lane_findings,
    meeting_findings,
    scene_findings,
)
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.render.camera.intrinsics import (
    generate_rays,
    mount_matrix,
    pose_arrays,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.route.route import Route


def solid_box(length: float, width: float, height: float) -> GridField:
    """Opaque box that stands on z = 0, 8 cells along each side."""
    half = np.array([length, width]) / 2
    lower, upper = np.array([*-half, 0.0]), np.array([*half, height])
    return GridField(GridLayout(3, 5, 12), lower, upper, density_scale=60.0)


@dataclass(eq=False)
class Judge:
    """Looks at the objects of drives along one route.

    Args:
        around: scene, lanes and camera.
        route: that is driven.
        end: arc length at which a drive from 0 ends, metres.
    """

    around: Surroundings
    route: Route
    end: float

    def findings(self, fields: Sequence[GridField], poses: Sequence[Pose]) -> list[str]:
        """Tell what is wrong with places; nothing if all is right."""
        pairs = enumerate(zip(fields, poses, strict=True))
        solids = [Solid.of(f"{i}", PosedField(*pair)) for i, pair in pairs]
        around = self.around
        found = list(meeting_findings(solids))
        for route in around.routes:  # as if a car were as wide as the lane
            found += lane_findings(solids, route, route.lane_width_m, Freedom())
        return found + list(scene_findings(solids, self.route, around.scene, "scene"))

    def seconds(
        self, fields: Sequence[GridField], poses: Sequence[Pose], px: int
    ) -> np.ndarray:
        """Return how long each object shows at least so many pixels, seconds."""
        return self.around.period * (self.pixels(fields, poses) >= px).sum(1)

    def pixels(self, fields: Sequence[GridField], poses: Sequence[Pose]) -> np.ndarray:
        """Count the pixels in which each object is seen, (objects, frames)."""
        meshes = [faces(*pair) for pair in zip(fields, poses, strict=True)]
        scene = mi.load_dict(
            {"type": "scene", **{f"o{i}": mesh for i, mesh in enumerate(meshes)}},
            parallel=False,
        )
        ray, behind, count = self._drive
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        seen = hit.t.numpy() < behind
        number = np.full(len(seen), -1)
        for one in scene.shapes():
            number[(hit.shape == mi.ShapePtr(one)).numpy() & seen] = int(one.id()[1:])
        number = number.reshape(count, -1)
        return np.stack([(number == i).sum(1) for i in range(len(meshes))])

    @cached_property
    def _drive(self):
        """Rays of all pixels of a drive, how far they reach, number of frames."""
        step = self.route.speed_ms * self.around.period
        arc = np.arange(0, self.end + 1e-6, step)
        states = self.route.pose_at(arc)
        poses = mount_matrix(states, self.around.mount)
        rays = generate_rays(self.around.camera, *pose_arrays(poses), len(poses))
        ray = mi.Ray3f(*rays)
        dr.eval(ray)
        hit = self.around.scene.ray_intersect_preliminary(ray, coherent=True)
        return ray, hit.t.numpy(), len(poses)


def faces(field: GridField, pose: Pose) -> mi.Shape:
    """Return the outside of the solid cells of an object, of a lattice of 32."""
    cells, count = solid_cells(field), 32
    corners = np.concatenate(list(_quads(np.pad(cells, 1))))
    local = field.lower + corners.reshape(-1, 3) / count * (field.upper - field.lower)
    world = pose.scale * local @ pose.rotation.T + pose.translation
    quads = np.arange(len(world)).reshape(-1, 4)
    index = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return make_mesh("object", MeshArrays(world, index))


def solid_cells(field: GridField) -> np.ndarray:
    """Tell which cells of a lattice of 32 are solid, as `Solid` does."""
    solid = Solid.of("", PosedField(field)).points
    index = (solid - field.lower) / (field.upper - field.lower) * 32
    cells = np.zeros((32, 32, 32), bool)
    cells[tuple(np.floor(index).astype(int).T)] = True
    return cells


def _quads(padded: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the corners (n, 4, 3) of the sides between solid and empty cells."""
    for axis in range(3):
        one, other = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        change = np.argwhere(np.diff(padded, axis=axis))
        start = change - 1 + np.eye(3, dtype=int)[axis]
        yield np.stack([start, start + one, start + one + other, start + other], 1)
