"""Laser scans: known distances, a walk along each ray in small steps, and the scanner's own motion."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.lidar3d import Lidar3D
from whill_mjx.vehicle.kinematics import quaternion_from_angles, rotation_from_quaternion
from whill_mjx.world.lidar import disturbed, first_hits, sent_from
from whill_mjx.world.lidar3d import first_returns
from whill_mjx.world.maps import FREE, OCCUPIED, GridMap, distance_field
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.scene import Footprint, Marker, Scene, box, default_looks, no_boxes, stack_boxes
from whill_mjx.world.solids import Solids, person, post, rod, stack_rounds

pytestmark = pytest.mark.quick
GREY = (0.5, 0.5, 0.5)
MARKER = Marker(jnp.array([50.0, 0.0, 1.0]), jnp.array([0.02, 0.3, 0.3]), jnp.zeros(()), jnp.array(GREY))


def furnished():
    boxes = stack_boxes([box(3.0, 0.5, 0.6, 0.8, 1.0, GREY, 0.5), box(-2.0, -1.0, 1.0, 0.3, 0.2, GREY),
                         box(0.0, 4.0, 8.0, 0.2, 2.0, GREY), box(1.0, -3.0, 1.0, 1.0, 1.0, GREY, mask=False)])
    rounds = stack_rounds([person(1.0, 2.0), post(-1.5, 1.0, 1.0, 0.2, GREY),
                           rod((2.0, -2.0, 0.3), (3.5, -1.0, 0.4), 0.15, GREY),
                           rod((-3.0, -3.0, 0.2), (-2.0, -3.5, 0.6), 0.3, GREY, capsule=False)])
    return Scene(boxes, MARKER, default_looks(), Solids(None, rounds))


def inside(scene, points, height):
    """(...,) bool by the definition of each shape: does it hold the points (..., 2) at this height?"""
    boxes, rounds = scene.boxes, scene.solids.rounds
    held = np.zeros(points.shape[:-1], bool)
    for centre, half, yaw, mask in zip(*(np.asarray(v) for v in (boxes.centre, boxes.half, boxes.yaw, boxes.mask)),
                                       strict=True):
        off = points - centre[:2]
        own = off @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        held |= mask & (abs(own) <= half[:2]).all(-1) & (abs(height - centre[2]) <= half[2])
    spatial = np.concatenate([points, np.full((*points.shape[:-1], 1), height)], -1)
    for centre, axis, half, radius, capsule in zip(
        *(np.asarray(v) for v in (rounds.centre, rounds.axis, rounds.half, rounds.radius, rounds.capsule)), strict=True
    ):
        off = spatial - centre
        along = off @ axis
        foot = np.clip(along, -half, half) if capsule else along
        near = np.linalg.norm(off - foot[..., None] * axis, axis=-1) <= radius
        held |= near & (capsule | (abs(along) <= half))
    return held


@pytest.mark.parametrize("height", [0.15, 0.35, 0.8])
def test_every_ray_ends_where_a_walk_along_it_enters_something(height):
    scene, angle = furnished(), np.linspace(-np.pi, np.pi, 181)[:-1]
    found = np.asarray(jax.jit(lambda scene: first_hits(scene, 0.2, -0.1, jnp.asarray(angle), height))(scene))
    far = np.arange(0.0, 9.0, 0.002)
    points = np.array([0.2, -0.1]) + far[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)[:, None]
    held = inside(scene, points, height)
    walked = np.where(held.any(1), far[held.argmax(1)], np.inf)
    # A ray that only grazes something may slip between two steps of the walk.
    same = (np.abs(found - walked) < 0.003) | (np.isinf(found) & np.isinf(walked))
    assert same.mean() > 0.98 and np.isfinite(found).mean() > 0.3
    assert (found[~same] <= walked[~same] + 0.003).all()


def test_a_ray_that_begins_inside_of_something_is_of_no_length():
    scene = furnished()
    for x, y in ((3.0, 0.5), (1.0, 2.0), (-1.5, 1.0)):
        assert (np.asarray(first_hits(scene, x, y, jnp.linspace(0.0, 6.0, 7), 0.3)) == 0.0).all()


def test_walls_and_the_distance_field_of_one_map_agree():
    cells = np.full((60, 80), OCCUPIED, np.uint8)
    cells[5:55, 5:75] = FREE
    grid = GridMap(cells, 0.05, (0.0, 0.0, 0.0))
    corners = np.array([[0.25, 0.25], [3.75, 0.25], [3.75, 2.75], [0.25, 2.75]])
    walls = map_walls(np.stack([corners, np.roll(corners, -1, 0)], 1), keep=4)
    scene = Scene(no_boxes(4), MARKER, default_looks(), walls=walls)
    bare = Scene(no_boxes(0), MARKER, default_looks())
    angle = jnp.linspace(-3.0, 3.0, 61)
    by_walls = np.asarray(first_hits(scene, 1.5, 1.0, angle, 0.3))
    by_field = np.asarray(first_hits(bare, 1.5, 1.0, angle, 0.3, distance_field(grid)))
    assert np.abs(by_walls - by_field).max() < 0.04  # half a cell, more where a ray runs along a wall
    assert np.isinf(np.asarray(first_hits(scene, 1.5, 1.0, angle, 3.0))).all()  # above the walls
    expected = np.where(abs(np.sin(3.0)) > 0, (1.5 - 0.25) / abs(np.cos(3.0)), 0)
    assert by_walls[0] == pytest.approx(expected, abs=1e-4)


def wall_ahead():
    return Scene(box(5.0, 0.0, 0.2, 40.0, 2.0, GREY), MARKER, default_looks())


@pytest.mark.parametrize(("speed", "yaw_rate"), [(0.0, 0.0), (2.0, 0.0), (0.0, 1.0), (1.5, -0.8)])
def test_a_moving_scanner_measures_each_ray_from_where_it_was(speed, yaw_rate):
    angles, age = np.linspace(-0.5, 0.5, 101), 0.1 * (1.0 - (np.arange(101) + 1) / 101)
    x, y, yaw = sent_from(jnp.zeros(2), jnp.zeros(3), jnp.array([speed, yaw_rate]), 101, 0.1)
    found = np.asarray(first_hits(wall_ahead(), x, y, yaw + jnp.asarray(angles), 0.3))
    turn = -yaw_rate * age
    back = -speed * age * np.cos(turn / 2)
    np.testing.assert_allclose(found, (4.9 - back) / np.cos(turn + angles), rtol=2e-5)
    assert float(x[-1]) == float(yaw[-1]) == 0.0


AXLE = -0.36
"""Where the reference point lies ahead of the chassis origin [m]."""
MOUNTS = {"ahead": (0.5, 0.0), "behind": (-0.7, 0.0), "aside": (0.1, 0.45)}
TWISTS = [(0.0, 1.0), (1.2, 0.0), (1.0, -0.9), (-0.6, 1.5)]
"""Speed ahead [m/s] and yaw rate [rad/s]."""


def driven(twist, period, rays, steps=100):
    """(rays, 3) poses of the reference point when each ray is sent, of a unicycle that drives in small steps."""
    (x, y, yaw), dt, rows = (0.3, -0.2, 0.7), period / (rays * steps), []
    for _ in range(rays):
        for _ in range(steps):
            middle = yaw + twist[1] * dt / 2
            x, y, yaw = x + twist[0] * dt * np.cos(middle), y + twist[0] * dt * np.sin(middle), yaw + twist[1] * dt
        rows.append((x, y, yaw))
    return np.array(rows)


def carried(poses, x, y):
    """(rays, 2) places of a point of the vehicle, which is mounted x ahead of the chassis origin and y to its left."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack([(x - AXLE) * c - y * s, (x - AXLE) * s + y * c], -1)


