"""People: how they walk, what they look like, and the vehicle among them."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.world.collision import distances, from_above
from whill_mjx.world.gallery import gallery
from whill_mjx.world.lidar import first_hits
from whill_mjx.world.materials import label_count
from whill_mjx.world.people import body, law
from whill_mjx.world.people.around import near_in
from whill_mjx.world.people.contact import poses_among_people, scene_with_people, walk_around
from whill_mjx.world.people.crowd import TRUNK, Crowd, join, people_on, scripted
from whill_mjx.world.people.places import in_sight
from whill_mjx.world.plane import Vector
from whill_mjx.world.scene import Footprint, Marker, Scene, box, default_looks, no_boxes, stack_boxes
from whill_mjx.world.solids import Solids, rod, stack_rounds

pytestmark = pytest.mark.quick
HALF = 0.4925, 0.277
DT = 0.1
POSES = poses_among_people(1.67, 1.0, DT, *HALF)


def scene_of(boxes):
    marker = Marker(jnp.array([50.0, 0.0, 1.0]), jnp.full(3, 0.1), jnp.zeros(()), jnp.ones(3))
    return Scene(boxes, marker, default_looks())


EMPTY = scene_of(no_boxes(2))
WALLED = scene_of(stack_boxes([
    box(0.0, 4.1, 8.4, 0.2, 2.0, jnp.ones(3)), box(0.0, -4.1, 8.4, 0.2, 2.0, jnp.ones(3)),
    box(4.1, 0.0, 0.2, 8.0, 2.0, jnp.ones(3)), box(-4.1, 0.0, 0.2, 8.0, 2.0, jnp.ones(3)),
    box(1.0, 1.0, 0.6, 0.6, 1.0, jnp.ones(3), 0.4),
]))  # fmt: skip


def chair(x=0.0, y=0.0, yaw=0.0, height=0.9):
    values = [jnp.asarray(value, jnp.float32) for value in (x, y, yaw, *HALF, height)]
    return Footprint(*values)


def walker(*points, speed=1.3, yielding=True):
    route = jnp.asarray([points], jnp.float32)
    one = people_on(jax.random.key(0), Crowd(count=1), route, jnp.zeros(1, jnp.int32), jnp.ones(1, bool))
    way = route[0, 1] - route[0, 0]
    way = way / jnp.linalg.norm(way)
    return dataclasses.replace(
        one, speed=jnp.full(1, speed), velocity=speed * way[None], yields=jnp.full(1, yielding),
        returns=jnp.zeros(1, bool),
    )  # fmt: skip


def stander(x, y=0.0):
    return dataclasses.replace(walker([x, y], [x + 0.1, y], speed=0.0, yielding=False), velocity=jnp.zeros((1, 2)))


STEPS = 160
"""Of every simulation here, so that each kind is compiled once."""


@jax.jit
def walked(people, scene=EMPTY):
    """States of people, one after each step."""
    near = near_in(scene)

    def one_step(people, _):
        people = law.walk(people, near, None, DT)
        return people, people

    return jax.lax.scan(one_step, people, None, length=STEPS)[1]


@partial(jax.jit, static_argnums=2)
def drive(scene, path, dt=DT):
    def one_step(scene, ends):
        before, after = (chair(*pose) for pose in ends)
        scene, collided, share = walk_around(scene, before, after, dt, POSES)
        return scene, (scene, collided, share)

    return jax.lax.scan(one_step, scene, (path[:-1], path[1:]))[1]


def met(scene, path):
    """Scenes, collisions and shares (T,) of a vehicle that drives along poses (T + 1, 3)."""
    path = np.asarray(path)
    path_to_end = jnp.asarray(np.pad(path, ((0, STEPS + 1 - len(path)), (0, 0)), mode="edge"), jnp.float32)
    return jax.tree.map(lambda leaf: leaf[: len(path) - 1], drive(scene, path_to_end))


@jax.jit
def every_gap(rounds, poses):
    def one(rounds, pose):
        return distances(chair(*pose), from_above(rounds)).min()

    return jax.vmap(one)(rounds, poses)


def gaps(scenes, path):
    """(T,) m from the vehicle at each pose to the nearest capsule of a person."""
    count, path = len(path), jnp.asarray(path, jnp.float32)
    rounds, poses = jax.tree.map(
        lambda leaf: jnp.pad(leaf[:count], ((0, STEPS - count), *[(0, 0)] * (leaf.ndim - 1)), mode="edge"),
        (scenes.solids.rounds, path),
    )
    return np.asarray(every_gap(rounds, poses))[:count]


def test_two_who_meet_pass_each_other_and_arrive():
    both = join(walker([0.0, 0.0], [8.0, 0.0]), walker([8.0, 0.05], [0.0, 0.05]))
    steps = walked(both)
    apart = jnp.linalg.norm(steps.position[:, 0] - steps.position[:, 1], axis=-1)
    assert apart.min() > 2 * law.RADIUS - 0.02
    ends = jnp.array([[8.0, 0.0], [0.0, 0.05]])
    assert jnp.linalg.norm(steps.position[-1] - ends, axis=-1).max() < 0.6


def test_who_follows_keeps_the_time_gap():
    narrow = scene_of(stack_boxes([box(10.0, side * 0.4, 60.0, 0.2, 2.0, jnp.ones(3)) for side in (-1.0, 1.0)]))
    slow, fast = walker([2.0, 0.0], [60.0, 0.0], speed=0.6), walker([0.0, 0.0], [60.0, 0.0], speed=1.6)
    pair = dataclasses.replace(join(slow, fast), gap=jnp.full(2, 0.8))
    last = jax.tree.map(lambda leaf: leaf[-1], walked(pair, narrow))
    room = jnp.linalg.norm(last.position[0] - last.position[1]) - 2 * law.RADIUS - law.ASIDE
    assert float(room) == pytest.approx(0.8 * 0.6, abs=0.03)
    assert float(jnp.linalg.norm(last.velocity[1])) == pytest.approx(0.6, abs=0.03)


def test_people_stay_out_of_walls_and_boxes():
    people = in_sight(jax.random.key(1), WALLED, jnp.zeros(3), Crowd(count=8, yielding=1.0))
    assert int(people.there.sum()) >= 6
    steps = walked(people, WALLED)
    near = near_in(WALLED)
    found = jax.jit(jax.vmap(lambda place: near(place)(Vector.of(place))))(steps.position)
    apart = (Vector.of(steps.position[:, None]) - found.point).length
    assert float(jnp.where(found.mask, apart, 9.0).min()) > law.RADIUS - 0.01
    gone = jnp.linalg.norm(jnp.diff(steps.position, axis=0), axis=-1)
    assert float(gone.sum(0)[people.there].min()) > 5.0  # nobody is stuck


def test_people_come_into_a_scene_with_textures_and_lamps():
    scene = gallery()
    for count in (4, 8):
        scene = scene_with_people(scene, join(walker([0.0, 0.0], [1.0, 0.0])), jax.random.key(0))
        assert scene.finish.texture.shape == scene.finish.scale.shape == (label_count(scene),)
        assert scene.solids.rounds.mask.shape[0] - gallery().solids.rounds.mask.shape[0] == count


def test_what_hangs_above_heads_is_walked_under():
    rods = stack_rounds([rod((3.0, -1.0, z), (3.0, 1.0, z), 0.1, (0.5,) * 3) for z in (1.0, 2.4)])
    near = near_in(dataclasses.replace(EMPTY, solids=Solids(None, rods)))
    found = near(jnp.array([[2.0, 0.0]]))(Vector(jnp.array([2.0]), jnp.array([0.0])))
    assert list(np.asarray(found.mask)[-2:, 0]) == [True, False]
    np.testing.assert_allclose(found.point.stacked()[-2, 0], [2.9, 0.0], atol=1e-5)


@pytest.mark.long
def test_people_begin_apart_from_one_another_and_from_the_vehicle():
    draw = jax.jit(jax.vmap(lambda key: in_sight(key, WALLED, jnp.zeros(3), Crowd(count=6, clear=1.5, within=3.0))))
    people = draw(jax.random.split(jax.random.key(0), 50))
    far = jnp.linalg.norm(people.position, axis=-1)
    assert ((far >= 1.5) & (far <= 3.0) | ~people.there).all() and people.there.mean() > 0.7
    apart = jnp.linalg.norm(people.position[:, :, None] - people.position[:, None], axis=-1)
    both = people.there[:, :, None] & people.there[:, None] & ~jnp.eye(6, dtype=bool)
    assert jnp.where(both, apart, 9.0).min() > 0.7


def test_scripted_people_follow_their_way_at_their_speed():
    steps = walked(scripted(jnp.array([[[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]]), 1.0))
    speed = jnp.linalg.norm(steps.velocity[:50, 0], axis=-1)
    np.testing.assert_allclose(speed, 1.0, atol=1e-4)
    assert float(jnp.linalg.norm(steps.position[-1, 0] - jnp.array([4.0, 3.0]))) < 1e-3
    assert float(jnp.linalg.norm(steps.velocity[-1, 0])) < 1e-3


def test_who_yields_walks_around_a_standing_vehicle_without_touching_it():
    scene = scene_with_people(EMPTY, walker([4.0, 0.1], [-4.0, 0.1]), jax.random.key(0))
    path = np.zeros((101, 3))
    scenes, collided, _ = met(scene, path)
    assert not collided.any() and not scenes.people.held.any()
    assert float(scenes.people.position[-1, 0, 0]) < -3.0
    assert gaps(scenes, path[1:]).min() > 0.0


def test_who_walks_into_a_standing_vehicle_is_counted_once_and_is_no_collision():
    scene = scene_with_people(EMPTY, walker([4.0, 0.0], [-4.0, 0.0], yielding=False), jax.random.key(0))
    path = np.zeros((161, 3))
    scenes, collided, share = met(scene, path)
    assert not collided.any() and (share == 1.0).all()
    assert int(scenes.people.bumped.sum()) == 1
    assert gaps(scenes, path[1:]).min() > -1e-3
    assert float(scenes.people.position[-1, 0, 0]) < -3.0  # and then walks around it


def test_who_walked_into_the_side_of_a_standing_vehicle_goes_on():
    people, far = walker([1.6, -2.5], [-2.5, 2.75], speed=1.62, yielding=False), []
    scene = scene_with_people(EMPTY, people, jax.random.key(0))
    for phase in np.linspace(0.0, 2 * np.pi, 12, endpoint=False):  # the foot behind may touch it as well
        stood = dataclasses.replace(scene, people=dataclasses.replace(people, phase=jnp.full(1, phase)))
        scenes, collided, _ = drive(stood, jnp.zeros((STEPS + 1, 3)), DT / 2)
        assert scenes.people.held[-1].all() and not collided.any()
        far.append(float(jnp.linalg.norm(scenes.people.position[-1, 0] - jnp.array([-2.5, 2.75]))))
    assert max(far) < 0.6


@pytest.mark.parametrize("aside", [0.0, 0.3, 0.38])
def test_a_vehicle_that_drives_into_somebody_collides_where_it_touches(aside):
    scene = scene_with_people(EMPTY, stander(1.5, aside), jax.random.key(0))
    path = np.zeros((9, 3))
    path[:, 0] = 0.167 * np.arange(9)
    scenes, collided, share = met(scene, path)
    first = int(np.argmax(collided))
    assert collided.any() and not scenes.people.bumped[: first + 1].any()
    stop = path[first].copy()
    stop[0] += float(share[first]) * 0.167
    at = jax.tree.map(lambda leaf: leaf[first : first + 1], scenes)
    assert -2e-3 < gaps(at, [stop])[0] < 2e-3


def test_nobody_passes_through_the_vehicle_between_two_steps():
    fast = walker([0.9, 0.9], [0.2, -3.0], speed=1.8, yielding=False)
    scene = scene_with_people(EMPTY, fast, jax.random.key(0))
    path = np.array([[0.0, 0.0, 0.0], [0.16, 0.0, 0.0], [0.32, 0.0, 0.0], [0.48, 0.0, 0.0], [0.64, 0.0, 0.0]])
    scenes, collided, share = met(scene, path)
    assert collided.any() or scenes.people.held.any()
    assert gaps(scenes, path[1:])[: int(np.argmax(collided)) or 1].min() > -5e-3


LINE = 0.02
"""Thickness of a wall [m]: less than a step."""
BEFORE_A_WALL = scene_of(stack_boxes([box(0.0, -LINE / 2, 9.0, LINE, 2.0, jnp.ones(3))] * 2))


def test_nobody_is_pushed_through_a_wall():
    person = walker([0.0, 0.27], [0.0, -3.0], speed=1.86)
    border = 0.27 + TRUNK * float(person.height[0])  # of a fast vehicle that comes from behind
    mover = law.Mover(jnp.array([0.0, border + HALF[1]]), jnp.array([1.0, 0.0]), jnp.array(HALF),
                      jnp.array([0.0, -3.4]), jnp.zeros(()))  # fmt: skip
    after = jax.jit(lambda people: law.walk(people, near_in(BEFORE_A_WALL), mover, DT))(person)
    assert float(after.position[0, 1]) > law.RADIUS - 1e-3


@pytest.mark.parametrize("time", [0.1, 0.3])
def test_who_steps_back_stops_at_a_wall(time):
    person = walker([0.0, 0.2], [3.0, 0.2])
    one = jnp.ones(1)
    mover = law.Mover(jnp.array([0.0, 0.68]), jnp.array([1.0, 0.0]), jnp.array(HALF), jnp.zeros(2), jnp.zeros(()))
    step = law.stepped_back(person, near_in(BEFORE_A_WALL), mover, time * one)
    np.testing.assert_allclose(step, [[0.0, law.RADIUS - 0.2]], atol=1e-5)
    along = dataclasses.replace(person, position=jnp.array([[0.8, law.RADIUS - 1e-5]]))  # beside both
    mover = mover._replace(centre=jnp.array([0.0, law.RADIUS - 1e-5]))
    step = law.stepped_back(along, near_in(BEFORE_A_WALL), mover, time * one)
    np.testing.assert_allclose(step, [[time * 1.3, 0.0]], atol=1e-5)


def test_who_yields_keeps_off_a_vehicle_that_turns_in_a_long_period():
    person = walker([0.0, 0.6], [0.0, 0.61])
    mover = law.Mover(jnp.zeros(2), jnp.array([1.0, 0.0]), jnp.array([0.7, 0.3]), jnp.zeros(2), jnp.array(np.pi / 2))
    after = jax.jit(lambda people: law.walk(people, near_in(EMPTY), mover, 1.0))(person)
    x, y = (float(value) for value in jnp.abs(after.position[0]))
    assert np.hypot(max(x - 0.3, 0.0), max(y - 0.7, 0.0)) > TRUNK * float(person.height[0])  # its length is along y


def test_a_vehicle_that_has_crept_into_somebody_collides_when_it_drives_on():
    scene = scene_with_people(EMPTY, stander(0.7), jax.random.key(0))
    creeps, drives = np.full(26, 0.004), np.full(2, 0.05)  # 0.04 m/s counts as standing
    path = np.zeros((29, 3))
    path[1:, 0] = np.cumsum(np.concatenate([creeps, drives]))
    scenes, collided, _ = met(scene, path)
    assert int(scenes.people.bumped.sum()) == 1 and not collided[:26].any()
    assert gaps(scenes, path[1:])[25] < -0.05 and collided[26]


def test_who_would_have_walked_into_the_vehicle_after_it_stopped_has_not():
    ahead, path = stander(0.75), np.array([[0.0, 0.0, 0.0], [0.16, 0.0, 0.0]])
    nobody = dataclasses.replace(ahead, there=jnp.zeros(1, bool))
    beside = dataclasses.replace(walker([0.0, 0.57], [0.0, -3.0], yielding=False), phase=jnp.zeros(1))
    for first, walks_into in ((ahead, False), (nobody, True)):
        scene = scene_with_people(EMPTY, join(first, beside), jax.random.key(0))
        scenes, collided, share = met(scene, path)
        assert bool(collided[0]) != walks_into and bool(scenes.people.held[0, 1]) == walks_into
        assert 0.1 < float(share[0]) < 0.6 or walks_into


def test_a_vehicle_may_leave_somebody_who_touches_it():
    scene = scene_with_people(EMPTY, walker([1.3, 0.0], [-4.0, 0.0], yielding=False), jax.random.key(0))
    path = np.zeros((40, 3))
    path[12:, 0] = -0.12 * np.arange(28)  # backwards, away
    scenes, collided, _ = met(scene, path)
    assert scenes.people.bumped[:12].any() and not collided.any()


def test_feet_are_a_step_apart_and_stay_above_the_ground():
    steps = walked(walker([0.0, 0.0], [50.0, 0.0], speed=1.3))
    steps = jax.tree.map(lambda leaf: leaf[:60], steps)
    start, _ = jax.jit(jax.vmap(body.skeleton))(steps)
    ahead = start[:, 0, 0, 0] - start[:, 0, 1, 0]
    length = float(law.step_length(jnp.array(1.3)))
    assert length == pytest.approx(0.71, abs=0.01)  # Sekiya and Nagasaki: 110 steps a minute at 1.3 m/s
    assert float(jnp.abs(ahead).max()) == pytest.approx(length, rel=0.05)
    assert int((jnp.diff(jnp.sign(ahead)) != 0).sum()) in range(9, 13)  # 7.8 m in steps of 0.71 m
    assert float((start[..., 2] - 0.045 * 1.9).min()) > -0.01


def test_a_scan_meets_a_leg_where_it_is_drawn():
    scene = scene_with_people(EMPTY, walker([2.0, 0.0], [2.0, 5.0]), jax.random.key(0))
    angle = jnp.linspace(-0.4, 0.4, 401)
    scan = jax.jit(lambda height: first_hits(scene, 0.0, 0.0, angle, height))
    found = scan(0.3)
    shapes = from_above(scene.solids.rounds)
    nearest = float(jnp.linalg.norm(shapes.start[:2], axis=-1).min())
    assert 1.6 < float(found.min()) < 2.0 and float(found.min()) < nearest + 0.1
    high = scan(1.1)
    assert float(high.min()) == pytest.approx(2.0 - 0.115 * float(scene.people.height[0]), abs=2e-3)
