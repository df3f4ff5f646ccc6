"""Maps as scenes: straight walls, what a camera sees of them, starts and goals, footprints of cities, the command."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx import maps
from whill_mjx.env import make_env, observe, reset_state, step_state
from whill_mjx.env.moments import view_of
from whill_mjx.io.command_line import OptionError
from whill_mjx.learning.identity import identity_of
from whill_mjx.learning.setup import find_preset
from whill_mjx.sensors.depth import Depth
from whill_mjx.tasks.base import Task
from whill_mjx.tasks.check import check_world
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.tasks.parts import make_marker
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.specs import SPECS, WARTHOG, WHILL_CR, CameraMount
from whill_mjx.world.collision import free_distance, obstacles_of, touches
from whill_mjx.world.maps import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridMap,
    Reach,
    cast,
    load_footprints,
    load_map,
    make_map_scene,
    map_scene_sampler,
    picture,
    reach_of,
    read_map,
    shown,
)
from whill_mjx.world.maps import walls as map_wall_module
from whill_mjx.world.maps.places import farthest_move
from whill_mjx.world.maps.several import GAP, side_by_side
from whill_mjx.world.maps.straight import open_space, outline, straight_walls
from whill_mjx.world.maps.walls import map_walls, most_seen, sees_behind, wall_boxes
from whill_mjx.world.maps.ways import SPACING, draw_ways
from whill_mjx.world.render import camera_rotation, pinhole, render_frame
from whill_mjx.world.scene import Scene, default_looks, footprint, no_boxes, stack_boxes

pytestmark = pytest.mark.quick
SHARED = Path(__file__).parents[3] / "shared" / "data" / "maps"


def tilted_room(cells=120, size=0.05, angle=0.3):
    """A square room of 4 m, turned by `angle`, in cells of 5 cm."""
    row, column = np.mgrid[:cells, :cells]
    x, y = (column + 0.5 - cells / 2) * size, (row + 0.5 - cells / 2) * size
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = (abs(along) < 2.0) & (abs(across) < 2.0)
    return GridMap(np.where(inside, FREE, OCCUPIED).astype(np.uint8), size, (-cells * size / 2, -cells * size / 2, 0.0))


def test_the_outline_runs_around_every_cell_with_the_space_on_its_left():
    space = np.random.default_rng(0).random((9, 13)) < 0.6
    loops = outline(space)
    nexts = [np.roll(loop, -1, 0) for loop in loops]
    area = sum((a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]).sum() / 2 for a, b in zip(loops, nexts, strict=True))
    assert area == space.sum()
    steps = np.concatenate(nexts) - np.concatenate(loops)
    assert ((steps == 0).sum(1) == 1).all()


def test_the_steps_of_a_slanted_wall_become_one_wall():
    grid = tilted_room()
    walls = straight_walls(grid, open_space(grid))
    length = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1)
    assert len(walls) <= 12 and np.sort(length)[-4:].min() > 3.6
    turned = walls.reshape(-1, 2) @ [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    assert np.abs(np.abs(turned).max(-1) - 2.0).max() < 0.075


def test_streaks_and_specks_go_and_pillars_stay():
    cells = np.full((60, 60), OCCUPIED, np.uint8)
    cells[5:50, 5:50] = FREE
    cells[20, 50:60] = FREE  # a laser through a window
    cells[30:32, 30:32] = UNKNOWN  # a speck
    cells[40:42, 20:22] = OCCUPIED  # a table leg
    cells[10:20, 10:20] = UNKNOWN  # a cupboard
    space = open_space(GridMap(cells, 0.05, (0.0, 0.0, 0.0)))
    assert not space[20, 50:].any() and space[30:32, 30:32].all()
    assert not space[40:42, 20:22].any() and not space[10:20, 10:20].any()


@pytest.mark.quick
@pytest.mark.parametrize("most", [1, 7, 29])
def test_walls_met_block_by_block_are_those_of_all_at_once(monkeypatch, most):
    rng = np.random.default_rng(1)
    ends = jnp.asarray(rng.uniform(-5, 5, (30, 2, 2)), jnp.float32)
    angles = jnp.linspace(-3.0, 3.0, 41)
    place = jnp.asarray(rng.uniform(-1, 1, (2, 41, 1)), jnp.float32)  # each ray begins at its own
    distance, index = cast(ends, *place, angles)
    monkeypatch.setattr(map_wall_module, "MOST", most)
    blocks, which = cast(ends, *place, angles)
    np.testing.assert_allclose(blocks, distance, rtol=1e-4)
    met = np.isfinite(distance)
    assert 20 < met.sum() and len(set(index[met].tolist())) > 5
    np.testing.assert_array_equal(which[met], index[met])



def test_a_ray_meets_the_first_wall_and_none_slips_through_a_corner():
    grid = tilted_room()
    walls = jnp.asarray(straight_walls(grid, open_space(grid)), jnp.float32)
    angle = jnp.linspace(0.0, 2 * np.pi, 2001)
    distance, index = cast(walls, 0.3, -0.2, angle)
    assert np.isfinite(distance).all() and distance.min() > 1.6 and distance.max() < 3.4
    start, end = walls[index, 0], walls[index, 1]
    point = jnp.stack([0.3 + distance * jnp.cos(angle), -0.2 + distance * jnp.sin(angle)], -1)
    way = end - start
    aside = (point - start)[:, 0] * way[:, 1] - (point - start)[:, 1] * way[:, 0]
    np.testing.assert_allclose(aside / jnp.linalg.norm(way, axis=-1), 0.0, atol=1e-4)


def test_a_wall_that_is_seen_end_on_is_met_at_the_corner():
    corners = np.array([[2.0, 0.0], [2.0, 1.0], [4.0, 1.0], [4.0, 0.0]], np.float32)
    walls = jnp.asarray(np.stack([corners, np.roll(corners, -1, 0)], 1))
    distance, index = cast(walls, 0.0, 0.0, jnp.array([0.0, np.pi / 2]))
    assert float(distance[0]) == pytest.approx(2.0, abs=1e-5) and int(index[0]) == 0 and np.isinf(distance[1])


def test_the_most_seen_come_first_and_once():
    index, mask = most_seen(jnp.array([7, 3, 7, 7, 9, 3, 1]), 3)
    assert mask.all() and list(np.asarray(index[:2])) == [7, 3] and int(index[2]) in (1, 9)
    index, mask = most_seen(jnp.array([4, 4]), 4)
    assert int(mask.sum()) == 1 and int(index[0]) == 4


def many_rooms():
    """Rooms in a row with doors, 60 pillars: more walls than an image may show."""
    cells = np.full((160, 400), FREE, np.uint8)
    cells[[0, -1]] = OCCUPIED
    cells[:, [0, -1]] = OCCUPIED
    for column in range(80, 400, 80):
        cells[:, column : column + 3] = OCCUPIED
        cells[60:100, column : column + 3] = FREE
    rng = np.random.default_rng(2)
    for row, column in rng.integers(8, [150, 390], (60, 2)):
        cells[row : row + 4, column : column + 4] = OCCUPIED
    return GridMap(cells, 0.05, (-10.0, -4.0, 0.4))


def test_a_camera_sees_the_walls_that_all_walls_would_show():
    """At most 1 % of the horizon is off by more than 0.5 m against an image of every wall."""
    made = make_map_scene(many_rooms(), keep=64)
    scene, _ = map_scene_sampler(made)(jax.random.key(0))
    segments = jnp.asarray(made.walls.segments)
    assert 200 < len(segments) < 2000
    every = wall_boxes(segments, jnp.arange(len(segments)), jnp.ones(len(segments), bool), 2.2, (0.8, 0.8, 0.7))
    lens = pinhole(1.0, 64, 64)

    @jax.jit
    @jax.vmap
    def wrong(start):
        position, rotation = jnp.append(start[:2], 1.0), camera_rotation(start[2], 0.1, 0.0)
        few = shown(scene, position, rotation, lens)
        row = 32 + jnp.round(jnp.tan(-0.1) * lens.fy).astype(int)  # of the horizon
        one = render_frame(position, rotation, lens, few).depth[row]
        all_of = render_frame(position, rotation, lens, dataclasses.replace(scene, boxes=every, walls=None)).depth[row]
        return jnp.mean((jnp.abs(one - all_of) > 0.5) | (jnp.isfinite(one) != jnp.isfinite(all_of)))

    starts = jnp.asarray(made.places.start[::128], jnp.float32)
    assert float(wrong(starts).mean()) <= 0.01


def test_a_camera_on_its_side_or_its_head_sees_the_walls_that_all_walls_would_show():
    """The horizon of a camera on its side runs from the upper to the lower edge of the image."""
    made = make_map_scene(many_rooms(), keep=64)
    scene, _ = map_scene_sampler(made)(jax.random.key(0))
    segments = jnp.asarray(made.walls.segments)
    every = wall_boxes(segments, jnp.arange(len(segments)), jnp.ones(len(segments), bool), 2.2, (0.8, 0.8, 0.7))
    lens = pinhole(1.0, 48, 64)

    @jax.jit
    @jax.vmap
    def wrong(start, pitch, roll):
        position, rotation = jnp.append(start[:2], 1.0), camera_rotation(start[2], pitch, roll)
        one = render_frame(position, rotation, lens, shown(scene, position, rotation, lens)).depth
        all_of = render_frame(position, rotation, lens, dataclasses.replace(scene, boxes=every, walls=None)).depth
        return jnp.mean((jnp.abs(one - all_of) > 0.05) | (jnp.isfinite(one) != jnp.isfinite(all_of)))

    starts = jnp.asarray(made.places.start[::256], jnp.float32)
    for roll in (np.pi / 2, -np.pi / 2, np.pi):
        for pitch in (0.0, 0.4):
            share = wrong(starts, jnp.full(len(starts), pitch), jnp.full(len(starts), roll))
            assert float(share.mean()) < 0.01, (roll, pitch)


@pytest.mark.parametrize("pitch", [0.0, 0.4, 0.8])
def test_a_camera_that_looks_down_sees_the_walls_beside_its_horizon(pitch):
    """A pillar to the left, which lies in the lower corner of the image, and beyond the bearings of its horizon."""
    lens, position = pinhole(1.2, 48, 48), jnp.array([0.0, 0.0, 0.8])
    corners = 5.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    aside = np.tan(0.57)
    ahead, below = np.cos(pitch) - aside * np.sin(pitch), np.sin(pitch) + aside * np.cos(pitch)
    corner = 0.8 / below * np.array([ahead, aside])  # where the image's corner shows the ground
    pillar = 0.8 * corner + 0.03 * corners[::-1] / 5.0
    segments = np.concatenate([np.stack([one, np.roll(one, -1, 0)], 1) for one in (corners, pillar)])
    scene = Scene(no_boxes(8), make_marker(50.0, 0.0, 0.1, 0.1), default_looks(), walls=map_walls(segments, keep=8))
    every = wall_boxes(jnp.asarray(segments, jnp.float32), jnp.arange(8), jnp.ones(8, bool), 2.2, (0.8, 0.8, 0.7))
    for yaw in (0.0, 2.0):
        turn = jnp.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        rotation = camera_rotation(0.0, pitch, 0.0)
        turned = dataclasses.replace(scene, walls=map_walls(segments @ np.asarray(turn[:2, :2]).T, keep=8))
        seen = render_frame(position, turn @ rotation, lens, shown(turned, position, turn @ rotation, lens)).depth
        right = render_frame(position, rotation, lens, dataclasses.replace(scene, boxes=every, walls=None)).depth
        assert (np.abs(seen - right) > 0.05).mean() < 0.005
        assert float(right[-1, 0]) < 1.0  # the pillar


LOOKS_DOWN = CameraMount(x=0.0, z=0.9, pitch=1.4, fov_y=1.6)
AROUND = 0.35 * np.stack([np.cos(np.arange(5.0)), np.sin(np.arange(5.0))], -1)  # middles of pillars


def pillared():
    """A room around zero with pillars near zero on all sides, of which an image shows what the camera sees, and all."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rings = [5.0 * corners, *(middle + 0.06 * corners[::-1] for middle in AROUND)]
    walls = map_walls(np.concatenate([np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in rings]), keep=24)
    scene = Scene(no_boxes(24), make_marker(50.0, 0.0, 0.1, 0.1), default_looks(), walls=walls)
    every = wall_boxes(jnp.asarray(walls.segments), jnp.arange(24), jnp.ones(24, bool), 2.2, scene.boxes.colour[0])
    return scene, dataclasses.replace(scene, boxes=every, walls=None)