@pytest.mark.parametrize("twist", TWISTS)
@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
@pytest.mark.parametrize("period", [0.1, 1.0])
def test_a_scanner_that_is_not_at_the_axle_is_carried_by_the_vehicle_that_turns(mount, twist, period):
    poses = driven(twist, period, 40)
    places = carried(poses, *mount)
    found = sent_from(jnp.asarray(places[-1]), jnp.asarray(poses[-1]), jnp.asarray(twist), 40, period)
    np.testing.assert_allclose(np.stack(found[:2], -1), places, atol=2e-6)
    np.testing.assert_allclose(found[2], poses[:, 2] - poses[-1, 2], atol=1e-6)


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
def test_both_scanners_scan_from_the_places_of_a_vehicle_that_is_driven_in_small_steps(mount):
    (x, y), rays, period, pitch = mount, 40, 0.5, 0.1
    flat, solid = Lidar(rays=rays, x=x, y=y, z=0.3, yaw=0.2, period=period), Lidar3D(
        rings=2, rays=rays, x=x, y=y, z=0.3, period=period)  # fmt: skip
    tilted = quaternion_from_angles(jnp.zeros(()), jnp.array(pitch), jnp.zeros(()))
    lean = np.asarray(rotation_from_quaternion(tilted))
    mounted = lean @ np.array([x, y, 0.3]) - lean @ np.array([AXLE, 0.0, 0.0])

    @jax.jit
    def scan(scene, pose, twist):
        body = Footprint(pose[0] - AXLE * jnp.cos(pose[2]), pose[1] - AXLE * jnp.sin(pose[2]), pose[2], 0.5, 0.3, 0.9)
        moment = SimpleNamespace(pose=pose, body=body, scene=scene, twist=twist)
        turned = quaternion_from_angles(jnp.zeros(()), jnp.array(pitch), pose[2])
        origin = jnp.append(pose[:2], 0.5) - rotation_from_quaternion(turned)[:, 0] * AXLE
        vehicle = SimpleNamespace(qpos=jnp.concatenate([origin, turned]))
        view = SimpleNamespace(moment=moment, state=SimpleNamespace(vehicle=vehicle))
        return [sensor.measure((), view, jax.random.key(0))[1] for sensor in (flat, solid)]

    @jax.jit
    def expected(scene, places, angles, origin, way):
        level = first_hits(scene, places[:, 0], places[:, 1], angles, 0.3)
        return level, first_returns(scene, origin.reshape(-1, 3), way.reshape(-1, 3)).distance.reshape(2, rays)

    for twist in TWISTS:
        poses = driven(twist, period, rays)
        places, angles = carried(poses, *mount), poses[:, 2] + flat.angles()
        c, s, zero, one = np.cos(poses[:, 2]), np.sin(poses[:, 2]), np.zeros(rays), np.ones(rays)
        turned = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]])  # (3, 3, rays)
        origin = np.append(poses[:, :2], 0.5 * one[:, None], 1) + np.einsum("ijr,j->ri", turned, mounted)
        way = np.einsum("ijr,jk,nrk->nri", turned, lean, solid.directions())
        origins = np.broadcast_to(origin, way.shape)
        level, tilt = expected(furnished(), *(jnp.asarray(v) for v in (places, angles, origins, way)))
        found = scan(furnished(), jnp.asarray(poses[-1], jnp.float32), jnp.asarray(twist))
        same = np.isclose(found[0], np.minimum(level, flat.reach), atol=1e-4)
        also = np.isclose(found[1][..., 0], np.minimum(tilt, solid.reach), atol=1e-3)
        assert same.all() and also.all()


