"""A CARLA server in synchronous mode, left as it was found."""

from __future__ import annotations

import math
import re
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from mi_nerfattack.backend.interrupts import held_interrupts
from mi_nerfattack.deploy.carla.conventions import CarlaPose
from mi_nerfattack.errors import InputError, NerfAttackError
from mi_nerfattack.extras import load_extra
from mi_nerfattack.ranges import Name, Seconds, checked

_SUBSTEP = 0.01  # seconds of the physics
_MAX_SUBSTEPS = 16  # CARLA's own limit
_SPAWN_ADVICE = "take another place, or destroy what stands there"


@dataclass(frozen=True)
@checked("server")
class CarlaServer:
    """Where a server runs, and what it shall show.

    Args:
        host: name or address.
        port: of its remote calls; the server also uses the next two.
        town: loaded unless it is there already; None for what the server shows.
        weather: name of one of `carla.WeatherParameters`; None leaves it.
        timeout_s: longest wait for an answer or a sensor, seconds.
        load_timeout_s: longest wait for a town, seconds.

    Raises:
        InputError: a port or a time that is impossible.
    """

    host: Name = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65533)] = 2000
    town: str | None = None
    weather: str | None = "ClearNoon"
    timeout_s: Seconds = 10.0
    load_timeout_s: Seconds = 120.0

    @classmethod
    def parse(cls, text: str, **options: Any) -> CarlaServer:
        """Read "HOST:PORT" or "HOST:PORT/TOWN"; `options` are further arguments."""
        match = re.fullmatch(r"([^:/]+):(\d{1,5})(?:/(\w+))?", text)
        if match is None:
            raise InputError(
                f"server: {text!r}; HOST:PORT or HOST:PORT/TOWN, as 127.0.0.1:2000"
            )
        host, port, town = match.groups()
        return cls(host, int(port), town, **options)


def load_client() -> Any:
    """Import CARLA's client.

    Raises:
        SetupError: it is not installed.
    """
    elsewhere = (
        "drive in another environment: CARLA 0.9.16 has wheels for Python 3.10 to 3.12 "
        "on Linux and Windows, x86-64"
    )
    return load_extra("carla", "environment 'carla'", elsewhere)