@pytest.mark.parametrize("pitch", [1.2, 1.4, np.pi / 2, -1.2])
@pytest.mark.parametrize("roll", [0.0, 0.7])
def test_a_camera_that_looks_steeply_sees_the_walls_behind_it(pitch, roll):
    scene, every = pillared()
    mount = dataclasses.replace(LOOKS_DOWN, pitch=pitch, roll=roll)
    lens, eye = pinhole(mount.fov_y, 48, 48), (jnp.array([0.0, 0.0, 0.9]), camera_rotation(0.3, pitch, roll))

    @partial(jax.jit, static_argnums=0)
    def wrong(mount):
        seen, right = (render_frame(*eye, lens, one).depth for one in (shown(scene, *eye, lens, mount), every))
        return jnp.mean((jnp.abs(seen - right) > 0.05) | (jnp.isfinite(seen) != jnp.isfinite(right)))

    assert float(wrong(mount)) < 0.005 < float(wrong(None))


def test_only_cameras_that_look_steeply_see_what_is_behind_them():
    assert not any(sees_behind(spec.camera, 64, 64) for spec in SPECS.values())
    level = CameraMount(pitch=0.8, fov_y=1.2)
    assert not sees_behind(level, 64, 64) and not sees_behind(dataclasses.replace(level, pitch=-0.8), 64, 64)
    tall = dataclasses.replace(level, roll=np.pi / 2)  # on its side, the image's width lies along the pitch
    assert sees_behind(tall, 64, 128) and not sees_behind(tall, 64, 64)