def test_range_noise_and_dropouts_are_as_stated():
    true = jnp.linspace(1.0, 5.0, 4000)
    measured = np.asarray(disturbed(true, jax.random.key(1), 0.03, 0.1, 0.0, 10.0))
    lost = measured == 10.0
    assert lost.mean() == pytest.approx(0.1, abs=0.02)
    error = (measured - np.asarray(true))[~lost]
    assert error.std() == pytest.approx(0.03, rel=0.1) and abs(error.mean()) < 0.003
    cut = np.asarray(disturbed(true, jax.random.key(1), 0.0, 0.0, 2.0, 4.0))
    assert (cut[(true < 2.0) | (true > 4.0)] == 4.0).all() and (cut[(true > 2.0) & (true < 4.0)] < 4.0).all()


def test_the_sensor_meets_round_things_and_the_walls_of_a_map():
    sensor = Lidar(rays=4, reach=6.0, z=0.3)
    body = Footprint(*(jnp.asarray(v) for v in (0.0, 0.0, -np.pi / 4, 0.5, 0.3, 0.9)))

    def read(scene):
        moment = SimpleNamespace(pose=jnp.zeros(3), body=body, scene=scene, twist=jnp.zeros(2))
        return np.asarray(sensor.measure((), SimpleNamespace(moment=moment), jax.random.key(0))[1])

    corners = np.array([[2.0, -3.0], [2.0, 3.0], [-2.5, 3.0], [-2.5, -3.0]])
    walls = map_walls(np.stack([corners, np.roll(corners, -1, 0)], 1), keep=4)
    scene = Scene(no_boxes(4), MARKER, default_looks(), Solids(None, post(0.0, 1.5, 1.0, 0.2, GREY)), walls=walls)
    np.testing.assert_allclose(read(scene), [2.5, 3.0, 2.0, 1.3], atol=1e-5)
