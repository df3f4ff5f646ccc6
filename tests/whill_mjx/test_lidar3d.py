"""Scans of several rings against known answers, and against the level scan of the same scene."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.sensors.base import Reading, _finished
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.lidar3d import Lidar3D
from whill_mjx.vehicle.kinematics import quaternion_from_angles
from whill_mjx.world.lidar import first_hits, sent_from
from whill_mjx.world.lidar3d import first_returns
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.scene import Marker, Scene, box, default_looks, no_boxes, stack_boxes
from whill_mjx.world.solids import Solids, person, post, rod, stack_rounds

pytestmark = pytest.mark.quick
MARKER = Marker(jnp.zeros(3), jnp.zeros(3), jnp.zeros(()), jnp.zeros(3))


def scene_of(boxes=None, rounds=None, walls=None):
    solids = None if rounds is None else Solids(rounds=stack_rounds(rounds))
    return Scene(stack_boxes(boxes or [no_boxes(1)]), MARKER, default_looks(), solids=solids, walls=walls)


def scanned(sensor, scene, qpos, twist=(0.0, 0.0), pose=(0.0, 0.0, 0.0)):
    """Value of a sensor on a vehicle at qpos (7,) that moves with a twist (2,) about its reference point at a pose."""

    def measure(scene, qpos, twist):
        vehicle, moment = SimpleNamespace(qpos=qpos), SimpleNamespace(pose=jnp.asarray(pose), twist=twist, scene=scene)
        view = SimpleNamespace(state=SimpleNamespace(vehicle=vehicle), moment=moment)
        return sensor.measure((), view, jax.random.key(1))[1]

    return jax.jit(measure)(scene, qpos, jnp.asarray(twist))


def towards(points, origin):
    way = jnp.asarray(points, jnp.float32) - origin
    return way / jnp.linalg.norm(way, axis=-1, keepdims=True)


def test_rays_meet_ground_box_ball_and_cylinder_where_geometry_says():
    grey = (0.5, 0.5, 0.5)
    scene = scene_of([box(3.0, 0.0, 1.0, 1.0, 1.0, (0.9, 0.6, 0.3))],
                     [rod((0.0, 3.0, 1.0), (0.0, 3.0, 1.0), 0.5, grey), post(-3.0, 0.0, 1.0, 0.5, grey)])  # fmt: skip
    origin = jnp.array([0.0, 0.0, 2.0])
    hits = [(2.5, 0.0, 0.5), (3.0, 0.0, 1.0), (0.0, -4.0, 0.0), (0.0, 3.0, 1.0), (-3.0, 0.0, 1.0), (9.0, 9.0, 2.0)]
    away = [np.linalg.norm(np.subtract(hit, origin)) for hit in hits]
    found = jax.jit(first_returns)(scene, jnp.broadcast_to(origin, (6, 3)), towards(hits, origin))
    # The face towards the ray, the lid, the ground, the ball's near side, the cylinder's lid, and nothing.
    np.testing.assert_allclose(found.distance, [*away[:3], away[3] - 0.5, away[4], np.inf], atol=1e-4)
    cosines = [2.5 / away[0], 1.0 / away[1], 2.0 / away[2], 1.0, 1.0 / away[4]]
    np.testing.assert_allclose(found.cosine[:5], cosines, atol=1e-3)
    np.testing.assert_allclose(found.albedo[:2], 0.6, atol=1e-5)


def test_a_ray_passes_over_a_wall_of_a_map_and_meets_it_below_its_edge():
    walls = map_walls(np.array([[[2.0, 1.0], [2.0, -1.0]], [[4.0, 1.0], [4.0, -1.0]]]), keep=2, height=2.2)
    scene, origin = scene_of([no_boxes(2)], walls=walls), jnp.array([0.0, 0.0, 1.0])
    way = towards([(2.0, 0.5, 2.1), (2.0, 0.5, 2.3), (1.0, 0.0, 0.0)], origin)
    found = jax.jit(first_returns)(scene, jnp.broadcast_to(origin, (3, 3)), way)
    np.testing.assert_allclose(found.distance, [np.sqrt(4 + 0.25 + 1.21), np.inf, np.sqrt(2.0)], rtol=1e-5)


@pytest.mark.parametrize("period", [0.0, 0.1])
def test_the_level_ring_of_a_moving_scanner_is_the_level_scan(period):
    things = [person(-1.5, 0.4), post(0.3, -2.0, 1.5, 0.1, (1.0, 1.0, 1.0))]
    scene = scene_of([box(2.0, 0.5, 0.5, 3.0, 1.0, (0.5, 0.5, 0.5), 0.3)], things)
    pose, twist = jnp.array([0.1, 0.2, 0.7]), jnp.array([0.8, 1.0])
    sensor = Lidar3D(rings=1, rays=90, lowest=0.0, highest=0.0, z=0.0, period=period, reach=9.0)
    level = quaternion_from_angles(jnp.zeros(()), jnp.zeros(()), pose[2])
    qpos = jnp.concatenate([pose[:2], jnp.array([0.5]), level])
    value = scanned(sensor, scene, qpos, twist, pose)
    assert value.shape == (1, 90, 2)
    angles = 2 * np.pi * ((np.arange(90) + 0.5) / 90 - 0.5)
    x, y, turn = sent_from(pose[:2], pose, twist, 90, period)
    expected = jnp.minimum(jax.jit(first_hits, static_argnums=4)(scene, x, y, pose[2] + turn + angles, 0.5), 9.0)
    np.testing.assert_allclose(value[0, :, 0], expected, atol=1e-4)
    assert np.array_equal(value[0, :, 1] > 0, expected < 9.0)


def test_a_scanner_tilts_with_its_vehicle_and_loses_rays_by_chance():
    pitch = 0.1  # nose down
    qpos = jnp.concatenate([jnp.array([0.0, 0.0, 0.5]), quaternion_from_angles(jnp.zeros(()), pitch, jnp.zeros(()))])
    ahead = scanned(Lidar3D(rings=1, rays=1, lowest=0.0, highest=0.0, z=0.0), scene_of(), qpos)
    assert float(ahead[0, 0, 0]) == pytest.approx(0.5 / np.sin(pitch), rel=1e-3)
    still = Lidar3D(rings=8, rays=500, fov=0.1, lowest=-0.4, highest=-0.2, z=0.0)
    exact = np.asarray(scanned(still, scene_of(), qpos)[..., 0])
    shaken = dataclasses.replace(still, dropouts=0.2, noise=0.02)
    far, strength = np.moveaxis(np.asarray(scanned(shaken, scene_of(), qpos)), -1, 0)
    assert np.mean(strength == 0) == pytest.approx(0.2, abs=0.03)
    assert np.all((far == still.reach) == (strength == 0))
    assert np.std((far - exact)[strength > 0]) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("sensor", [Lidar(noise=0.1), Lidar3D(noise=0.1)])
def test_a_scanner_puts_its_noise_into_a_distance_once(sensor):
    value = jnp.full(5, 3.0)
    assert np.array_equal(_finished(sensor, Reading((5,), 0.0, 10.0), value, jax.random.key(0)), value)
