"""What a policy's TOML file says besides how the policy is called."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount
    from mi_nerfattack.scenario.scenario import Scenario
    from mi_nerfattack.scenario.vehicle import AbstractVehicleSection


@dataclass(frozen=True)
class PolicyFile:
    """A scenario, or a file with the sections of one that describe what drives.

    Attributes:
        camera: of the section [camera].
        vehicle: the section [vehicle].
        scenario: all of it, where there is a section [scene].
    """

    camera: tuple[Camera, CameraMount] | None = None
    vehicle: AbstractVehicleSection | None = None
    scenario: Scenario | None = None

    @classmethod
    def read(cls, policy: str | None) -> PolicyFile:
        """Read the file of a policy; one that is no TOML file says nothing.

        Args:
            policy: as given to `PolicyOptions.section`.

        Raises:
            InputError: a section is not usable.
        """
        from mi_nerfattack.scenario.scenario import load_scenario
        from mi_nerfattack.scenario.section import read_section
        from mi_nerfattack.scenario.vehicle import CameraSection, VehicleSection

        if not is_toml(policy):
            return cls()
        values, path = read_toml(policy)
        if "scene" in values:
            scenario, _ = load_scenario(path)
            return cls(scenario.camera.build(), scenario.vehicle, scenario)
        found: dict[str, Any] = {}
        for key, kind in (("camera", CameraSection), ("vehicle", VehicleSection)):
            if key in values:
                name = f"{policy}: {key}"
                found[key] = read_section(name, kind, values[key], path.parent)
        camera = found.get("camera")
        return cls(camera and camera.build(), found.get("vehicle"))

    def place(self, place: Place, is_chosen: bool) -> Place:
        """Return where the policy drives, with its camera and its car.

        Args:
            place: of the command's options.
            is_chosen: whether these name one; otherwise it is the scenario's.

        Raises:
            InputError: the scenario's surrogate is a Mitsuba scene.
        """
        if self.scenario is not None and not is_chosen:
            scene = self.scenario.scene
            if scene.surrogate is not None:
                raise InputError(
                    f"scene.surrogate: {scene.surrogate}: a Mitsuba scene, which tells "
                    "no camera to other environments; give --scene, --routes-file and "
                    "the policy in a file with [policy] and [camera]"
                )
            field = None if scene.field is None else scene.field.file
            if field and field.suffix == ".ply":
                field = None
            fields = [item.field for item in self.scenario.objects]
            place = replace(
                place,
                scene=scene.deployment.file,
                field=field,
                field_pose=None if scene.to_world is None else scene.pose,
                routes=scene.routes.file,
                objects=tuple(item.file for item in fields if item is not None),
            )
        if self.camera is not None:
            place = replace(place, camera=self.camera[0], mount=self.camera[1])
        if self.vehicle is not None:
            car, period = self.vehicle.car(), self.vehicle.dt_s
            place = replace(place, car=car, period=period)
        return place


def is_toml(policy: str | None) -> TypeGuard[str]:
    """Whether a policy is given as a TOML file."""
    return policy is not None and policy.lower().endswith(".toml")


def read_toml(policy: str) -> tuple[dict[str, Any], Path]:
    """Read a policy's TOML file, bundled or not, and return where it is."""
    from mi_nerfattack.io import files
    from mi_nerfattack.scenes import resolve

    path = resolve(policy)
    return files.read_toml(path), path