def test_the_images_of_a_vehicle_show_what_is_behind_a_camera_that_looks_down():
    scene, every = pillared()
    env, params = make_env("point_goal", observations={"depth": Depth(32, 32)}, height=32, width=32)
    camera = dataclasses.replace(LOOKS_DOWN, x=env.model.spec.reference_x)  # above zero, where the vehicle starts
    spec = dataclasses.replace(env.model.spec, camera=camera)
    env = dataclasses.replace(env, model=dataclasses.replace(env.model, spec=spec))
    start = dataclasses.replace(jax.jit(lambda key: reset_state(env, params, key))(jax.random.key(0)), trail=None)

    @jax.jit
    def images(scene):
        state = dataclasses.replace(start, scene=scene)
        depth = env.sensors[0][1].measure((), view_of(env, params, state), jax.random.key(0))[1]
        return observe(env, state).astype(float).mean(-1), depth

    for seen, right in zip(images(scene), images(every), strict=True):
        assert float(jnp.mean(jnp.abs(seen - right) > 0.05)) < 0.005


def test_starts_and_goals_are_free_and_a_way_apart():
    made = make_map_scene(many_rooms(), Reach(nearest=4.0, farthest=9.0))
    places, segments = made.places, made.walls.segments.astype(float)
    assert (places.way >= 4.0).all() and (places.way <= 9.0).all()
    assert (places.way >= np.linalg.norm(places.start[:, :2] - places.goal, axis=-1) - 1e-6).all()
    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    for point in np.concatenate([places.start[::97, :2], places.goal[::97]]):
        share = np.clip(((point - start) * way).sum(-1) / (way**2).sum(-1), 0, 1)
        assert np.linalg.norm(start + share[:, None] * way - point, axis=-1).min() > 0.95 - 0.1
    with pytest.raises(ValueError, match="m of clearance"):
        make_map_scene(many_rooms(), Reach(passing=5.0))
    with pytest.raises(ValueError, match="no start and goal 100 to 200 m apart"):
        make_map_scene(many_rooms(), Reach(nearest=100.0, farthest=200.0))


