"""Where found attacks are driven: environments, and conditions by which they differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Conditions
from mi_nerfattack.deploy.registry import kinematic_vehicle, offered_environment
from mi_nerfattack.deploy.stress.pose_error import PoseError
from mi_nerfattack.deploy.stress.timing import DroppedFrames, LateControls, LateFrames
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.surrogate.scene import showing
from mi_nerfattack.errors import InputError
from mi_nerfattack.ranges import Finite, Natural, NonNegative, Share, checked
from mi_nerfattack.render.camera.rig import camera_seed
from mi_nerfattack.render.pathtrace.load import DAYLIGHT
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenario.deployment import SURROGATE, Deployment
from mi_nerfattack.scenario.scenario import Scenario
from mi_nerfattack.scenario.world import World

if TYPE_CHECKING:
    from mi_nerfattack.system.entry_points import Offer

#: Where objects are pasted, and where they can also be built in.
PASTED = (SURROGATE, "mitsuba", "mujoco", "mujoco_gl")
BUILT_IN = "_built_in"
ENVIRONMENTS = (*PASTED, *(f"{name}{BUILT_IN}" for name in PASTED[1:]))

#: Fields of a condition by the words of the command line.
_WORDS = {
    "exposure": "exposure_ev",
    "noise": "noise_sd",
    "blur": "blur_px",
    "dropped": "dropped_share",
    "late": "late_periods",
    "latency": "latency_periods",
    "placement": "placement_m",
    "turn": "turn_deg",
    "pitch": "pitch_deg",
}


@dataclass(frozen=True)
@checked("condition")
class Condition:
    """What differs from the drives of an attack; by default nothing.

    Args:
        sky: time of day, key of `DAYLIGHT`.
        exposure_ev: of the camera, in powers of two.
        noise_sd: standard deviation of the camera's noise, of sRGB values in [0, 1].
        blur_px: standard deviation of the camera's Gaussian blur, pixels.
        dropped_share: of frames that are lost, see `DroppedFrames`.
        late_periods: delay of frames, see `LateFrames`; `dropped_share` acts before.
        latency_periods: delay of controls, see `LateControls`.
        placement_m: standard deviation of the objects' places, see `PoseError`.
        turn_deg: standard deviation of the objects' turns, see `PoseError`.
        pitch_deg: standard deviation of the camera's pitch, see `PoseError`.
        others: conditions of other packages, word and number each.
    """

    sky: str = "day"
    exposure_ev: Finite = 0.0
    noise_sd: NonNegative = 0.0
    blur_px: NonNegative = 0.0
    dropped_share: Share = 0.0
    late_periods: Natural = 0
    latency_periods: Natural = 0
    placement_m: NonNegative = 0.0
    turn_deg: NonNegative = 0.0
    pitch_deg: NonNegative = 0.0
    others: tuple[tuple[str, Finite], ...] = ()

    @property
    def errors(self) -> PoseError:
        """Of objects and camera."""
        return PoseError(self.placement_m, self.turn_deg, self.pitch_deg)

    @property
    def is_light(self) -> bool:
        """Whether it changes light or exposure, which a field cannot."""
        return self.sky != "day" or self.exposure_ev != 0

    @property
    def label(self) -> str:
        """As `parse_condition` reads it: ``day``, ``evening,noise:0.03``."""
        terms = [] if self.sky == "day" else [self.sky]
        for word, name in _WORDS.items():
            if value := getattr(self, name):
                sign = "+" * (word == "exposure" and value > 0)
                terms.append(f"{word}:{sign}{value:g}")
        terms += [f"{word}:{value:g}" for word, value in self.others]
        return ",".join(terms) or "day"

    def around(self, environment: AbstractEnvironment) -> AbstractEnvironment:
        """Let frames and controls of an environment be late or lost."""
        if self.dropped_share:
            environment = DroppedFrames(environment, self.dropped_share)
        if self.late_periods:
            environment = LateFrames(environment, self.late_periods)
        if self.latency_periods:
            environment = LateControls(environment, self.latency_periods)
        for word, value in self.others:
            offer = _offered(word)
            environment = offer.value(environment, value)
            if not isinstance(environment, AbstractEnvironment):
                raise offer.refuse(f"makes {environment!r}, no AbstractEnvironment")
        return environment

    def identity(self) -> dict[str, Any]:
        """Return its values, and the packages of other conditions, as JSON."""
        values = asdict(self)
        if not values.pop("others"):
            return values
        packages = {word: _offered(word).package for word, _ in self.others}
        return values | {"others": list(self.others), "packages": packages}


def _further_words() -> list[str]:
    from mi_nerfattack.system import entry_points

    return entry_points.names(entry_points.CONDITIONS)


def _offered(word: str) -> Offer:
    """Return what puts a condition of another package around an environment."""
    from mi_nerfattack.system import entry_points

    offer = entry_points.find(
        entry_points.CONDITIONS, word, _WORDS, where="--conditions: "
    )
    if not callable(offer.value):
        raise offer.refuse(f"is {offer.value!r}, no class and no function")
    return offer


def parse_condition(text: str) -> Condition:
    """Read a condition.

    Args:
        text: a time of day, ``WORD:NUMBER``, or several of these with commas.

    Raises:
        InputError: an unknown word, one given twice, or a number out of its range.
    """
    kinds = {item.name: item.type for item in fields(Condition)}
    values: dict[str, Any] = {}
    for part in text.split(","):
        word, colon, number = part.partition(":")
        name = _WORDS.get(word) if colon else "sky" if word in DAYLIGHT else None
        further = _further_words() if name is None else []
        if colon and word in further:
            _offered(word)  # refuses what cannot be imported
            name = f"other:{word}"
        if name is None or name in values:
            words = ", ".join([*_WORDS, *further])
            raise InputError(
                f"--conditions: {text!r}: {part!r}; a time of day "
                f"({', '.join(DAYLIGHT)}) or WORD:NUMBER with {words}, each once, "
                "parted by commas"
            )
        try:
            kind = int if kinds.get(name) == "Natural" else float
            values[name] = word if name == "sky" else kind(number)
        except ValueError as err:
            raise InputError(f"--conditions: {text!r}: {word}: {err}") from err
    others = {k: values.pop(k) for k in list(values) if k.startswith("other:")}
    pairs = tuple((k.removeprefix("other:"), v) for k, v in others.items())
    try:
        return Condition(**values, others=pairs)
    except InputError as err:
        raise InputError(f"--conditions: {text!r}: {err}") from err


@dataclass(frozen=True)
class Column:
    """An environment under a condition.

    Args:
        environment: one of `ENVIRONMENTS`, or of another package, which pastes objects.
        condition: see there.
        spp: samples per pixel of path-traced images.
    """

    environment: str
    condition: Condition
    spp: int

    @property
    def name(self) -> str:
        """Key of `deploy.registry.ENVIRONMENTS`."""
        return self.environment.removesuffix(BUILT_IN)

    @property
    def builds_in(self) -> bool:
        """Whether objects become geometry of the scene."""
        return self.environment.endswith(BUILT_IN)

    @property
    def without_objects(self) -> Column:
        """The column in which drives without objects are the same."""
        condition = replace(self.condition, placement_m=0.0, turn_deg=0.0)
        return replace(self, environment=self.name, condition=condition)

    @property
    def serves_one_start(self) -> bool:
        """Whether each start needs an environment of its own."""
        errors = self.condition.errors
        return bool(errors.pitch_deg) or (self.builds_in and errors.moves_objects)

    def identity(self) -> dict[str, Any]:
        """Return all that decides about its drives, as JSON."""
        identity = {"environment": self.environment, **self.condition.identity()}
        traced = (
            self.name in ("mitsuba", "mujoco") or self.environment not in ENVIRONMENTS
        )
        return identity | ({"spp": self.spp} if traced else {})

    def check(self, scenario: Scenario) -> None:
        """Raise InputError unless a scenario's vehicle can drive there."""
        if not scenario.vehicle.fits_wheels and "mujoco" in self.name:
            raise InputError(
                f"--environments: {self.environment} drives a car with wheels, whose "
                f"control is not that of the custom vehicle of {scenario.name!r}; "
                "leave it out"
            )

    def open(
        self, world: World, objects: Sequence[PosedField], seed: int
    ) -> AbstractEnvironment:
        """Make the environment, objects as they look and stand at present.

        Args:
            world: of the attack.
            objects: its own, or none; where they are not built in, the environment
                follows them when they change.
            seed: of the drive.
        """
        condition = self.condition
        rig, errors = world.place.rig, condition.errors
        mounts = [
            errors.mount(mount, camera_seed(seed, index))
            for index, mount in enumerate(rig.mounts)
        ]
        place = world.place.with_rig(rig.on(mounts))
        blur, noise = condition.blur_px, condition.noise_sd
        if self.environment == SURROGATE:
            sensor = showing(world.surrogate, list(objects), mounts=mounts)
            environment = SurrogateEnvironment(sensor, kinematic_vehicle(place))
            environment.blur_px, environment.noise_sd = blur, noise
            return condition.around(environment)
        light = Conditions(
            condition.sky,
            condition.exposure_ev,
            self.spp,
            blur_px=blur,
            noise_sd=noise,
        )
        deployment = Deployment(self.name, place, light, builds_in=self.builds_in)
        return condition.around(deployment.open(objects))


def make_columns(
    environments: Sequence[str], conditions: Sequence[str], spp: int
) -> tuple[Column, ...]:
    """Return all environments under all conditions that have an effect there.

    Args:
        environments: of `ENVIRONMENTS` or of other packages, each once.
        conditions: see `parse_condition`, each once.
        spp: samples per pixel of path-traced images, at least 1.

    Raises:
        InputError: an unknown environment, a condition that cannot be read, none of
            either, one twice, or no condition with an effect.
    """
    for name in environments:
        if name not in ENVIRONMENTS:
            offered_environment(name, "--environments: ", ENVIRONMENTS)
    parsed = [parse_condition(text) for text in conditions]
    for option, choices in (("environments", environments), ("conditions", parsed)):
        if not choices or len(set(choices)) < len(choices):
            words = environments if option == "environments" else conditions
            raise InputError(
                f"--{option}: {' '.join(words)!r}; at least one, each once"
            )
    Conditions(spp=spp)  # checks it
    columns = tuple(
        Column(name, condition, spp)
        for name in environments
        for condition in parsed
        if name != SURROGATE or not condition.is_light
    )
    if not columns:
        raise InputError(
            "--conditions: the surrogate has the light of its field; give a condition "
            "of another kind, or further environments"
        )
    return columns