class CarlaSession:
    """A connection that puts a world into synchronous mode and takes it back.

    Settings and weather return to what they were, and the actors spawned here are
    destroyed: by `close`, when the object or the interpreter goes, and by `guarded`
    upon any error. The world is never left in synchronous mode, also where it was
    found so, since a server that waits for ticks hangs for everybody else.

    Args:
        server: what to connect to.
        period: seconds of simulation between two ticks, at most 0.16.
        api: the module `carla`.

    Attributes:
        world: `carla.World`.
        town_map: `carla.Map` of it.

    Raises:
        InputError: no answer within the time limit, a server of another version, an
            unknown town or weather, or a period that the physics cannot take.
    """

    def __init__(self, server: CarlaServer, period: float, api: Any) -> None:
        substeps = math.ceil(period / _SUBSTEP - 1e-9)
        if not 0 < substeps <= _MAX_SUBSTEPS:
            raise InputError(
                f"period: {period} s; CARLA takes more than 0 and at most "
                f"{_SUBSTEP * _MAX_SUBSTEPS:g} s a tick"
            )
        self.server, self.api = server, api
        self._client = self._connect()
        self.world = self._load_town()
        with self._answered("read its settings"):
            self.town_map = self.world.get_map()
            before, weather = self.world.get_settings(), self.world.get_weather()
            settings = self.world.get_settings()
        self._undo = _Undo(self.world, before, weather)
        self._finalizer = weakref.finalize(self, self._undo.run)
        settings.synchronous_mode = True
        settings.fixed_delta_seconds = period
        settings.substepping = True
        settings.max_substep_delta_time = _SUBSTEP
        settings.max_substeps = substeps
        with self.guarded("change its settings"):
            if server.weather is not None:
                self.world.set_weather(self._weather(server.weather))
            self.world.apply_settings(settings, server.timeout_s)

    @property
    def is_open(self) -> bool:
        """Whether the world is still ours."""
        return self._finalizer.alive

    @contextmanager
    def guarded(self, action: str) -> Iterator[None]:
        """Give the world back where anything within fails, also by Ctrl-C.

        Raises:
            InputError: the server did not answer, or refused.
        """
        if not self.is_open:
            raise InputError(f"{self._place()}: the connection is closed; make another")
        try:
            with self._answered(action):
                yield
        except BaseException as error:
            problem = self._release()
            if problem and isinstance(error, InputError):
                raise InputError(f"{error}; {problem}") from error
            raise

    def tick(self) -> int:
        """Simulate one period; returns the frame's number."""
        return self.world.tick(self.server.timeout_s)

    def transform(self, pose: CarlaPose) -> Any:
        """Make a `carla.Transform`."""
        rotation = self.api.Rotation(pitch=pose.pitch, yaw=pose.yaw, roll=pose.roll)
        return self.api.Transform(self.api.Location(pose.x, pose.y, pose.z), rotation)

    def spawn(
        self, kind: str, pose: CarlaPose, attributes: dict[str, str], parent: Any = None
    ) -> Any:
        """Spawn an actor, which is destroyed with the session.

        Args:
            kind: id of a blueprint.
            pose: in the world, or relative to `parent`.
            attributes: of the blueprint.
            parent: actor that it is fixed to.

        Raises:
            InputError: no such blueprint or attribute, or the place is occupied.
        """
        library = self.world.get_blueprint_library()
        try:
            blueprint = library.find(kind)
        except IndexError as error:
            raise InputError(
                f"{self._place()}: it has no blueprint {kind!r}"
            ) from error
        for name, value in attributes.items():
            if not blueprint.has_attribute(name):
                raise InputError(f"{kind}: no attribute {name!r} in this CARLA")
            blueprint.set_attribute(name, value)
        where = self.transform(pose)
        actor = self.world.try_spawn_actor(blueprint, where, attach_to=parent)
        if actor is None:
            raise InputError(
                f"{self._place()}: {kind} cannot be spawned at {pose}, where something "
                f"stands; {_SPAWN_ADVICE}"
            )
        self._undo.actors.append(actor)
        return actor

    def clear(self) -> None:
        """Destroy the actors spawned so far."""
        self._undo.destroy()

    def close(self) -> None:
        """Give the world back; may be called again.

        Raises:
            InputError: the server no longer answers, so it may hang.
        """
        problem = self._release()
        if problem:
            raise InputError(f"{self._place()}: {problem}")

    def _release(self) -> str | None:
        with held_interrupts():  # a second Ctrl-C must not keep the world ours
            return self._finalizer() if self._finalizer.alive else None

    def _connect(self) -> Any:
        server = self.server
        with self._answered("connect"):
            client = self.api.Client(server.host, server.port)
            client.set_timeout(server.timeout_s)
        try:
            theirs = client.get_server_version()
        except RuntimeError as error:
            raise InputError(
                f"{self._place()}: no answer within {server.timeout_s:g} s ({error}); "
                "start the server ('./CarlaUE4.sh -RenderOffScreen "
                f"-carla-rpc-port={server.port}'), check host, port and firewall, or "
                "wait longer (timeout_s)"
            ) from error
        ours = client.get_client_version()
        if _release_of(ours) != _release_of(theirs):
            raise InputError(
                f"{self._place()}: the server is CARLA {theirs}, the client {ours}; "
                "both must be of one version"
            )
        return client

    def _load_town(self) -> Any:
        town = self.server.town
        with self._answered("read its towns"):
            world = self._client.get_world()
            present = _town(world.get_map().name)
            if town is None or town == present:
                return world
            known = sorted({_town(name) for name in self._client.get_available_maps()})
        if town not in known:
            raise InputError(
                f"{self._place()}: no town {town!r}; it has {', '.join(known)}"
            )
        with self._answered(f"load {town}"):
            self._client.set_timeout(self.server.load_timeout_s)
            world = self._client.load_world(town)
            self._client.set_timeout(self.server.timeout_s)
        return world

    def _weather(self, name: str) -> Any:
        table = self.api.WeatherParameters
        known = [key for key in dir(table) if isinstance(getattr(table, key), table)]
        if name not in known:
            raise InputError(f"weather: {name!r}; one of {', '.join(known)}")
        return getattr(table, name)

    @contextmanager
    def _answered(self, action: str) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            if isinstance(
                error, NerfAttackError | NotImplementedError | RecursionError
            ):
                raise
            raise InputError(
                f"{self._place()}: could not {action}: {error}; see whether the server "
                "still runs, and start it again if not"
            ) from error

    def _place(self) -> str:
        return f"CARLA at {self.server.host}:{self.server.port}"


class _Undo:
    """What a world needs to be as before; knows nothing of the session."""

    def __init__(self, world: Any, settings: Any, weather: Any) -> None:
        self.world, self.settings, self.weather = world, settings, weather
        self.actors: list[Any] = []

    def run(self) -> str | None:
        """Restore all; returns what could not be."""
        self.settings.synchronous_mode = False
        try:
            for actor in self.actors:
                if "sensor" in actor.type_id:
                    actor.stop()
            # first of all: a server in synchronous mode hangs for everybody
            self.world.apply_settings(self.settings)
            self.world.set_weather(self.weather)
            self.destroy()
        except RuntimeError as error:
            self.actors.clear()
            return (
                f"its settings could not be restored ({error}): it may wait for ticks "
                "that never come; start the server again"
            )
        return None

    def destroy(self) -> None:
        """Destroy all actors, the attached ones first."""
        while self.actors:
            actor = self.actors.pop()
            if "sensor" in actor.type_id:
                actor.stop()
            actor.destroy()


def _release_of(version: str) -> str:
    match = re.match(r"\d+\.\d+\.\d+", version)
    return match.group() if match else version


def _town(name: str) -> str:
    return name.rsplit("/", 1)[-1]
