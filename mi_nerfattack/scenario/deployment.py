"""The tables ``[deployment]``: environments in which an attack is verified."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import Parameter, signature
from typing import Annotated, Any, ClassVar, Literal, get_type_hints
from weakref import WeakKeyDictionary

from pydantic import Discriminator, Field, Tag, create_model

from mi_nerfattack.deploy.built_in import BuiltInObject, Shell, paint, shell_of
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import make_environment, offered_environment
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.io.resumable import array_digest, json_digest
from mi_nerfattack.ranges import Count, Finite, NonNegative
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.named_file import FileOrFolder
from mi_nerfattack.scenario.section import UNTAGGED, Kinds, Section, read_offered

#: Name of the environment of attacks.
SURROGATE = "surrogate"
#: What was built in last of a field, by its content: seconds each, and the same in all
#: environments and conditions.
_BUILT: WeakKeyDictionary[GridField, dict[str, BuiltInObject]] = WeakKeyDictionary()
_LOOKS = 4  # of a field that are kept
#: Geometry of what was built in last, by all that decides it.
_SHELLS: dict[str, Shell] = {}
_MAX_SHELLS = 4

Label = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,19}$")]
Sky = Literal["day", "morning", "noon", "evening", "overcast"]
Objects = Literal["pasted", "built-in"]


class AbstractDeploymentSection(Section):
    """What all have: a name, under which results stand; by default the kind."""

    name: Label | None = None
    group: ClassVar[str] = "mi_nerfattack.environments"
    #: Whether it is a server that one process steps.
    has_one_client: ClassVar[bool] = False

    def place(self, place: Place) -> Place:
        """Add what this environment needs of a place."""
        return place

    @property
    def settings(self) -> dict[str, Any]:
        """Further arguments of what makes the environment."""
        return {}

    @classmethod
    def offered(cls, name: str, known: Iterable[str]) -> tuple[type[Section], str]:
        """Make a section of the further arguments of another package's function.

        Raises:
            InputError: no package offers it, or an argument has no type.
        """
        offer = offered_environment(name, "is ", known)
        parameters = dict(list(signature(offer.value).parameters.items())[2:])
        hints = get_type_hints(offer.value, include_extras=True)
        keys: dict[str, Any] = {"kind": (Literal[name], ...)}
        for key, parameter in parameters.items():
            if key not in hints or key in OfferedDeployment.model_fields:
                raise offer.refuse(f"argument {key!r} has no type, or is taken")
            is_needed = parameter.default is Parameter.empty
            keys[key] = (hints[key], ... if is_needed else parameter.default)
        return create_model(name, __base__=OfferedDeployment, **keys), offer.package


class AbstractSimulatedDeployment(AbstractDeploymentSection):
    """A scene of ours under a sky, seen by a camera."""

    sky: Sky = "day"
    exposure_ev: Finite = 0.0
    blur_px: NonNegative = 0.0
    noise_sd: NonNegative = 0.0


class AbstractMeshDeployment(AbstractSimulatedDeployment):
    """The meshes of the scene, among which objects can be built in."""

    objects: Objects = "pasted"


class RenderedDeployment(AbstractMeshDeployment):
    """Images by Mitsuba; `mujoco` drives a car with wheels."""

    kind: Literal["mitsuba", "mujoco"] = "mitsuba"
    spp: Count = 16


class RasterisedDeployment(AbstractMeshDeployment):
    """Images by MuJoCo, and its car with wheels."""

    kind: Literal["mujoco_gl"]


class CarlaDeployment(AbstractDeploymentSection):
    """A running CARLA server; experimental."""

    kind: Literal["carla"]
    sky: Sky = "day"
    exposure_ev: Finite = 0.0
    server: str = "127.0.0.1:2000"  # HOST:PORT or HOST:PORT/TOWN
    has_one_client: ClassVar[bool] = True

    def place(self, place: Place) -> Place:
        """Name the server."""
        return replace(place, server=self.server)


class ReplayDeployment(AbstractDeploymentSection):
    """A recorded drive, in which controls have no effect."""

    kind: Literal["replay"]
    recording: FileOrFolder  # folder, video or MCAP log
    topics: tuple[str, ...] = ()  # of a log: "image=/front", "vehicle_pose=/odom"

    def place(self, place: Place) -> Place:
        """Name the recording."""
        return replace(place, recording=self.recording.file, topics=self.topics)


class OfferedDeployment(AbstractSimulatedDeployment):
    """An environment of another package; `AbstractDeploymentSection.offered` adds keys.

    Objects are pasted.
    """

    spp: Count = 16

    @property
    def settings(self) -> dict[str, Any]:
        """The keys that are arguments of the package's function."""
        ours = {*OfferedDeployment.model_fields, "kind"}
        return {key: value for key, value in self if key not in ours}

    def __reduce__(self) -> Any:
        """Let another process make the class again, which no module has."""
        return read_offered, (AbstractDeploymentSection, dict(self))


