"""The plot of an attack's search holds what it shows."""

from __future__ import annotations

from mi_nerfattack.io import files
from mi_nerfattack.report.plots.charts import WIDTH_PX
from mi_nerfattack.report.plots.convergence import convergence

BLUE, ORANGE = (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)


def test_iterations_and_the_best_so_far_are_drawn(tmp_path):
    history = [{"objective": -i, "cross_track_mean_m": 0.1 * i} for i in range(5)]
    means = [0.0, 0.1, 0.2, 0.3, 0.4, 0.4]
    curve = {"frames": [10, 35, 60, 85, 110, 135], "cross_track_mean_m": means}
    curve["objective"] = [0.0, -1.0, -2.0, -3.0, -4.0, -4.0]
    for given in (None, curve):
        path = tmp_path / "convergence.png"
        convergence(path, history, given)
        image = files.read_image(path)
        assert image.shape[1] == WIDTH_PX
        away = [abs(image[..., :3].astype(int) - c).max(-1) for c in (BLUE, ORANGE)]
        blue, orange = ((distance <= 12).sum() for distance in away)
        assert orange > 1000
        assert blue > 1000 if given else blue == 0
