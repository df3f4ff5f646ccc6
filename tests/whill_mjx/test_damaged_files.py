"""A damaged vehicle file, map or note of a training gives a value or an error that names the file."""

from __future__ import annotations

import dataclasses
import json

import cv2
import jax
import numpy as np
import pytest
from damaged_bytes import check

from whill_mjx.evaluation.policy_world import trained_fields
from whill_mjx.tasks.tasks import ObstacleCourse, make_task
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle
from whill_mjx.world.maps import load_map

pytestmark = pytest.mark.quick


def test_a_damaged_vehicle_file(tmp_path):
    spec, params = preset("whill_cr_physical")
    vehicle = save_vehicle(tmp_path / "vehicle.toml", spec, params, {"body.mass": (50.0, 55.0)}, {"by": "hand"})

    def read():
        spec, params, _ = load_vehicle(vehicle)
        assert spec.track > 0 and spec.v_max > 0 > -spec.omega_max and 0 < spec.camera.fov_y < np.pi
        assert not any(np.isnan(leaf) for leaf in jax.tree.leaves(params)) and 0 < float(params.body.mass) < 1e5
        for low, high in load_intervals(vehicle).values():
            assert low <= high

    check(vehicle, vehicle.read_bytes(), read)


@pytest.mark.parametrize("name", ["map.yaml", "map.pgm", "map.png"])
def test_a_damaged_map(tmp_path, name):
    pixels = np.full((6, 9), 254, np.uint8)
    pixels[2:4, 3] = 0
    (tmp_path / "map.pgm").write_bytes(b"P5\n# hand\n9 6\n255\n" + pixels.tobytes())
    cv2.imwrite(str(tmp_path / "map.png"), pixels)
    image = "map.pgm" if name == "map.yaml" else name
    text = (f"image: {image}\nresolution: 0.05\norigin: [1.0, 2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
            "free_thresh: 0.196\nmode: trinary\n")
    (tmp_path / "map.yaml").write_text(text)

    def read():
        grid = load_map(tmp_path / "map.yaml")
        assert grid.cells.size and 0 < grid.resolution < 1e3 and np.isfinite(grid.origin).all()

    path = tmp_path / name
    check(path, path.read_bytes(), read, 60)


def test_a_damaged_note_of_a_training(tmp_path):
    path = tmp_path / "run.json"
    good = json.dumps({"command": {"seed": 0}, "preset": {"task": dataclasses.asdict(ObstacleCourse())}}).encode()

    def read():
        task = trained_fields(tmp_path / "policy", "obstacle_course")
        try:
            make_task("obstacle_course", **task)
        except ValueError as error:  # of two values that do not go together, which the command names
            assert "task" in str(error) or "limits" in str(error) or "layout" in str(error)

    check(path, good, read)
