"""A policy as commands take it, and what its TOML file says besides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.commands.shared.evaluate_options import PlaceOptions
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.render.camera.rig import Rig
    from mi_nerfattack.scenario.policy.base import AbstractPolicySection
    from mi_nerfattack.scenario.scenario import Scenario
    from mi_nerfattack.scenario.vehicle import AbstractVehicleSection

#: The policy where none is given.
BUNDLED_POLICY = "bundled:policy/pilotnet.safetensors"


@dataclass(frozen=True)
class PolicyFile:
    """A scenario, or sections of one that describe what drives.

    Attributes:
        name: for messages.
        policy: the section [policy], if there is one.
        rig: of the section [camera], or of [[cameras]].
        vehicle: the section [vehicle].
        scenario: all of it, where there is a section [scene].
    """

    name: str
    policy: AbstractPolicySection | None = None
    rig: Rig | None = None
    vehicle: AbstractVehicleSection | None = None
    scenario: Scenario | None = None

    @property
    def views(self) -> dict[str, tuple[slice, slice]]:
        """Rows and columns of the cameras' images in a frame, see `Rig.views`."""
        return {} if self.rig is None else self.rig.views

    @classmethod
    def read(cls, policy: str | None, settings: Sequence[str] = ()) -> PolicyFile:
        """Read a policy.

        Args:
            policy: TOML file, bundled or not; else the file or URL of a policy, which
                counts as a TOML file with nothing but ``policy.file`` or
                ``policy.url``; None for the bundled policy.
            settings: keys that replace those of the file, see `overrides.set_keys`.

        Raises:
            InputError: a key or a section is not usable.
        """
        from mi_nerfattack.scenario.policy.kinds import PolicySection
        from mi_nerfattack.scenario.scenario import load_scenario
        from mi_nerfattack.scenario.section import (
            CameraSection,
            CameraSections,
            read_section,
            rig_of,
        )
        from mi_nerfattack.scenario.vehicle import VehicleSection

        name = policy or BUNDLED_POLICY
        path, folder, values = _read_values(name, settings)
        if "scene" in values and "policy" in values:
            scenario, _ = load_scenario(path, settings=settings)
            rig, vehicle = scenario.rig(), scenario.vehicle
            return cls(name, scenario.policy, rig, vehicle, scenario)
        if "scene" in values:
            raise InputError(
                f"{name}: policy: is missing next to [scene]; add [policy]"
            )
        sections: dict[str, Any] = {}
        for key, kind in (
            ("policy", PolicySection),
            ("camera", CameraSection),
            ("cameras", CameraSections),
            ("vehicle", VehicleSection),
        ):
            if key in values:
                value = values.pop(key)
                sections[key] = read_section(
                    f"{name}: {key}", kind, value, folder=folder
                )
        if sections and values:
            raise InputError(
                f"{name}: {', '.join(values)}: has no effect without [scene]; allowed: "
                "policy, camera or cameras, vehicle"
            )
        if {"camera", "cameras"} <= set(sections):
            raise InputError(
                f"{name}: cameras: stands beside [camera]; give one of them"
            )
        rig = None
        if "camera" in sections:
            rig = sections["camera"].rig()
        elif "cameras" in sections:
            rig = rig_of(sections["cameras"])
        return cls(name, sections.get("policy"), rig, sections.get("vehicle"))

    @property
    def section(self) -> AbstractPolicySection:
        """The section [policy]; InputError where there is none."""
        if self.policy is None:
            raise InputError(f"{self.name}: has no section [policy]")
        return self.policy

    def control(self) -> tuple[str | None, float | None]:
        """Return the unit of its control, and the wheelbase that its angles are for.

        Each is None where nothing says it.

        Raises:
            InputError: the policy's file and the section [vehicle] differ.
        """
        from mi_nerfattack.scenario.policy.base import misfit

        section, vehicle = self.section, self.vehicle
        if vehicle is None or not vehicle.has_expert:
            unit = section.unit()
            return None if unit == "other" else unit, None
        if reason := misfit(section.unit(), vehicle.unit, section.source):
            raise InputError(f"{self.name}: vehicle.kind: this one {reason}")
        wheelbase_m = round(vehicle.car().wheelbase, 6)
        return vehicle.unit, wheelbase_m if vehicle.unit == "rad" else None

    def check_wheels(self, option: str, environments: Sequence[str]) -> None:
        """Raise `InputError` if a custom vehicle is to drive where cars have wheels.

        Args:
            option: that names the environments.
            environments: their names.
        """
        wheels = [name for name in environments if name.startswith("mujoco")]
        if wheels and self.vehicle is not None and not self.vehicle.fits_wheels:
            raise InputError(
                f"{option}: {wheels[0]} drives a car with wheels, whose control is not "
                "that of a custom vehicle; leave it out"
            )

    def keeps_place(self, options: PlaceOptions) -> bool:
        """Whether this is a scenario, and no option names another place."""
        return self.scenario is not None and not options.names_place

    def place(self, options: PlaceOptions) -> Place:
        """Return where the policy drives, with its camera and its car.

        Without --place, --scene and --server, a scenario keeps its place, and the other
        options replace parts of this place.

        Args:
            options: of the command.

        Raises:
            InputError: the scenario's surrogate is a Mitsuba scene, or an object has no
                file.
        """
        base = self._own_place(options) if self.keeps_place(options) else None
        place = options.build(base)
        if self.rig is not None:
            place = place.with_rig(self.rig)
        if self.vehicle is not None:
            car, period = self.vehicle.car(), self.vehicle.dt_s
            place = replace(place, car=car, period=period)
        return place

    def _own_place(self, options: PlaceOptions) -> Place:
        """Return the scenario's place, with camera and car of the bundled one."""
        from mi_nerfattack.deploy.place import bundled_place
        from mi_nerfattack.fields.io import holds_splats

        assert self.scenario is not None
        scene = self.scenario.scene
        if scene.surrogate is not None:
            raise InputError(
                f"scene.surrogate: {scene.surrogate}: a Mitsuba scene, which tells "
                "no camera to other environments; give --scene, --routes-file and "
                "the policy in a file with [policy] and [camera]"
            )
        field = None if scene.field is None else scene.field.file
        if field and holds_splats(field):
            field = None
        is_moved = field is not None and scene.to_world is not None
        return replace(
            bundled_place("intersection"),
            scene=scene.deployment.file,
            field=field,
            field_pose=scene.pose if is_moved else None,
            routes=scene.routes.file,
            objects=options.object or tuple(self._object_files()),
        )

    def _object_files(self) -> Iterator[Path]:
        """Yield the field files of the scenario's objects.

        Raises:
            InputError: an object has none.
        """
        assert self.scenario is not None
        for index, item in enumerate(self.scenario.objects):
            if item.named is None:
                raise InputError(
                    f"objects.{index}: a flat object without a file; places are drawn "
                    "for files: write one with 'mi-nerfattack asset flat', and name it "
                    "as field, or as --object"
                )
            yield item.named.file