def test_every_wall_within_reach_is_in_the_list_of_its_square():
    made = make_map_scene(many_rooms())
    walls = made.walls
    for x, y in made.places.start[::256, :2]:
        listed = set(walls.near[int(walls.cell(jnp.asarray(x), jnp.asarray(y)))])
        start, way = walls.segments[:, 0], walls.segments[:, 1] - walls.segments[:, 0]
        share = np.clip(((np.array([x, y]) - start) * way).sum(-1) / (way**2).sum(-1), 0, 1)
        near = np.flatnonzero(np.linalg.norm(start + share[:, None] * way - [x, y], axis=-1) < 1.2)
        assert set(near) <= listed


OSM = """<osm version="0.6">{}
<way id="1"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/><tag k="building" v="yes"/></way>
<way id="2"><nd ref="1"/><nd ref="3"/><tag k="highway" v="path"/></way></osm>"""
NODES = "".join(f'<node id="{i + 1}" lat="{48 + y / 111_200:.9f}" lon="{10 + x / 74_630:.9f}"/>'
                for i, (x, y) in enumerate([(0, 0), (20, 0), (20, 10), (0, 10)]))
GML = """<CityModel xmlns:gml="http://www.opengis.net/gml"><gml:Envelope srsName="EPSG:6677" srsDimension="3"/>
<cityObjectMember><Building><lod0FootPrint><gml:Polygon>
<gml:exterior>
<gml:LinearRing><gml:posList>0 0 5 20 0 5 20 20 5 0 20 5 0 0 5</gml:posList></gml:LinearRing></gml:exterior>
<gml:interior>
<gml:LinearRing><gml:posList>5 5 5 15 5 5 15 15 5 5 15 5 5 5 5</gml:posList></gml:LinearRing></gml:interior>
</gml:Polygon></lod0FootPrint></Building></cityObjectMember></CityModel>"""


def test_footprints_have_their_size_in_metres(tmp_path):
    path = tmp_path / "town.osm"
    path.write_text(OSM.format(NODES))
    grid = load_footprints(path)
    assert (grid.cells == OCCUPIED).sum() * 0.01 == pytest.approx(200.0, rel=0.02)
    path = tmp_path / "yard.gml"
    path.write_text(GML)
    grid = load_footprints(path)
    assert (grid.cells == OCCUPIED).sum() * 0.01 == pytest.approx(20.0**2 - 10.0**2, rel=0.02)
    assert grid.origin[:2] == (-20.0, -20.0)  # the middle of the yard and the free ground around it


