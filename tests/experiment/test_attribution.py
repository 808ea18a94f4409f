"""When and where a failure is made: shares by hand, heat of known gradients."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.small_fields import blob, vertices
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from PIL import Image

from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.report.plots import charts, heat
from mi_nerfattack.report.plots.heat import (
    SIDES,
    SideView,
    side_views,
    surface_heat,
    write_heat,
)
from mi_nerfattack.report.plots.time import TimeAttribution, plot_attribution

pytestmark = pytest.mark.usefixtures("variant")


def attribution(steps=5, vehicles=2, size=3, **changes):
    rng = np.random.default_rng(0)
    fields = {
        "time_s": 0.1 * np.arange(1, steps + 1),
        "costates": rng.normal(size=(steps, vehicles, size)),
        "along": rng.normal(1, 1, (steps, 2)),
        "cross_track_m": rng.normal(size=(steps, vehicles)),
        "limit_m": 0.85,
        "objects": ["hydrant", "poster"],
    }
    return TimeAttribution(**{**fields, **changes})


def test_shares_are_parts_of_the_gradient():
    along = np.array([[1.0, 2.0], [-1.0, 6.0]])
    data = attribution(2, along=along)
    np.testing.assert_allclose(data.shares, [[0.125, 0.25], [-0.125, 0.75]])
    assert not attribution(2, along=0 * along).shares.any()


@pytest.mark.parametrize(
    ("steps", "vehicles", "size"), [(5, 2, 3), (1, 1, 3), (3, 1, 4), (1, 4, 5)]
)
def test_plot(tmp_path, steps, vehicles, size):
    path = tmp_path / "attribution.png"
    plot_attribution(path, attribution(steps, vehicles, size))
    with Image.open(path) as image:
        assert image.width == 1200
    first = path.read_bytes()
    plot_attribution(path, attribution(steps, vehicles, size))
    assert path.read_bytes() == first


def test_plot_without_a_gradient(tmp_path):
    """A drive that no texture changes is drawn, too."""
    zero = np.zeros((5, 2))
    data = attribution(along=zero, costates=np.zeros((5, 2, 3)), cross_track_m=zero)
    plot_attribution(tmp_path / "attribution.png", data)


def test_gradients_that_are_not_finite_are_named():
    with pytest.raises(InputError, match="along: not finite"):
        attribution(along=np.full((5, 2), np.nan))


def shown(grid):
    """Return the mask of the vertices of the level that is shown, and its voxel."""
    level, resolution = heat._shown_level(grid)
    start = grid.encoding.level_offset(level)
    mask = np.zeros(grid.n_vertices, bool)
    mask[start : start + resolution**3] = True
    return mask, np.prod((grid.upper - grid.lower) / (resolution - 1))


def test_constant_gradient_gives_constant_heat(rng):
    """Interpolation keeps a constant: its norm 5, over the volume of a voxel."""
    grid = blob(rng, peak=4.0)
    gradient = np.tile([3.0, 0.0, -4.0], (grid.n_vertices, 1))
    mask, voxel = shown(grid)
    values = surface_heat(grid, gradient)
    np.testing.assert_allclose(values[mask], 5 / voxel)
    assert not values[~mask].any()
    views = side_views(grid, gradient, 40)
    assert [view.name for view in views] == list(heat.SIDES)
    for view in views:
        assert view.colour.shape == (*view.heat.shape, 3)
        assert max(view.heat.shape) == 40
        known = view.heat[np.isfinite(view.heat)]
        assert 50 < known.size < view.heat.size
        np.testing.assert_allclose(known, 5 / voxel, rtol=1e-3)
        assert np.all(view.colour[~np.isfinite(view.heat)] > 0.8)


def test_heat_lies_where_the_gradient_is(rng):
    """A gradient on the half of +x is seen from +x and not from -x."""
    grid = blob(rng, peak=6.0)
    gradient = np.where(vertices(grid)[:, :1] > 0.3, [[0.0, 2.0, 0.0]], 0.0)
    views = {view.name: view.heat for view in side_views(grid, gradient, 40)}
    middle = tuple(size // 2 for size in views["from +x"].shape)
    assert views["from +x"][middle] > 20 * views["from -x"][middle]
    # seen from +y, the hot side is on the left: x points to the left there
    width = views["from +y"].shape[1]
    left = np.nansum(views["from +y"][:, : width // 2])
    right = np.nansum(views["from +y"][:, width // 2 :])
    assert left > 20 * right
    assert np.nansum(views["from -y"][:, : width // 2]) < 0.05 * left


def test_picture(tmp_path, rng):
    grid = blob(rng)
    gradient = rng.normal(size=(grid.n_vertices, 3))
    views = side_views(grid, gradient, 24)
    path = tmp_path / "attribution_object.png"
    write_heat(path, {"hydrant": views, "poster": views})
    with Image.open(path) as image:
        assert image.width == 1200 and image.height > 1000
    write_heat(path, {"still": side_views(grid, 0 * gradient, 24)})


def test_no_label_of_the_picture_is_cut_or_covered(tmp_path, monkeypatch):
    """Of flat objects with long names, too."""
    figures = []
    monkeypatch.setattr(charts, "save", lambda path, figure: figures.append(figure))
    shapes = {"a_delivery_van_beside_the_exit": (50, 160), "a_hydrant": (160, 90)}
    objects = {
        name: [SideView(side, np.ones((*shape, 3)), np.ones(shape)) for side in SIDES]
        for name, shape in shapes.items()
    }
    for shown in (objects, dict([*objects.items()][:1])):
        write_heat(tmp_path / "heat.png", shown)
    for figure in figures:
        FigureCanvasAgg(figure).draw()
        words = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text()]
        assert {"as it looks", "sensitivity"} <= {text.get_text() for text in words}
        boxes, page = (
            [text.get_window_extent() for text in words],
            figure.bbox.padded(1),
        )
        for box in boxes:
            assert page.x0 <= box.x0 < box.x1 <= page.x1
            assert page.y0 <= box.y0 < box.y1 <= page.y1
        for one, other in itertools.combinations(boxes, 2):
            assert not one.overlaps(other)


def test_a_failure_is_taken_apart(tmp_path):
    """Shares add up to 1; the last costate is minus the derivative of the last cost."""
    from helpers import toy_loop as toy

    from mi_nerfattack.attack.gradient import GradientAttack
    from mi_nerfattack.attack.objectives import AbsoluteDeviation
    from mi_nerfattack.experiment.attribution import attribute, write_attribution
    from mi_nerfattack.rollout.function import Rollout
    from mi_nerfattack.rollout.objective import StageSum

    loop, grid = toy.make_loop()
    objective = StageSum(AbsoluteDeviation(toy.ROUTE))
    initial = loop.initial(np.array([[0.0, 0.1, 0.0], [0.0, -0.2, 0.05]]))
    attack = GradientAttack(Rollout(loop, objective, 3), toy.ROUTE, initial)
    attack.measure()
    steps = []
    found = attribute(attack, ["ball"], 0.85, steps.append)
    assert len(steps) == 9
    times = found.times
    assert times.costates.shape == (3, 2, 3) and times.shares.shape == (3, 1)
    assert times.shares.sum() == pytest.approx(1, rel=1e-6)
    square = (found.textures[0].astype(float) ** 2).sum()
    assert times.along.sum() == pytest.approx(square, rel=1e-4)
    # the last image steers the last period, whose heading no state follows
    assert found.norms[-1, 0] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(times.time_s, toy.DT * np.array([1, 2, 3]))
    side = np.sign(times.cross_track_m[-1])
    np.testing.assert_allclose(
        times.costates[-1], [[0, side[0] / 2, 0], [0, side[1] / 2, 0]], atol=1e-12
    )
    write_attribution(tmp_path, found, [grid])
    pictures = list(tmp_path.glob("attribution*.png"))
    assert len(pictures) == 2 and all(p.stat().st_size > 5000 for p in pictures)
    data = files.read_json(tmp_path / "attribution.json")
    assert len(data["gradient_share"]["ball"]) == 3
