"""Cells of a grid file, and what is wrong with one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep import grid as module
from mi_nerfattack.experiment.sweep.cell import Cell
from mi_nerfattack.experiment.sweep.grid import GridReader, load_cells
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.vehicle.route.route import Route

pytestmark = pytest.mark.usefixtures("variant")


def labels_of(cells: Sequence[Cell]) -> list[tuple]:
    return [(c.route, c.objects, c.method, c.budget, c.seed) for c in cells]


def test_cells_are_the_product_of_the_axes(write_grid):
    cells = load_cells(path := write_grid())
    labels = labels_of(cells)
    assert list(GridReader(path).labels()) == labels
    methods = [(m, 40, seed) for m in ("gradient", "blocks") for seed in (3, 4)]
    places = [("near", "ball"), ("far", "ball"), ("far", "two")]
    assert labels == [(*place, *method) for place in places for method in methods]
    assert len({cell.id for cell in cells}) == 12
    for cell in cells:
        scenario, far = cell.scenario, cell.route == "far"
        assert scenario.seed == cell.seed
        assert scenario.drive.horizon == (5 if far else 4)
        assert len(scenario.objects) == (2 if cell.objects == "two" else 1)
        assert scenario.digests() == cell.digests
        method = scenario.attack.method
        if cell.method == "gradient":  # 40 frames: iterations of 4 or 5, 2.5 times
            assert method.iterations(5) == (3 if far else 4)
        else:
            assert method.iterations(5) == 8 and method.model_dump()["frames"] == 40


def test_a_grid_of_a_scenario_alone_and_the_example_of_the_guide(
    scenario_folder, tmp_path
):
    path = scenario_folder / "alone.toml"
    path.write_text('scenario = "scenario.toml"')
    (cell,) = load_cells(path)
    assert list(GridReader(path).labels()) == labels_of([cell])
    assert cell.id.startswith("line-ball-gradient-0-")
    assert cell.scenario.attack.method.iterations(1) == 3
    guide = Path(__file__).parents[3] / "docs/howto/sweep.md"
    example = guide.read_text("utf-8").split("```toml\n")[1].split("```")[0]
    path = tmp_path / "grid.toml"
    path.write_text(example)
    cells = load_cells(path)
    assert len(cells) == 2 * 2 * 5
    # 60 and 80 periods an iteration, 2.9 times
    lengths = [c.scenario.attack.method.iterations(1) for c in cells[::5]]
    assert lengths == [34, 6000, 25, 6000]


DRAWN = """\
scenario = "bundled:demo.toml"
routes = [{name = "right"}, {name = "left", set.scene.route = "left"}]

