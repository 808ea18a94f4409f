"""In which frames of a drive objects are seen, and how large."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mi_nerfattack.deploy.roadside.footprint import Stands
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.render.camera.projection import project

_NEAREST_M = 0.1


@dataclass(frozen=True, eq=False)
class VisiblePoints:
    """Points of one object that are seen in the frames of a drive, k of them.

    Attributes:
        frames: of the drive.
        frame: (k,), number of the frame.
        image: (k, 2), right and down in the image, pixels.
        eye: (k, 3), where the camera is, metres.
        point: (k, 3), metres.
    """

    frames: int
    frame: np.ndarray
    image: np.ndarray
    eye: np.ndarray
    point: np.ndarray

    def pixels(self) -> np.ndarray:
        """Estimate in how many pixels of each frame the object is seen, (frames,).

        Those with a point in them are counted. An area of w by h pixels touches
        (w + 1) (h + 1) of them on average, which is taken off.
        """
        touched = np.zeros(self.frames)
        if not len(self.frame):
            return touched
        cells = np.floor(self.image).astype(int)
        order = np.lexsort((cells[:, 1], cells[:, 0], self.frame))
        frame, cells, image = self.frame[order], cells[order], self.image[order]
        fresh = (np.diff(cells, axis=0, prepend=-1) != 0).any(1)
        first = np.flatnonzero(np.diff(frame, prepend=-1))
        fresh[first] = True
        span = np.maximum.reduceat(image, first) - np.minimum.reduceat(image, first)
        count = np.add.reduceat(fresh.astype(int), first)
        touched[frame[first]] = count * (span / (span + 1)).prod(1)
        return touched

    def without(self, box: Stands) -> VisiblePoints:
        """Leave out the points behind the first of some boxes."""
        rows = ~box.hides(self.eye, self.point)
        names = ("frame", "image", "eye", "point")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def look(
    surroundings: Surroundings, poses: np.ndarray, stands: Stands
) -> Iterator[VisiblePoints]:
    """Find the points of each box that the scene does not hide, box by box.

    Args:
        surroundings: scene and camera.
        poses: camera_to_world (m, 4, 4).
        stands: the boxes.
    """
    points = stands.body()
    turns, eyes = poses[:, :3, :3], poses[:, :3, 3]
    # one product for all frames: (n, points, m, 3)
    local = points @ turns.transpose(1, 0, 2).reshape(3, -1)
    local = local.reshape(*points.shape[:2], *eyes.shape)
    local -= (eyes[:, None] @ turns)[:, 0]
    image, inside = project(surroundings.camera, local, _NEAREST_M)
    box, which, frame = np.nonzero(inside)
    eye, point = eyes[frame], points[box, which]
    open_ = surroundings.visible(eye, point) if len(box) else np.zeros(0, bool)
    for row in range(len(stands)):
        mine = open_ & (box == row)
        where = image[box[mine], which[mine], frame[mine]]
        yield VisiblePoints(
            len(poses), frame[mine], where, eye=eye[mine], point=point[mine]
        )