DeploymentSection = Annotated[
    RenderedDeployment | RasterisedDeployment | CarlaDeployment | ReplayDeployment,
    Kinds("mitsuba", AbstractDeploymentSection),
]
_Several = Annotated[tuple[DeploymentSection, ...], Field(min_length=1)]
#: A table, or an array of tables.
DeploymentSections = Annotated[
    Annotated[DeploymentSection, Tag("table")] | Annotated[_Several, Tag("array")],
    Discriminator(lambda sections: "array" if isinstance(sections, tuple) else "table"),
    UNTAGGED,
]


def labelled(deployment: DeploymentSections) -> list[tuple[str, DeploymentSection]]:
    """Return each section with its label: its name, or its kind if it has none."""
    sections = deployment if isinstance(deployment, tuple) else [deployment]
    return [(item.name or item.kind, item) for item in sections]


@dataclass(frozen=True, eq=False)
class Deployment:
    """An environment that can be opened with objects in it.

    Attributes:
        environment: key of `deploy.registry.ENVIRONMENTS`, or of another package.
        place: where.
        conditions: of light and camera.
        builds_in: objects become geometry of the scene, so that those of another look
            need another environment; otherwise they are shown as fields.
        settings: further arguments of the function of another package.
    """

    environment: str
    place: Place
    conditions: Conditions
    builds_in: bool
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_open_loop(self) -> bool:
        """Whether controls have no effect."""
        return self.environment == "replay"

    @property
    def moves_by_model(self) -> bool:
        """Whether the vehicle is the scenario's model, with all rows of its state."""
        return self.environment in ("mitsuba", "carla")

    @property
    def spp(self) -> int | None:
        """Samples per pixel; None where images are not made of samples."""
        return (
            self.conditions.spp if self.environment in ("mitsuba", "mujoco") else None
        )

    def open(self, objects: Sequence[PosedField]) -> AbstractEnvironment:
        """Make the environment, objects as they look and stand at present."""
        if self.builds_in:
            built_in = tuple(
                _built_in(item.field, item.placed)
                for item in objects
                if isinstance(item.field, GridField)
            )
            return self._make(replace(self.conditions, built_in=built_in))
        environment = self._make(self.conditions)
        environment.show(objects)
        return environment

    def _make(self, conditions: Conditions) -> AbstractEnvironment:
        return make_environment(
            self.environment, self.place, conditions, settings=self.settings
        )


def _built_in(field: GridField, pose: Pose) -> BuiltInObject:
    """Build in an object, or what was built in of a field with the same content."""
    values = [value.numpy() for value in field.parameters().values()]
    key = array_digest([*values, *field.occupancy_tensors().values()])
    looks = _BUILT.setdefault(field, {})
    built = looks.pop(key, None) or paint(_shell(field), field, pose)
    _remember(looks, key, built, most=_LOOKS)
    return replace(built, pose=pose)


def _shell(field: GridField) -> Shell:
    """Return the geometry of a field, which fields of other colours may share."""
    density = field.parameters()["density"].numpy()
    arrays = array_digest([density, *field.occupancy_tensors().values()])
    key = json_digest([arrays, field.metadata()])
    shell = _SHELLS.pop(key, None) or shell_of(field)
    _remember(_SHELLS, key, shell, most=_MAX_SHELLS)
    return shell


def _remember(cache: dict[str, Any], key: str, value: Any, most: int) -> None:
    """Add the newest value, and forget the oldest."""
    cache[key] = value
    while len(cache) > most:
        del cache[next(iter(cache))]


def deployments(sections: DeploymentSections, place: Place) -> Mapping[str, Deployment]:
    """Return the deployments of a scenario by label, in its order.

    Args:
        sections: of the deployments.
        place: where the scenario drives.
    """
    by_label = {}
    for label, section in labelled(sections):
        values = section.model_dump()
        names = ("sky", "exposure_ev", "spp", "blur_px", "noise_sd")
        conditions = Conditions(**{n: values[n] for n in names if n in values})
        builds_in, there = values.get("objects") == "built-in", section.place(place)
        by_label[label] = Deployment(
            section.kind,
            there,
            conditions,
            builds_in=builds_in,
            settings=section.settings,
        )
    return by_label
