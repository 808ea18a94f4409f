"""The grid file: routes x objects x methods x budgets x seeds of one scenario.

A TOML file that names a scenario and, of each axis, choices that set keys of it.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tomlkit
from pydantic import Field, ValidationError, model_validator

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.cell import Cell
from mi_nerfattack.experiment.sweep.places import DrawSection, Places
from mi_nerfattack.io import files
from mi_nerfattack.io.overrides import tell
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.ranges import Count, NonNegative, Seed
from mi_nerfattack.scenario.named_file import File, NamedFile, portable_text
from mi_nerfattack.scenario.scenario import Scenario, load_scenario
from mi_nerfattack.scenario.section import Location, Section, problems, refuse
from mi_nerfattack.scenario.upgrade import new_lines
from mi_nerfattack.scenario.world import judged_frames

MOST_CELLS = 10_000
_LENGTHS = ("max_iterations", "frames")  # of [attack.method], by kind

Label = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]{0,39}$")]


class AbstractChoice(Section):
    """A value of an axis."""

    name: Label  # in the table
    set: dict[str, Any] = {}  # keys of the scenario, over those of the file


class Choice(AbstractChoice):
    """A route."""


class ObjectsChoice(AbstractChoice):
    """Objects at the roadside of some routes."""

    routes: tuple[str, ...] | None = None  # by name; all
    draw: DrawSection | None = None  # in place of set.objects

    @property
    def places(self) -> tuple[tuple[str, int | None], ...]:
        """Names in the table, one for each seed that a draw names, with that seed."""
        if self.draw is None or self.draw.seeds is None:
            return ((self.name, None),)
        return tuple((f"{self.name}.{seed}", seed) for seed in self.draw.seeds)

    @model_validator(mode="after")
    def _check_draw(self) -> Any:
        """Refuse objects that are drawn and given, and seeds that stand twice."""
        if self.draw is None:
            return self
        if "objects" in self.set:
            refuse("draw", "stands beside set.objects; give one of them")
        _check_distinct("draw.seeds", self.draw.seeds or ())
        return self


class MethodChoice(AbstractChoice):
    """A method, with the cost of its own backward pass."""

    backward_multiple: NonNegative | None = None  # in drives; by default the grid's


class Grid(Section):
    """A grid file."""

    scenario: File  # what the choices change
    routes: tuple[Choice, ...] = ()
    objects: tuple[ObjectsChoice, ...] = ()
    methods: tuple[MethodChoice, ...] = ()
    budgets: tuple[Count, ...] = ()  # rendered frames; as the scenario says
    backward_multiple: NonNegative | None = None  # cost of a backward pass, in drives
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)] = (0,)
    anyway: bool = False  # attack although it would prove nothing
    pictures: bool = False  # write frames, plots and page of each attack

    @model_validator(mode="after")
    def _check_names(self) -> Any:
        """Refuse what stands twice, and routes that there are none of."""
        for key in ("budgets", "seeds"):
            _check_distinct(key, getattr(self, key))
        for axis in ("routes", "methods"):
            _check_distinct(axis, [choice.name for choice in getattr(self, axis)])
        known, taken = [route.name for route in self.routes], set()
        for index, choice in enumerate(self.objects):
            for name in choice.routes or ():
                if name not in known:
                    refuse(f"objects.{index}.routes", f"{name!r}; one of {known}")
            place_names = [own for own, _ in choice.places]
            for place in itertools.product(choice.routes or known or [""], place_names):
                if place in taken:
                    refuse(
                        f"objects.{index}.name",
                        f"{place[1]!r} is there twice at one route; names differ, "
                        "or their routes do",
                    )
                taken.add(place)
        if self.budgets:
            for index, choice in enumerate(self.methods):
                for key in _LENGTHS:
                    if _depth(choice.set, ("attack", "method", key)) == 3:
                        refuse(
                            f"methods.{index}.set.attack.method.{key}",
                            "stands beside budgets, which say it; give one of them",
                        )
        return self


class GridReader:
    """What the cells of a grid are made of.

    Args:
        path: the grid file.

    Raises:
        InputError: it or the scenario cannot be read, is no TOML, or a key is unknown,
            missing, of the wrong type or out of range; with file and line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.text, data = files.read_text(path), files.read_toml(path)
        try:
            context = {"folder": path.parent}
            self.grid = Grid.model_validate(data, context=context)
        except ValidationError as err:
            raise InputError(tell(path, self.text, problems(err))) from err
        self.base_path = self.grid.scenario.file
        self.base, self.base_text = load_scenario(self.base_path)
        portable = portable_text(self.base, self.base_text)
        self.values = parse_toml(self.base_path, portable)
        self._content = functools.cache(NamedFile.content)
        self._draws = Places()
        self._drawn = functools.cache(self._draw)

    def cells(self) -> Iterator[Cell]:
        """Yield the cells, in the order of the table.

        Raises:
            InputError: a key of a cell is wrong, or objects that are to be drawn find
                no place.
        """
        grid = self.grid
        for i, j in self._places_of():
            these = self._objects[j]
            for (name, place), k, budget, seed in self._choices(j):
                method, layers = self._methods[k], self._layers(i, j)
                if these.draw is not None:
                    drawn = self._drawn(i, j, seed if place is None else place)
                    layers["objects", j, "set"] = these.set | {"objects": drawn}
                layers["methods", k, "set"] = method.set
                multiple = method.backward_multiple
                if multiple is None:
                    multiple = grid.backward_multiple
                text, digests = self._scenario(layers, seed, budget, multiple)
                yield Cell(
                    self._routes[i].name,
                    name,
                    method.name,
                    budget=budget,
                    seed=seed,
                    text=text,
                    digests=digests,
                    anyway=grid.anyway,
                    pictures=grid.pictures,
                )

    def labels(self) -> Iterator[tuple[Any, ...]]:
        """Yield route, objects, method, budget and seed of each cell; draw no place."""
        for i, j in self._places_of():
            for (name, _), k, budget, seed in self._choices(j):
                yield self._routes[i].name, name, self._methods[k].name, budget, seed

    def _choices(self, objects: int) -> Iterator[tuple[Any, int, Any, int]]:
        """Yield name and seed of a place, index of a method, budget and seed."""
        return itertools.product(
            self._objects[objects].places,
            range(len(self._methods)),
            self.grid.budgets or (None,),
            self.grid.seeds,
        )

    @functools.cached_property
    def _routes(self) -> tuple[Choice, ...]:
        return self.grid.routes or (Choice(name=axis_name(self.base.scene.route)),)

    @functools.cached_property
    def _methods(self) -> tuple[MethodChoice, ...]:
        kind = self.base.attack.method.kind
        return self.grid.methods or (MethodChoice(name=kind),)

    @functools.cached_property
    def _objects(self) -> tuple[ObjectsChoice, ...]:
        ids = "+".join(item.id for item in self.base.objects)
        return self.grid.objects or (ObjectsChoice(name=axis_name(ids)),)

    def _places_of(self) -> Iterator[tuple[int, int]]:
        """Yield the indices of routes, and of objects beside them."""
        for (i, route), (j, these) in itertools.product(
            enumerate(self._routes), enumerate(self._objects)
        ):
            if these.routes is None or route.name in these.routes:
                yield i, j

    def _layers(self, route: int, objects: int) -> dict[Location, Any]:
        """Return what a route and the objects beside it set."""
        return {
            ("routes", route, "set"): self._routes[route].set,
            ("objects", objects, "set"): self._objects[objects].set,
        }

    def _draw(self, route: int, objects: int, seed: int) -> list[dict[str, Any]]:
        section, layers = self._objects[objects].draw, self._layers(route, objects)
        assert section is not None
        values = functools.reduce(_merged, layers.values(), self.values)
        scenario = self._read(values, layers)
        try:
            return self._draws.draw(section, seed, scenario)
        except InputError as err:
            raise InputError(
                f"{self.path}: objects.{objects}.draw, seed {seed}: {err}"
            ) from err

    def _scenario(
        self,
        layers: Mapping[Location, Any],
        seed: int,
        budget: int | None,
        multiple: float | None,
    ) -> tuple[str, dict[str, str]]:
        """Return the text of a cell's scenario, and its digests."""
        values = self.values
        for layer in (*layers.values(), {"seed": seed}):
            values = _merged(values, layer)
        match values:
            case {"attack": {"method": {**method}} as attack} if budget is not None:
                without_length = {k: v for k, v in method.items() if k not in _LENGTHS}
                values = values | {"attack": attack | {"method": without_length}}
        scenario = self._read(values, layers)
        if budget is not None:
            length = self._length(scenario, budget, multiple)
            values = _merged(values, {"attack": {"method": length}})
            scenario = self._read(values, layers)
        text = portable_text(scenario, tomlkit.dumps(values))
        return text, scenario.digests(self._content)

    def _read(self, values: Any, layers: Mapping[Location, Any]) -> Scenario:
        context = {"folder": self.path.parent}
        try:
            return Scenario.model_validate(values, context=context)
        except ValidationError as err:
            message = new_lines(self.path, self.text)
            raise InputError(
                message or self._message(list(problems(err)), layers)
            ) from err

    def _message(
        self, issues: list[tuple[Location, str]], layers: Mapping[Location, Any]
    ) -> str:
        """Tell problems of a cell where the keys were given."""
        grid_issues: list[tuple[Location, str]] = []
        base_issues: list[tuple[Location, str]] = []
        for keys, problem in issues:
            depth, where = max(
                (_depth(layer, keys), where) for where, layer in layers.items()
            )
            if depth and depth >= _depth(self.values, keys):
                grid_issues.append(((*where, *keys), problem))
            else:
                base_issues.append((keys, problem))
        grid_message = tell(self.path, self.text, grid_issues) if grid_issues else ""
        base_message = (
            tell(self.base_path, self.base_text, base_issues) if base_issues else ""
        )
        return "\n".join(filter(None, (grid_message, base_message)))

    def _length(
        self, scenario: Scenario, budget: int, multiple: float | None
    ) -> dict[str, int]:
        """Return the key that says how long an attack is, for a budget of frames."""
        method, frames = scenario.attack.method, judged_frames(scenario)
        if not method.needs_derivatives:
            return {"frames": budget}
        if multiple is None:
            raise InputError(
                f"{self.path}: backward_multiple: is missing; budgets of gradients "
                "count a backward pass as so many drives: check of a grid without "
                "budgets measures it"
            )
        # 1 + 1.1 is a little more than 2.1, and must not cost an iteration
        iterations = int(budget / ((1 + multiple) * frames) + 1e-9)
        if not iterations:
            raise InputError(
                f"{self.path}: budgets: {budget} frames; an iteration of "
                f"{method.kind} costs {(1 + multiple) * frames:g}"
            )
        return {"max_iterations": iterations}