def read_camera(name: str) -> Rig:
    """Read [camera] alone: a car's computer has no code for other sections.

    Raises:
        InputError: it is not usable, or there is none.
    """
    from mi_nerfattack.scenario.section import CameraSection, read_section

    _, folder, values = _read_values(name)
    if "cameras" in values:
        raise InputError(f"{name}: cameras: several; the car has one: give [camera]")
    if not {"camera", "scene"} & set(values):
        raise InputError(f"{name}: has no section [camera]")
    where, camera = f"{name}: camera", values.get("camera", {})
    return read_section(where, CameraSection, camera, folder=folder).rig()


def _read_values(
    name: str, settings: Sequence[str] = ()
) -> tuple[Path, Path, dict[str, Any]]:
    """Return a policy's file, the folder that its paths start from, and its keys."""
    import tomlkit

    from mi_nerfattack.io import files
    from mi_nerfattack.io.overrides import set_keys
    from mi_nerfattack.io.strict import parse_toml
    from mi_nerfattack.scenes import resolve

    path, folder = Path(name), Path()
    if name.lower().endswith(".toml"):
        path = resolve(name)
        text, folder = files.read_text(path, files.MAX_TOML_BYTES), path.parent
    else:
        key = "url" if name.startswith(("http://", "https://")) else "file"
        text = tomlkit.dumps({"policy": {key: name}})
    return path, folder, parse_toml(name, set_keys(name, text, settings))
