"""What a policy sees: the interface of sensors that turn vehicle states into images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from typing_extensions import Self

from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.render.camera.rig import Layout
from mi_nerfattack.render.posed import PosedField


@dataclass(frozen=True)
class Observation:
    """One image per vehicle, and what its derivatives need.

    Attributes:
        image: tensor (n, height, width, 3), sRGB in [0, 1], evaluated.
        step: index of the control period.
        linear: (3, n height width), before the sRGB curve; None where the sensor has
            no derivatives, and where the frame has parts.
        integrator_state: what the scene's integrator hands to its derivatives.
        view: rays and their weights.
        per_camera: what each of several cameras saw, side by side in the image.
    """

    image: Any
    step: int = 0
    linear: Any = None
    integrator_state: Any = None
    view: Any = None
    per_camera: tuple[Observation, ...] = ()

    def __repr__(self) -> str:
        count, height, width, _ = self.image.shape
        return f"Observation({count} images {width}x{height})"


class AbstractSensor(ABC):
    """Camera on a vehicle in some world."""

    @abstractmethod
    def observe(self, state: Any, step: int) -> Observation:
        """Render what vehicles see.

        Args:
            state: (m, n), its first rows px, py (metres) and theta (radians); taken
                as a constant.
            step: index of the control period, from 0; seeds what is random.
        """

    @property
    def layout(self) -> Layout | None:
        """Where the images of several cameras lie in a frame; None for one camera."""
        return None

    def numbered(self, first: int) -> Self:
        """Return this sensor with another number of the first drive of each batch.

        What is random depends on a drive's number; by default, nothing is.
        """
        del first
        return self

    def drawing_as(self, other: AbstractSensor) -> Self:
        """Return this sensor with the numbers and the variation of another one."""
        del other
        return self


class AbstractDifferentiableSensor(AbstractSensor):
    """Sensor whose image can be differentiated by its parameters and by the state.

    Parameters have keys, like the parameters of a Mitsuba scene. The colours of the
    objects, which an attack changes, are also available as textures.
    """

    @abstractmethod
    def vjp(
        self, observation: Observation, state: Any, d_image: Any, attached: bool
    ) -> Any:
        """Accumulate the parameters' gradients and return the state's.

        Args:
            observation: from ``observe`` with the same state and step; there may
                have been others since.
            state: (m, n), as given to ``observe``.
            d_image: derivative of the objective by the image, of its shape.
            attached: whether to differentiate by the state.

        Returns:
            (3, n) derivative by px, py and theta; None when not `attached`.
        """

    @property
    @abstractmethod
    def keys(self) -> tuple[str, ...]:
        """Keys of the parameters that are differentiated."""

    @abstractmethod
    def select(self, keys: Sequence[str]) -> None:
        """Differentiate by other parameters.

        Raises:
            InputError: there is no such parameter, or it has no derivative here.
        """

    @abstractmethod
    def set_parameters(self, values: Mapping[str, Any]) -> None:
        """Replace parameters by detached values.

        Args:
            values: by key. A value that the sensor has already is left as it is, with
                its derivatives.

        Raises:
            InputError: there is no such parameter, or its value is not allowed.
        """

    @abstractmethod
    def start_gradient(self, extra_keys: Sequence[str] = ()) -> None:
        """Let the gradients of the selected parameters be zero.

        Args:
            extra_keys: keys of parameters to differentiate by, too.

        Raises:
            InputError: a parameter has no derivative; the message names what works.
        """

    @abstractmethod
    def gradients(self) -> dict[str, Any]:
        """Return what has been accumulated, by key, each of its parameter's shape."""

    def stop_gradient(self) -> None:
        """Leave no parameter attached, when the gradients have been read."""
        return

    # Objects

    @property
    @abstractmethod
    def objects(self) -> Sequence[PosedField]:
        """The objects whose colours are attacked, where they are."""

    @property
    def fields(self) -> list[GridField]:
        """Their fields."""
        fields = (posed.field for posed in self.objects)
        return [field for field in fields if isinstance(field, GridField)]

    @property
    def pose_keys(self) -> tuple[str, ...]:
        """Keys of the objects' poses, in their order."""
        return ()

    @abstractmethod
    def texture_gradients(self) -> list[Any]:
        """Return what has been accumulated, one tensor (n_vertices, 3) an object."""

    @abstractmethod
    def textures(self) -> list[Any]:
        """Return the textures, one tensor (n_vertices, 3) an object, raw colours."""

    @abstractmethod
    def set_textures(self, textures: list[Any]) -> None:
        """Replace the textures: one array (n_vertices, 3) an object, raw colours."""

    def keep(self, observation: Observation) -> Any:
        """Return what a backward pass must have kept to call :meth:`restore`."""
        return observation

    def restore(self, state: Any, step: int, record: Any) -> Observation:
        """Return an observation from what :meth:`keep` gave.

        Args:
            state: (m, n), as given to ``observe``.
            step: as given to ``observe``.
            record: of that observation.
        """
        del state, step
        return record
