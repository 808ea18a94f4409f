"""The section ``[[objects]]``: what is attacked, one section each kind."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.fields import GridField, load_grid
from mi_nerfattack.ranges import Finite, Positive
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.scenario.named_file import File, NamedFile
from mi_nerfattack.scenario.section import Kinds, Section, refuse

if TYPE_CHECKING:
    from mi_nerfattack.capture.mesh.flat import FlatObject

Triple = tuple[Finite, Finite, Finite]


class AbstractObjectSection(Section):
    """An object whose texture is attacked."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    position_m: Triple | None = None  # not with scene.surrogate
    yaw_deg: Finite = 0.0

    @property
    def pose(self) -> Pose:
        """Object to world."""
        assert self.position_m is not None  # checked by Scenario
        return Pose.upright(self.position_m, np.radians(self.yaw_deg), self._scale)

    @property
    def named(self) -> NamedFile | None:
        """The grid field file; None for objects that have none."""
        return None

    @property
    def _scale(self) -> float:
        return 1.0

    @abstractmethod
    def load(self, saved: Path | None = None) -> GridField:
        """Make the field, with its marching step.

        Args:
            saved: field file of this object in a run folder; None for the original.

        Raises:
            InputError: a file is missing or wrong.
        """


class FieldObjectSection(AbstractObjectSection):
    """An object of a file."""

    kind: Annotated[Literal["field"], Field(exclude=True)] = "field"
    field: File | None = None  # grid field file; not with scene.surrogate
    scale: Positive = 1.0
    step_m: Positive | None = None  # of the march, before `scale`; the field's own

    @property
    def named(self) -> NamedFile | None:
        """The grid field file; None with `scene.surrogate`."""
        return self.field

    @property
    def _scale(self) -> float:
        return self.scale

    def load(self, saved: Path | None = None) -> GridField:
        """See :meth:`AbstractObjectSection.load`."""
        if saved is None:
            assert self.field is not None  # checked by Scenario
            saved = self.field.file
        field = load_grid(saved)
        field.refine(self.step_m or field.step_m)
        return field


class FlatObjectSection(AbstractObjectSection):
    """A thin sheet that shows a picture: see `FlatObject`."""

    kind: Literal["billboard", "patch"]
    width_m: Positive
    height_m: Positive  # of the picture; of a patch, along the lane
    picture: File | None = None  # the original; grey
    pixels_per_m: Positive = 32.0

    def load(self, saved: Path | None = None) -> GridField:
        """See :meth:`AbstractObjectSection.load`."""
        if saved is not None:
            return load_grid(saved)
        picture = None
        if self.picture is not None:
            from mi_nerfattack.capture.mesh.flat import read_picture

            picture = read_picture(self.picture.file)
        return self._flat().field(picture)

    def _flat(self) -> FlatObject:
        from mi_nerfattack.capture.mesh.flat import FlatObject  # most have none

        return FlatObject(
            self.kind, self.width_m, self.height_m, pixels_per_m=self.pixels_per_m
        )

    @model_validator(mode="after")
    def _check_size(self) -> Any:
        try:
            self._flat()
        except InputError as error:
            key, _, problem = str(error).partition(": ")
            refuse(key, problem)
        return self


ObjectSection = Annotated[FieldObjectSection | FlatObjectSection, Kinds("field")]
