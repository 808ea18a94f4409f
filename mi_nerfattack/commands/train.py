"""``mi-nerfattack train``: imitate the lane-following expert, and validate."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from mi_nerfattack.commands.shared.evaluate_options import (
    Facing,
    PlaceOptions,
    parse_scales,
)
from mi_nerfattack.commands.shared.options import Settings, command_line
from mi_nerfattack.commands.shared.policy_file import PolicyFile
from mi_nerfattack.commands.shared.terminal import Result, console
from mi_nerfattack.errors import InputError

if TYPE_CHECKING:
    from mi_nerfattack.deploy.place import Place
    from mi_nerfattack.deploy.sites import AbstractSite
    from mi_nerfattack.training.presets import Preset
    from mi_nerfattack.training.settings import ImitationSettings
    from mi_nerfattack.vehicle.route.route import Route

#: Environments that cannot train, and what to do.
_REFUSED = {
    "carla": "a server answers to one client, and training needs several; train in "
    "another environment, and drive in CARLA with 'mi-nerfattack evaluate'",
    "replay": "a recording does not answer to a policy; train in another environment",
}


@dataclass(frozen=True)
class Train:
    """Train a driving policy on frames of any environments of a place.

    Collects frames, most with objects of random texture. Trains PilotNet to imitate the
    expert, also where it drives itself (DAgger). Continues from DATA.
    """

    continues: ClassVar[bool] = True

    data: Path
    """Folder of frames and checkpoints."""
    output: Path | None = None
    """Policy file to write (.safetensors)."""
    frames_only: bool = False
    """Collect frames and train no policy."""
    like: str | None = None
    """TOML file of evaluate: its camera, vehicle and scene."""
    settings: Settings = ()
    """Set a key of that file: vehicle.trust_code=true."""
    preset: str = "laptop"
    """Sizes: laptop, intersection or room."""
    scene: Path | None = None
    """Mitsuba scene (.xml); needs --routes-file."""
    field: Path | None = None
    """Field file of the scene, for the surrogate."""
    object: tuple[Path, ...] = ()
    """Grid fields at the roadside; by default the place's."""
    routes_file: Path | None = None
    """Routes file (.json); by default the place's."""
    frames: dict[str, int] | None = None
    """Frames by environment: surrogate 4096 mitsuba 6144."""
    validation_frames: dict[str, int] | None = None
    """Frames of a collection for the held-out loss."""
    more: tuple[Path, ...] = ()
    """Folders of earlier collections to train on, too."""
    start: Path | None = None
    """Policy with the first weights, also bundled:FILE."""
    skies: tuple[str, ...] = ()
    """Times of day, as of evaluate; all, or day for --scene."""
    exposures_ev: tuple[float, ...] = ()
    """Exposures of rendered frames, in powers of two."""
    spp: int = 4
    """Samples per pixel of path-traced frames."""
    epochs: int | None = None
    """Passes over the frames."""
    batch: int = 64
    """Images of a training step."""
    learning_rate: float = 1e-3
    """Largest learning rate."""
    dagger_rounds: int | None = None
    """Rounds in which the policy itself drives."""
    dagger_frames: dict[str, int] | None = None
    """Frames of each round."""
    dagger_epochs: int | None = None
    """Passes over all frames after a round."""
    validate_every: int = 4
    """Epochs between validations by drives."""
    validate_in: tuple[str, ...] = ()
    """Their environments; all that are used by default."""
    runs: int = 2
    """Drives per case of the last validation."""
    most_objects: int | None = None
    """Most objects at the roadside in a frame; 0: none."""
    scale: tuple[float, ...] = ()
    """Least and most factor to the size, as of evaluate."""
    facing: Facing = "shape"
    """What faces the traffic."""
    waypoints_s: tuple[float, ...] = ()
    """Times of the frames' waypoints; 0.5 1 1.5 2."""
    objects: tuple[int, ...] = (1,)
    """Numbers of objects in the last validation."""
    workers: int | None = None
    """Processes that collect; one a core by default."""
    seed: int = 0
    """Seed of all random numbers."""
    json: bool = False
    """End with one line of JSON, the policy's record."""

    def run(self) -> Result:
        """Collect, train, validate and write."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.policy.pilotnet import PilotNet
        from mi_nerfattack.report.table import card_table
        from mi_nerfattack.scenes import resolve
        from mi_nerfattack.system.workers import Processes, available_cores
        from mi_nerfattack.training.dataset import find_shards
        from mi_nerfattack.training.imitate import collect_frames, imitate
        from mi_nerfattack.training.record import (
            count_frames,
            training_record,
            write_trained,
        )

        output = self._checked_output()
        variant.ensure()
        preset, file = self._preset(), self._file()
        place = self._place(preset, file)
        settings, routes = self._settings(preset, place), self._routes(place, file)
        sites = self._sites(preset, place, settings, file)
        workers = Processes(available_cores() if self.workers is None else self.workers)
        if output is None:
            with StageBars() as bars:
                shards = collect_frames(
                    sites,
                    routes,
                    settings,
                    folder=self.data,
                    workers=workers,
                    progress=bars.show,
                )
            counts = count_frames(self.data, shards)
            lines = [f"{self.data / name}: {n} frames" for name, n in counts.items()]
            return Result({"data": counts}, lambda: print("\n".join(lines)))
        start = self.start and PilotNet.load(resolve(str(self.start)))
        earlier_shards = find_shards(*self.more)
        with StageBars() as bars:
            result = imitate(
                sites,
                routes,
                settings,
                folder=self.data,
                workers=workers,
                progress=bars.show,
                start=start,
                earlier_shards=earlier_shards,
            )
        command = command_line("train", self)
        record = training_record(
            settings, sites, self.data, result=result, command=command
        )
        document = write_trained(output, result.module, record)
        picture = output.with_name(f"{output.stem}-place.png")
        self._draw(picture, f"{output.name}: where it was trained", place, routes)

        def show() -> None:
            console().print(card_table(result.card))
            print(f"{output}: written; program and validation are beside it")
            print(f"{picture}: where it was trained, from above")

        return Result(document, show)

    def _checked_output(self) -> Path | None:
        """Return the policy's file, which can be written; None for frames only."""
        from mi_nerfattack.commands.shared.fit_report import check_output
        from mi_nerfattack.io import files
        from mi_nerfattack.policy.exported import SUFFIX

        if self.frames_only:
            for name in ("output", "start", "more"):
                if getattr(self, name):
                    raise InputError(
                        f"--{name}: has no effect with --frames-only, which trains no "
                        "policy; leave one of both out"
                    )
            return None
        if self.output is None:
            raise InputError(
                "-o: is missing; name the policy's file, or give --frames-only"
            )
        check_output(self.output)
        for suffix in (SUFFIX, ".json"):
            files.check_writable(self.output.with_suffix(suffix))
        return self.output

    def _draw(
        self, picture: Path, title: str, place: Place, routes: list[Route]
    ) -> None:
        from mi_nerfattack.deploy.surrogate.scene import field_sensor
        from mi_nerfattack.fields import load_field
        from mi_nerfattack.render.posed import PosedField
        from mi_nerfattack.report.plots.place import routes_picture

        sensor = None
        if place.field is not None:
            field = PosedField(load_field(place.field), place.field_pose)
            sensor = field_sensor(field, [], place.camera, mount=place.mount)
        routes_picture(
            picture,
            place.scene,
            routes,
            camera=place.camera,
            mount=place.mount,
            sensor=sensor,
            title=title,
        )

    def _file(self) -> PolicyFile:
        """Read the file of --like; an empty one where there is none."""
        if self.like is None:
            if self.settings:
                raise InputError("--set: sets a key of --like, which is missing")
            return PolicyFile("--like")
        file = PolicyFile.read(self.like, self.settings)
        if file.rig is None and file.vehicle is None:
            raise InputError(
                f"--like: {self.like}; has neither [camera] nor [vehicle]: add one, or "
                "leave the option out"
            )
        if file.vehicle is not None and not file.vehicle.has_expert:
            raise InputError(
                f"{self.like}: vehicle.control_unit: is missing; the expert that "
                "labels frames needs 'rad/s' or 'rad'"
            )
        return file

    def _place(self, preset: Preset, file: PolicyFile) -> Place:
        from mi_nerfattack.deploy.place import bundled_place

        options = PlaceOptions(
            place=preset.place if file.scenario is None else None,
            scene=self.scene,
            field=self.field,
            routes_file=self.routes_file,
            object=self.object,
        )
        place = file.place(options)
        objects = place.objects or bundled_place(preset.place).objects
        return replace(place, objects=objects)

    def _routes(self, place: Place, file: PolicyFile) -> list[Route]:
        from mi_nerfattack.scenario.world import at_own_speed
        from mi_nerfattack.vehicle.route.route import load_routes

        routes = load_routes(place.routes)
        if file.vehicle is None:
            return routes
        motion = file.vehicle.motion()
        return [at_own_speed(route, motion) for route in routes]

    def _sites(
        self,
        preset: Preset,
        place: Place,
        settings: ImitationSettings,
        file: PolicyFile,
    ) -> list[AbstractSite]:
        from mi_nerfattack.deploy.place import bundled_place
        from mi_nerfattack.deploy.sites import PlaceSite, Weather
        from mi_nerfattack.scenario.named_file import section_content

        # a scene without a sunsky emitter has no times of day
        is_bundled = place.scene == bundled_place(preset.place).scene
        weather = Weather(
            self.skies or (preset.weather.skies if is_bundled else ("day",)),
            self.exposures_ev or preset.weather.exposures_ev,
            self.spp,
        )
        for name in settings.sites:
            if name in _REFUSED:
                raise InputError(f"environment: {name!r}; {_REFUSED[name]}")
        file.check_wheels("--frames", settings.sites)
        vehicle = file.vehicle
        return [
            PlaceSite(
                name,
                place,
                weather,
                motion=None if vehicle is None else vehicle.motion,
                vehicle=None if vehicle is None else section_content(vehicle),
            )
            for name in settings.sites
        ]

    def _settings(self, preset: Preset, place: Place) -> ImitationSettings:
        from mi_nerfattack.training.presets import evaluation_for
        from mi_nerfattack.training.settings import ImitationSettings
        from mi_nerfattack.training.train import TrainSettings

        collecting, width = preset.collecting, place.car.width
        drives = replace(evaluation_for(width), car_width_m=width)
        count = len(place.objects)
        scales = parse_scales(self.scale, count) or collecting.roadside.scales
        roadside = replace(collecting.roadside, scales=scales, facing=self.facing)
        if self.most_objects == 0:
            collecting = replace(collecting, object_share=0.0)
        if self.waypoints_s:
            collecting = replace(collecting, waypoints_s=self.waypoints_s)
        most = self.most_objects or collecting.objects
        drives = replace(
            drives, runs=self.runs, objects=self.objects, roadside=roadside
        )
        return ImitationSettings(
            frames=preset.frames,
            validation_frames=preset.validation_frames,
            dagger_rounds=preset.dagger_rounds,
            dagger_frames=preset.dagger_frames,
            dagger_epochs=preset.dagger_epochs,
            seed=self.seed,
            validate_every=self.validate_every,
            validate_in=() if self.frames_only else self.validate_in,
            collecting=replace(collecting, objects=most, roadside=roadside),
            training=TrainSettings(
                preset.epochs, self.batch, learning_rate=self.learning_rate
            ),
            validation=replace(drives, runs=1, objects=()),
            final=replace(drives, seed=1),  # not the drives that chose the best epoch
        )

    def _preset(self) -> Preset:
        """Return the preset with what is given in place of its own."""
        from mi_nerfattack.training.presets import find_preset

        names = (
            "frames validation_frames dagger_rounds dagger_frames dagger_epochs epochs"
        )
        overrides = {name: getattr(self, name) for name in names.split()}
        overrides = {
            name: value for name, value in overrides.items() if value is not None
        }
        if self.frames_only:
            overrides["dagger_rounds"] = 0
        return replace(find_preset(self.preset), **overrides)