def load_cells(path: Path) -> list[Cell]:
    """Read a grid file, and make its cells; every key of theirs is checked.

    Raises:
        InputError: a file cannot be read, a key is wrong (with file and line), or there
            are more than `MOST_CELLS` cells.
    """
    reader = GridReader(path)
    cells = list(itertools.islice(reader.cells(), MOST_CELLS + 1))
    if len(cells) > MOST_CELLS:
        raise InputError(f"{path}: more than {MOST_CELLS} cells; make several grids")
    if not cells:
        raise InputError(f"{path}: no cell; no objects stand at any of the routes")
    return cells


def _check_distinct(key: str, values: Sequence[Any]) -> None:
    """Refuse values, or names, that stand twice."""
    if len(set(values)) < len(values):
        refuse(key, f"{list(values)}; give each once")


def axis_name(text: str) -> str:
    """Return a name of a choice, made of any text."""
    return re.sub(r"[^A-Za-z0-9_.+-]+", "_", text).strip("_.+-")[:40] or "own"


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Merge tables key by key; other values replace what is below."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            value = _merged(old, value)
        merged[key] = value
    return merged


def _depth(values: Any, keys: Sequence[str | int]) -> int:
    """Return how many of the keys that lead to a value there are."""
    for depth, key in enumerate(keys):
        try:
            values = values[key]
        except (KeyError, IndexError, TypeError):
            return depth
    return len(keys)
