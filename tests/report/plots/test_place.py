"""The picture of a place without a scenario, as `capture` and `train` write it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tiny_place import write_place

from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields.io import load_field
from mi_nerfattack.io import files
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.report.plots.place import Overlay, car_outline, routes_picture
from mi_nerfattack.vehicle.route.route import load_routes


@pytest.mark.usefixtures("variant")
def test_scene_field_and_routes(tmp_path):
    place = write_place(tmp_path)
    assert place.field is not None
    sensor = field_sensor(PosedField(load_field(place.field)), [], place.camera)
    routes, path = load_routes(place.routes), tmp_path / "place.png"
    routes_picture(path, place.scene, routes, place.camera, place.mount, sensor, "a")
    height, width, _ = files.read_image(path).shape
    assert width == 1600 and 300 < height < 1600
    overhead = Overlay(routes).overhead(100)
    assert overhead.extent[:2] == pytest.approx((-5.25, 45.25))


def test_a_car_stands_about_its_rear_axle():
    corners = car_outline(np.array([2.0, 1.0, np.pi / 2]), 1.8)
    np.testing.assert_allclose(
        [corners.min(0), corners.max(0)], [[1.1, 0.1], [2.9, 4.42]]
    )