[[objects]]
name = "two"
draw.fields = ["bundled:hydrant/field.safetensors", "bundled:cube/field.safetensors"]
draw.scales = [[1.0, 2.0], [0.5, 0.5]]
draw.seeds = [1, 2]
"""


def test_objects_are_drawn_by_the_rule(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text("seeds = [1, 2]\n" + DRAWN)
    cells = load_cells(path)
    assert load_cells(path) == cells
    assert list(GridReader(path).labels()) == labels_of(cells)
    drawn = {(c.route, c.objects): c.scenario.objects for c in cells}
    names = [(route, f"two.{k}") for route in ("right", "left") for k in (1, 2)]
    assert sorted(drawn) == sorted(names) and len(cells) == 2 * len(names)
    places = set()
    for (route, _), (hydrant, cube) in drawn.items():
        assert 1 <= hydrant.scale <= 2 and cube.scale == 0.5
        assert str(cube.field) == "bundled:cube/field.safetensors"
        lane = Route.from_file(cells[0].scenario.scene.routes.file, route)
        for item in (hydrant, cube):
            x, y, z = item.position_m
            assert abs(lane.cross_track_numpy([[x, y, 0.0]])[0]) > lane.lane_width_m / 2
            assert z == pytest.approx(0.12, abs=1e-3)  # the pavement's height
            places.add(item.position_m)
    assert len(places) == 8
    # without seeds of their own, places are of the cells' seeds
    path.write_text("seeds = [2, 1]\n" + DRAWN.replace("draw.seeds = [1, 2]", ""))
    own = load_cells(path)
    assert [(c.objects, c.seed) for c in own] == [("two", 2), ("two", 1)] * 2
    for cell in own:
        assert cell.scenario.objects == drawn[cell.route, f"two.{cell.seed}"]


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("[1, 2]", "[1, 1]", r":8: objects.0.draw.seeds: "),
        ("[0.5, 0.5]", "[60, 60]", r": objects.0.draw, seed 1: .*places for 1"),
        ("[0.5, 0.5]", "[2, 1]", r": objects.0.draw, seed 1: .*2.0 to 1.0"),
        ("draw.seeds", "set.objects = []\ndraw.seeds", r":\d: objects.0.draw: "),
    ],
)
def test_what_cannot_be_drawn_is_told(tmp_path, old, new, where):
    path = tmp_path / "grid.toml"
    assert old in DRAWN
    path.write_text(DRAWN.replace(old, new, 1))
    with pytest.raises(InputError, match=f"grid.toml{where}"):
        load_cells(path)


def test_another_content_of_a_file_is_another_cell(write_grid, scenario_folder):
    path, route = write_grid(), scenario_folder / "routes.json"
    before, text = load_cells(path), route.read_text()
    route.write_text(text + "\n")
    try:
        after = load_cells(path)
    finally:
        route.write_text(text)
    assert not {cell.id for cell in before} & {cell.id for cell in after}
    assert load_cells(path) == before


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("seeds =", "seed =", r":2: seed: .*scenario"),
        ("[3, 4]", "[3, 3]", r":2: seeds: "),
        ("[3, 4]", "[]", r":2: seeds: "),
        ('"far"]', '"fra"]', r":\d+: objects.1.routes: 'fra'; .*'near'"),
        ('"two"', '"ball"', r":\d+: objects.1.name: 'ball'"),
        ('"blocks"\nset', '"a/b"\nset', r":\d+: methods.1.name: "),
        ("horizon", "horizn", r":11: routes.1.set.drive.horizn: "),
        ("= 0.5", "= 5", r":\d+: methods.1.set.attack.method.first_block: "),
        (
            "first_block = 0.5",
            "frames = 7",
            r":\d+: methods.1.set.attack.method.frames: ",
        ),
        ("[40]", "[9]", r": budgets: 9 frames; .*gradient costs 10"),
        ("backward_multiple = 1.5", "", r": backward_multiple: "),
        (
            "budgets = [40]\nbackward_multiple = 1.5",
            "",
            r":\d+: attack.method.max_iterations: .*blocks",
        ),
        ('d = "ob', 'd = "no', r"noject.safetensors"),
    ],
)
def test_what_is_wrong_is_told_where_it_stands(write_grid, old, new, where):
    with pytest.raises(InputError) as error:
        load_cells(write_grid((old, new)))
    assert re.search(where, str(error.value)), error.value


def test_a_method_has_a_multiple_of_its_own(write_grid):
    def lengths(*changes):
        cells = load_cells(write_grid(*changes))
        attacks = [parse_toml("cell", cell.text)["attack"] for cell in cells]
        return {attack["method"].get("max_iterations") for attack in attacks}

    assert lengths() == {None, 4, 3}  # 40 / 2.5 over 4 and 5 frames a drive
    own = ('"gradient"', '"gradient"\nbackward_multiple = 4.0')
    assert lengths(own) == {None, 2, 1}


def test_no_iteration_is_lost_by_rounding(write_grid):
    """20 iterations of 4 frames, each with 2.1 drives: 168 frames."""
    new = "budgets = [168]\nbackward_multiple = 1.1"
    cells = load_cells(write_grid(("budgets = [40]\nbackward_multiple = 1.5", new)))
    near = [cell for cell in cells if (cell.route, cell.method) == ("near", "gradient")]
    attacks = [parse_toml("cell", cell.text)["attack"] for cell in near]
    assert {attack["method"]["max_iterations"] for attack in attacks} == {20}


def test_a_grid_without_end_is_refused(write_grid, monkeypatch):
    monkeypatch.setattr(module, "MOST_CELLS", 11)
    with pytest.raises(InputError, match="11 cells"):
        load_cells(write_grid())