@pytest.mark.parametrize(("text", "message"), [
    ("", "is no XML"), ("<osm>", "is no XML"), ("<svg/>", "holds <svg>"), ("<osm/>", "has no building"),
    (OSM.format(""), "has no building"), (OSM.format(NODES).replace('lat="48.0', 'lat="x'), "cannot be read"),
    ("<!DOCTYPE a [<!ENTITY b 'c'>]><osm/>", "declares XML entities"),
    (GML.replace("0 0 5 20", "0 0 20"), "points of 3"),
    (GML.replace("Building", "Road"), r"has no building with a footprint \(found Road"),
    (GML.replace("20 20 5", "90000 90000 5"), "over 50000000 cells"),
])  # fmt: skip
def test_a_file_without_footprints_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "town.osm"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load_footprints(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_the_walls_of_a_map_are_stored_once_for_a_batch():
    walls = map_walls(np.array([[[0.0, 0.0], [1.0, 0.0]], [[1.0, 0.0], [1.0, 1.0]]]))
    made = make_map_scene(many_rooms())
    scene, start = jax.jit(jax.vmap(map_scene_sampler(made)))(jax.random.split(jax.random.key(0), 5))
    assert scene.walls is made.walls and start.shape == (5, 3) and scene.marker.position.shape == (5, 3)
    assert walls.near.max() == 1


@pytest.mark.quick
def test_one_other_cell_of_a_map_makes_another_training(tmp_path):
    found = []
    for level in (254, 0):
        (tmp_path / f"{level}.pgm").write_bytes(b"P5 9 9 255\n" + bytes([level] + [254] * 80))
        path = tmp_path / f"{level}.yaml"
        path.write_text(f"image: {level}.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
                        "free_thresh: 0.196\n")
        task = MapGoal(map=str(path))
        found.append(identity_of(find_preset("smoke", task), "dreamer", 0, "chair", None)["task_data"])
        assert found[-1] == task.checksum()
    assert found[0] != found[1] and "task_data" not in identity_of(find_preset("smoke", "corridor"), "ppo", 0, "", None)


def test_a_vehicle_in_a_map_sees_it_and_stops_at_its_walls(tmp_path):
    cells = many_rooms().cells[::-1]
    (tmp_path / "map.pgm").write_bytes(b"P5 400 160 255\n" + np.where(cells == FREE, 254, 0).astype(np.uint8).tobytes())
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\norigin: [-10, -4, 0.4]\nnegate: 0\n"
                                       "occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    env, params = make_env(MapGoal(map=str(tmp_path / "map.yaml"), v_max=1.67))

    @jax.jit
    def drive(key):
        first = reset_state(env, params, key)

        def one_step(state, _):
            state, outcome = step_state(env, params, state, jnp.array([1.0, 0.0]))
            return state, (outcome.metrics["clearance"], outcome.metrics["collision"])

        last, (clear, hit) = jax.lax.scan(one_step, first, None, length=150)
        return first, last, clear, hit, observe(env, first)

    first, last, clear, hit, image = drive(jax.random.key(3))
    assert float(clear[0]) > 0.0 and float(hit.sum()) == 1.0 and float(clear[-1]) == 0.0
    x, y, yaw = reference_pose(env.model, last.vehicle.qpos)
    body = footprint(env.model.spec, x, y, yaw)
    inner = dataclasses.replace(body, half_length=body.half_length - 0.01, half_width=body.half_width - 0.01)
    assert not bool(touches(inner, obstacles_of(last.scene, body.x, body.y)))
    assert np.asarray(image).std() > 5.0


def test_the_command_writes_a_picture_and_the_walls(tmp_path):
    (tmp_path / "town.osm").write_text(OSM.format(NODES))
    command = [sys.executable, "-m", "whill_mjx.maps"]
    done = subprocess.run([*command, "town.osm", "--out", "scene"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "walls: 8 straight ones" in done.stdout, done.stderr
    assert (tmp_path / "scene.png").stat().st_size > 1000
    with np.load(tmp_path / "scene.npz") as arrays:
        assert arrays["walls"].shape == (8, 2, 2) and arrays["start"].shape[1] == 3
    for words, message in ((["no.yaml"], "does not exist"), (["town.txt"], "unknown kind of map")):
        done = subprocess.run([*command, *words], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 2 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_the_command_asks_for_the_room_of_the_vehicle_that_is_named(tmp_path, capsys):
    def clearances(**options):
        maps.main(maps.Import(Path("made:0"), tmp_path / "scene", pixels=100, **options))
        return next(line for line in capsys.readouterr().out.splitlines() if line.startswith("clearance"))

    assert clearances() == "clearance for whill_cr: 0.45 m on the way, 0.95 m at start and goal"
    assert clearances(vehicle="warthog") == "clearance for warthog: 0.86 m on the way, 1.08 m at start and goal"
    assert clearances(vehicle="create", width=0.6) == "clearance for create: 0.3 m on the way, 0.4 m at start and goal"
    with pytest.raises(OptionError, match="unknown vehicle 'nothing'"):
        clearances(vehicle="nothing")


@pytest.mark.parametrize(("name", "option"), [("made:0", "scale"), ("office.yaml", "scale"), ("office.YML", "cell")])
def test_the_command_refuses_an_option_that_has_no_effect_on_the_map(tmp_path, name, option):
    with pytest.raises(OptionError, match=f"--{option}: has no effect on {name}, .*Leave it out"):
        maps.main(maps.Import(Path(name), tmp_path / "scene", **{option: 0.5}))


@pytest.mark.parametrize(("name", "remedy"), [
    ("map_0.yaml", "Check the resolution and the thresholds."), ("made:0", "Take another seed."),
    ("town.osm", r"Take smaller cells \(--cell of python"), ("hall.npy", r"take smaller cells \(--scale and --cell of"),
])  # fmt: skip
def test_a_map_without_room_comes_with_the_remedy_of_its_kind_and_of_the_options(tmp_path, monkeypatch, name, remedy):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "town.osm").write_text(OSM.format(NODES))
    np.save("hall.npy", np.pad(np.argwhere(np.ones((60, 60))) * 0.1, ((0, 0), (0, 1))))
    written_map(tmp_path, (0, 0, 0))
    asked = "Where the map is right, ask for less: --vehicle is warthog, and --width is"
    with pytest.raises(OptionError, match=rf"^{name}: .*needs 50 m. .*{remedy}.* {asked} 100 m"):
        maps.main(maps.Import(Path(name), vehicle="warthog", width=100.0))


def test_a_hall_too_small_for_the_vehicle_names_the_options_and_the_fields_of_the_task(tmp_path):
    np.save(tmp_path / "hall.npy", np.pad(np.argwhere(np.ones((25, 25))) * 0.1, ((0, 0), (0, 1))))
    message = "no start and goal 3 to 12 m apart: .*--scale and --cell .*Where the map is right, {}"
    with pytest.raises(OptionError, match=message.format("ask for less: --vehicle is warthog, and --width is what it")):
        maps.main(maps.Import(tmp_path / "hall.npy", tmp_path / "scene", vehicle="warthog"))
    with pytest.raises(ValueError, match=message.format("lower the task's fields: passing is 0.45 m .* nearest 3 m")):
        check_world(MapGoal(map=tmp_path / "hall.npy"))


def test_a_task_takes_a_map_as_a_path_and_refuses_what_is_no_name(tmp_path):
    task = MapGoal(map=tmp_path / "office.yaml")
    assert task == MapGoal(map=str(tmp_path / "office.yaml")) and hash(task)
    for wrong in (3, None, ["made:0", "made:1"]):
        with pytest.raises(ValueError, match=f"map is {re.escape(str(wrong))}; it must be a path, .*Give a file"):
            MapGoal(map=wrong)


@pytest.mark.parametrize(("metre", "length"), [(110.0, 2.0), (4.0, 50.0), (700.0, 0.2)])
def test_the_legend_of_a_map_has_a_bar_of_its_scale(metre, length):
    strip = picture._legend(1100, metre)
    bar = (strip[picture.LEGEND // 2] == picture.WALL).all(-1)[:250]
    last = int(np.flatnonzero(~bar[12:])[0]) + 11  # where the bar that begins at 10 ends
    assert strip.shape == (picture.LEGEND, 1100, 3) and last - 10 == pytest.approx(length * metre, abs=3)
    for colour in (picture.START, picture.GOAL, picture.WAY):
        assert (strip == colour).all(-1).sum() > 20


def test_floor_plans_of_a_seed_are_rooms_that_hang_together():
    for seed in range(3):
        made = make_map_scene(read_map(f"made:{seed}"))
        free = np.sum(made.grid.cells == FREE)
        assert np.array_equal(made.grid.cells, read_map(f"made:{seed}").cells)
        assert made.space.sum() > 0.99 * free  # every room has a door
        assert len(made.walls.segments) > 40
    assert not np.array_equal(read_map("made:0").cells, read_map("made:1").cells)


def test_maps_side_by_side_keep_their_walls_places_and_ways():
    made = [make_map_scene(read_map(f"made:{seed}"), Reach(farthest=6.0)) for seed in (0, 1)]
    group = side_by_side(made)
    first = len(made[0].walls.segments)
    np.testing.assert_allclose(group.walls.segments[first:] - group.shifts[1], made[1].walls.segments, atol=1e-4)
    gap = group.walls.segments[first:, :, 0].min() - group.walls.segments[:first, :, 0].max()
    assert gap == pytest.approx(GAP, abs=1e-3)
    ways = group.ways(1.5, 10.0)
    listed = ways.near[-1][ways.near[-1] >= 0]
    places = ways.points.reshape(-1, 2)[listed]
    assert len(listed) and np.all(np.hypot(*(places - ways.start[-1]).T) <= 10.0 + 1e-3)
    assert side_by_side(made[:1]).walls is made[0].walls


def test_people_see_each_point_of_their_way_from_the_one_before_and_go_back_at_its_end():
    made = make_map_scene(read_map("made:0"))
    points = draw_ways(made.grid, made.space, made.places.start, 1.5, 10.0).points.astype(float)
    legs = np.diff(points, axis=1)
    length = np.linalg.norm(legs, axis=-1)
    assert length.min() > 0.1 and length.max() < SPACING + 1e-3
    places = (points[:, :-1, None] + np.linspace(0, 1, 9)[:, None] * legs[:, :, None]).reshape(-1, 1, 2)
    start, way = made.walls.segments[:, 0], made.walls.segments[:, 1] - made.walls.segments[:, 0]
    share = np.clip(((places - start) * way).sum(-1) / (way**2).sum(-1), 0, 1)
    assert np.linalg.norm(start + share[..., None] * way - places, axis=-1).min() > 0.04


def written_map(folder, origin, cells=None):
    """Path of a nav2 map of rooms at an origin."""
    cells = many_rooms().cells if cells is None else cells
    (folder / "map.pgm").write_bytes(b"P5 %d %d 255\n" % cells.shape[::-1]
                                     + np.where(cells[::-1] == FREE, 254, 0).astype(np.uint8).tobytes())
    path = folder / f"map_{origin[0]}.yaml"
    path.write_text(f"image: map.pgm\nresolution: 0.05\norigin: {list(origin)}\nnegate: 0\noccupied_thresh: 0.65\n"
                    "free_thresh: 0.196\n")
    return path


def test_a_map_far_from_zero_is_the_same_one_moved_there_by_whole_metres(tmp_path):
    near, far = (read_map(written_map(tmp_path, origin)) for origin in ((-10.3, -4.0, 0.4), (499989.7, 900000.0, 0.4)))
    assert near.shift == (0.0, 0.0) and near.origin == (-10.3, -4.0, 0.4)
    moved = np.add(far.shift, [-500000.0, -900004.0])
    assert np.abs(moved).max() < 20 and np.array_equal(moved, np.rint(moved)) and far.farthest() < 20
    one, other = make_map_scene(near), make_map_scene(far)
    np.testing.assert_allclose(other.walls.segments + moved, one.walls.segments, atol=1e-5)
    np.testing.assert_allclose(other.places.start[:, :2] + moved, one.places.start[:, :2], atol=1e-6)
    np.testing.assert_array_equal(load_map(tmp_path / "map_499989.7.yaml").origin, far.origin)


def test_the_command_says_and_writes_by_how_much_it_moved_a_far_map(tmp_path, capsys):
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(0, [12.0, 9.0], (60_000, 2)), np.zeros(60_000)])
    np.save(tmp_path / "site.npy", floor + [691_600.0, 5_334_700.0, 519.0])  # UTM
    maps.main(maps.Import(tmp_path / "site.npy", tmp_path / "scene", pixels=200))
    with np.load(tmp_path / "scene.npz") as arrays:
        places = arrays["start"][:, :2] + arrays["shift"]
        assert np.abs(arrays["walls"]).max() < 10.0
    assert (places > [691_600.0, 5_334_700.0]).all() and (places < [691_612.0, 5_334_709.0]).all()
    assert "add 691606, 5334704 m to x, y" in capsys.readouterr().out.replace("5334705", "5334704")


def test_a_map_that_reaches_too_far_is_refused_with_the_remedy():
    far = dataclasses.replace(many_rooms(), origin=(0.0, 9000.0, 0.0))
    with pytest.raises(ValueError, match=r"corners lie 9008 m from zero.* 4096 m.*brought_near\(\)"):
        make_map_scene(far)
    assert len(make_map_scene(far.brought_near()).walls.segments) > 40
    with pytest.raises(ValueError, match=r"corners lie 10000 m from zero.*Cut it into smaller ones\.$"):
        make_map_scene(dataclasses.replace(many_rooms(), resolution=50.0, origin=(-1e4, 0.0, 0.0)))


def test_maps_of_other_places_come_side_by_side_and_not_kilometres_apart():
    plan = read_map("made:0")
    made = [make_map_scene(dataclasses.replace(plan, origin=(0.0, y, 0.0)), Reach(farthest=6.0)) for y in (0.0, 900.0)]
    group = side_by_side(made)
    assert np.ptp(group.walls.segments.reshape(-1, 2), 0)[1] == pytest.approx(np.ptp(made[0].walls.segments[..., 1]))
    np.testing.assert_allclose(group.places.start[-1, :2] - group.shifts[1], made[1].places.start[-1, :2], atol=1e-6)
    vast = dataclasses.replace(made[0].walls, segments=40 * made[0].walls.segments)
    with pytest.raises(ValueError, match=r"80 maps side by side reach 4\d\d\d m from zero.*Name fewer maps"):
        side_by_side([dataclasses.replace(made[0], walls=vast)] * 80)


def test_many_maps_lie_in_rows_around_zero_and_none_on_another():
    """A pose has steps of 0.02 mm there; in one row they would be ten times as long, and a slow vehicle would stand."""
    made = make_map_scene(read_map("made:0"), Reach(farthest=6.0))
    group = side_by_side([made] * 60)
    corners = [made.walls.segments.reshape(-1, 2) + shift for shift in group.shifts]
    assert np.abs(group.walls.segments).max() < 256.0
    for number, one in enumerate(corners):
        for other in corners[number + 1 :]:
            assert (np.maximum(one.min(0) - other.max(0), other.min(0) - one.max(0)) > GAP - 1e-3).any()
    starts = made.places.start[None, :, :2] + group.shifts[:, None]
    np.testing.assert_allclose(group.places.start[:, :2], starts.reshape(-1, 2), atol=1e-9)


LONG = dataclasses.replace(WHILL_CR, name="long", body_length=4.2, body_width=1.1)


def test_a_wheelchair_needs_of_a_map_what_it_always_needed():
    assert reach_of(WHILL_CR) == reach_of(WHILL_CR, farthest_move(WHILL_CR, 1.67, 1.68, 0.1)) == Reach()
    assert MapGoal(v_max=1.67).for_vehicle(WHILL_CR).reach == Reach()
    own = MapGoal(passing=0.7, standing=1.3, near=3.0).for_vehicle(WARTHOG)
    assert (own.passing, own.standing, own.near) == (0.7, 1.3, 3.0)


@pytest.mark.parametrize("spec", [WHILL_CR, WARTHOG, LONG], ids=lambda spec: spec.name)
def test_a_vehicle_of_any_size_meets_walls_with_its_nose(spec):
    cells = np.full((300, 400), OCCUPIED, np.uint8)
    cells[20:-20, 20:-20] = FREE
    made = make_map_scene(GridMap(cells, 0.05, (0.0, 0.0, 0.0)), reach_of(spec))  # its last wall is at x = 19 m
    scene, _ = map_scene_sampler(made)(jax.random.key(0))
    middle = 19.0 - spec.body_length / 2 + spec.reference_x  # of the driven axle

    def nose_at(x):
        return footprint(spec, middle + x, 7.6, 0.0)

    for x in (0.02, 0.3):
        assert bool(touches(nose_at(x), obstacles_of(scene, nose_at(x).x, 7.6)))
    for x in (-0.02, -0.3):
        assert not bool(touches(nose_at(x), obstacles_of(scene, nose_at(x).x, 7.6)))
        assert float(free_distance(nose_at(x), scene)) == pytest.approx(-x, abs=1e-3)


@pytest.mark.parametrize("length", [1.52, 3.0])
def test_a_large_vehicle_starts_where_it_can_turn(length):
    spec = dataclasses.replace(WARTHOG, body_length=length)
    task = MapGoal(map="made:0").for_vehicle(spec)

    @jax.jit
    @jax.vmap
    def clear(key):
        world = task.sample_world(key)
        turned = jnp.linspace(-np.pi, np.pi, 9)
        return jax.vmap(lambda yaw: free_distance(footprint(spec, *world.start[:2], yaw), world.scene))(turned)

    assert float(clear(jax.random.split(jax.random.key(1), 256)).min()) > 0.0


def test_a_vehicle_that_fits_nowhere_is_refused_with_the_fields_that_say_so():
    with pytest.raises(ValueError, match=r"map made:1: .*needs 5.17 m.*passing is 5.17 m .*body_width needs.*standing"):
        check_world(MapGoal(map="made:1").for_vehicle(dataclasses.replace(WHILL_CR, body_width=10.0)))
    with pytest.raises(ValueError, match=r"map made:0: .* m of clearance where 9.92 m are needed.*body_length"):
        check_world(MapGoal(map="made:0").for_vehicle(dataclasses.replace(WHILL_CR, body_length=19.0)))


def test_a_task_whose_walls_are_listed_too_near_for_the_vehicle_is_refused():
    @dataclasses.dataclass(frozen=True)
    class Walled(Task):
        near: float = 1.2

        def sample_world(self, key):
            world = super().sample_world(key)
            walls = map_walls(np.array([[[4.0, 3.0], [4.0, -3.0]]]), keep=1, near=self.near)
            boxes = stack_boxes([world.scene.boxes, no_boxes(1)])
            return dataclasses.replace(world, scene=dataclasses.replace(world.scene, boxes=boxes, walls=walls))

    with pytest.raises(ValueError, match=r"'walled'.*within 1.2 m.*'long'.*body_length 4.2 m.*needs 2.31 m.*near="):
        make_env(Walled(), LONG)
    assert make_env(Walled(near=2.4), LONG)[0].model.spec is LONG


def test_a_task_for_a_vehicle_must_be_a_task():
    @dataclasses.dataclass(frozen=True)
    class Own(Task):
        def for_vehicle(self, spec):
            return spec

    with pytest.raises(ValueError, match="task 'own': for_vehicle: returns VehicleSpec; it must be a Task"):
        make_env(Own())
