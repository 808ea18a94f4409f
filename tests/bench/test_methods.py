"""The page of methods at equal frames, of made drives whose figures are known."""

from __future__ import annotations

import pytest

from bench.methods.page import page
from bench.methods.tuning import chosen, settings_of
from mi_nerfattack.experiment.sweep.summary import summarise

MADE = {"date": "2030-01-01", "machine": {"cores": 2}, "command": "the command"}
ROUTES = ["straight", "right"]
#: Mean errors of settings by route; the last one's second route is not done.
TUNED = {
    "gradient_0.1": (0.1, 0.9),
    "gradient_0.3": (0.4, 0.4),
    "random_noise": (0.2, 0.1),
    "blocks_0.1": (0.3, 0.3),
    "blocks_0.3": (0.6, None),
}
GRID = {
    "methods": [{"name": name} for name in TUNED],
    "routes": [{"name": name} for name in ROUTES],
    "seeds": [0],
}
COMPARED = GRID | {"methods": GRID["methods"][:3], "seeds": [1, 2, 3]}


def rows(methods, seeds):
    """Return drives past attacks, each seed's errors a tenth of a millimetre apart."""
    found = []
    for method, errors in methods.items():
        for route, error in zip(ROUTES, errors, strict=True):
            for seed in range(seeds if error is not None else 0):
                cell = f"{route}-{method}-{seed}"
                labels = {"cell": cell, "route": route, "objects": "six", "run": 0}
                labels |= {"method": method, "budget": 50, "seed": seed, "error": None}
                labels |= {"status": "complete", "environment": "surrogate"}
                labels |= {"digests": "{}", "versions": '{"mitsuba": "3"}'}
                labels |= {"steps": 72, "departed": False, "wheel_out_s": 0.0}
                labels |= {"case": "attack", "frames": 50}
                found.append(labels | {"cross_track_mean_m": error + 1e-4 * seed})
    return found


def test_the_largest_geometric_mean_is_chosen():
    """0.4 beats the root of 0.1 x 0.9, 0.3; one unfinished setting leaves all open."""
    settings = settings_of(summarise(rows(TUNED, 1)), TUNED, ROUTES)
    best = chosen(settings)
    assert {name: setting.name for name, setting in best.items()} == {
        "gradient": "gradient_0.3",
        "random": "random_noise",
    }
    assert settings[0].score == pytest.approx(0.3)
    assert settings[-1].score is None


def test_methods_beside_the_gradient():
    methods = {"gradient": (0.4, 0.8), "blocks": (0.1, 0.2), "above": (0.5, 1.0)}
    table = rows(methods, 2)
    tuning = summarise(rows(TUNED, 1))
    text = page(summarise(table), table, tuning, GRID, COMPARED, MADE)
    start = "| right | blocks | 50 |"
    found = [line for line in text.splitlines() if line.startswith(start)]
    assert found == [
        "| right | blocks | 50 |  | 0.200 ± 0.000 [0.200, 0.200] (2); 0/2 out [0, 66] "
        "| 0.25 [0.250, 0.250] |"
    ]
    assert "| gradient | gradient_0.3 | 0.400 | 0.400 | 0.400 | chosen |" in text
    assert "| blocks | blocks_0.3 | 0.600 |  |  |  |" in text
    assert "scenes/methods.toml -o FOLDER" in text
    assert "\n12 of 18 attacks are complete." in text
    aims = text.partition("## What was aimed at")[2].partition("## Surrogate")[0]
    assert "| straight | blocks | 0.25 [0.250, 0.250] | 2 | yes |" in aims
    assert "| right | above | 1.25 [1.250, 1.250] | 2 | **no** |" in aims


def test_settings_alone():
    table = rows(TUNED, 1)
    text = page(None, table, summarise(table), GRID, COMPARED, MADE)
    assert "9 of 10 attacks are done." in text and "scenes/methods.toml -o" not in text
