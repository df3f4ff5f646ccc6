"""A damaged vehicle file, map or note of a training gives a value or an error that names the file."""

from __future__ import annotations

import dataclasses
import json

import cv2
import jax
import numpy as np
import pytest
from damage import Costs
from damaged_bytes import check

from whill_mjx import maps
from whill_mjx.evaluation.policies.policy_world import trained_fields
from whill_mjx.io.command_line import OptionError
from whill_mjx.io.folders import FolderRefused, claim_folder
from whill_mjx.io.reading import read_lines
from whill_mjx.learning.checks import Stopper, read_best
from whill_mjx.tasks.tasks import ObstacleCourse, make_task
from whill_mjx.vehicle.presets import preset
from whill_mjx.vehicle.vehicle_file import load_intervals, load_vehicle, save_vehicle
from whill_mjx.world.maps import load_map, read_map
from whill_mjx.world.maps.grid import OCCUPIED

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


def nodes(corners):
    return "".join(f'<node id="{i}" lat="{35 + 1e-5 * y:.6f}" lon="{139 + 1e-5 * x:.6f}"/>'
                   for i, (x, y) in enumerate(corners, 1))  # fmt: skip


SQUARE = [(0, 0), (12, 0), (12, 10), (0, 10)]
OSM = (f'<osm version="0.6">{nodes([*SQUARE, (3, 3), (5, 3), (5, 5)])}<way id="1">'
       + "".join(f'<nd ref="{k}"/>' for k in (1, 2, 3, 4, 1))
       + '<tag k="building" v="yes"/></way><way id="2"><nd ref="5"/><nd ref="6"/><nd ref="7"/><nd ref="5"/></way>'
       '<relation id="1"><member type="way" ref="1" role="outer"/><member type="way" ref="2" role="inner"/>'
       '<tag k="building" v="yes"/></relation></osm>')  # fmt: skip
GML = ('<CityModel xmlns:gml="g" xmlns:bldg="b"><gml:Envelope srsName="http://www.opengis.net/def/crs/EPSG/0/6677" '
       'srsDimension="3"/><cityObjectMember><bldg:Building><bldg:lod0FootPrint><gml:Polygon><gml:exterior>'
       '<gml:LinearRing><gml:posList srsDimension="3">0 0 1 9 0 1 9 7 1 0 7 1 0 0 1</gml:posList></gml:LinearRing>'
       '</gml:exterior><gml:interior><gml:LinearRing><gml:pos>2 2 1</gml:pos><gml:pos>4 2 1</gml:pos>'
       '<gml:pos>4 4 1</gml:pos></gml:LinearRing></gml:interior></gml:Polygon></bldg:lod0FootPrint></bldg:Building>'
       '</cityObjectMember></CityModel>')  # fmt: skip


@pytest.mark.parametrize(("name", "text"), [("town.osm", OSM), ("town.gml", GML)], ids=["osm", "citygml"])
def test_a_damaged_map_of_a_town(tmp_path, name, text):
    path = tmp_path / name

    def read():
        grid = read_map(path, 0.5)
        assert grid.cells.size and np.isfinite(grid.origin).all() and (grid.cells == OCCUPIED).any()

    check(path, text.encode(), read, 120)


def test_a_town_of_many_buildings_far_apart_is_read_in_the_time_that_is_promised(tmp_path):
    buildings = []
    for k in range(3000):
        x, y = 2 * (k % 60), 2 * (k // 60)
        buildings.append(f"<Building><Polygon><LinearRing><posList>{x} {y} 0 {x + 1} {y} 0 {x + 1} {y + 1} 0 {x} "
                         f"{y + 1} 0 {x} {y} 0</posList></LinearRing></Polygon></Building>")  # fmt: skip
    path = tmp_path / "town.gml"
    path.write_text(f"<CityModel>{'<a>' * 500}{''.join(buildings)}{'</a>' * 500}</CityModel>")
    with Costs():
        grid = read_map(path, 0.05)
    assert (grid.cells == OCCUPIED).sum() == 3000 * 21 * 21  # cells that an edge touches are walls


def test_a_damaged_map_that_is_imported(tmp_path):
    path = tmp_path / "map.yaml"
    pixels = np.full((60, 80), 254, np.uint8)
    pixels[:, 0] = pixels[20:30, 40] = 0
    cv2.imwrite(str(tmp_path / "map.png"), pixels)
    good = (b"image: map.png\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
            b"occupied_thresh: 0.65\nfree_thresh: 0.2\n")  # fmt: skip

    def read():
        try:
            maps.main(maps.Import(path, tmp_path / "scene", pixels=100))
        except OptionError as error:
            raise ValueError(*error.args) from None

    check(path, good, read, 6)
    assert {one.name for one in tmp_path.glob(".*")} == {".scene.npz.written", ".scene.png.written"}  # no half files


@pytest.mark.parametrize("name", ["best.json", "stopped.json", "metrics.jsonl"])
def test_what_a_training_wrote_and_finds_damaged_is_left_aside(tmp_path, name, capsys):
    good = {"best.json": b'{"env_steps": 500, "success": 0.5, "return": 3.5}',
            "stopped.json": b'{"env_steps": 500, "success": 0.5}',
            "metrics.jsonl": b'{"env_steps": 500, "eval/success": 0.9}\n{"env_steps": 900, "eval/success": 0.9}\n'}
    (tmp_path / "stopped.json").write_bytes(good["stopped.json"])

    def read():
        assert read_best(tmp_path) is None or {"env_steps", "success", "return"} <= set(read_best(tmp_path))
        stopper = Stopper(tmp_path, 0.5)
        assert stopper.total_steps(1000) <= 1000
        assert not stopper({"env_steps": 1000.0, "eval/success": 0.1})
        for text, line in read_lines(tmp_path / "metrics.jsonl"):
            assert json.loads(text) == line or any(value != value for value in line.values())

    check(tmp_path / name, good[name], read)


def test_a_damaged_identity_of_a_folder(tmp_path):
    path = tmp_path / "run.json"

    def read():
        try:
            with claim_folder(tmp_path, "whill_mjx.train") as claim:
                claim.settle({"seed": 0})
        except FolderRefused as error:
            raise ValueError(*error.args) from None

    check(path, b'{"kind": "whill_mjx.train", "identity": {"seed": 0}}', read, 60)


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
