"""Exploring starts: training episodes that begin anywhere on the way."""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import first_outcome, make_env, reset_state
from whill_mjx.tasks.base import Task, World
from whill_mjx.tasks.map_goal import MapGoal
from whill_mjx.tasks.parts import make_marker
from whill_mjx.tasks.starts import anywhere
from whill_mjx.tasks.tasks import make_task, sample_world
from whill_mjx.vehicle.specs import WHILL_CR
from whill_mjx.world.maps import FREE, OCCUPIED, GridMap, Reach, make_map_scene, map_scene_sampler
from whill_mjx.world.scene import Scene, box, default_looks, stack_boxes


@functools.cache
def begin(task: str, layout: str, share: float, episodes: int = 256) -> dict[str, np.ndarray]:
    """Metrics of the first time step of episodes, without their images."""
    env, params = make_env(task, layout=layout, exploring_starts=share, random_looks=False, photometric=False)
    keys = jax.random.split(jax.random.key(3), episodes)
    first = jax.jit(jax.vmap(lambda key: first_outcome(env, reset_state(env, params, key)).metrics))(keys)
    return {name: np.asarray(values) for name, values in first.items()}


@pytest.mark.parametrize(
    ("task", "layout"), [("obstacle_course", "fixed"), ("obstacle_course", "randomised"), ("corridor", "randomised")]
)
def test_every_episode_begins_clear_of_boxes_and_before_the_goal(task, layout):
    seen = begin(task, layout, 1.0)
    assert seen["clearance"].min() > 0.05
    assert seen["goal_distance"].min() > 1.2  # the radius of arrival is 1 m


def test_a_fixed_course_is_begun_on_both_sides_of_both_gates():
    x = begin("obstacle_course", "fixed", 1.0)["x"]
    before, between, behind = (x < 1.5).mean(), ((x > 2.6) & (x < 3.6)).mean(), (x > 3.6).mean()
    assert min(before, between) > 0.1 and behind > 0.02


def test_the_share_is_that_of_episodes_and_the_rest_begins_at_the_start():
    x, y, yaw = (begin("obstacle_course", "fixed", 0.5)[name] for name in ("x", "y", "yaw"))
    own = (np.abs(x) < 1e-3) & (np.abs(y) < 1e-3) & (np.abs(yaw) < 1e-3)
    assert 0.4 < own.mean() < 0.6  # 256 episodes: three standard errors


def test_worlds_stay_the_same():
    """Layouts are drawn as without: only the vehicle's place differs."""
    keys = jax.random.split(jax.random.key(8), 4)
    worlds = []
    for share in (0.0, 1.0):
        env, params = make_env("obstacle_course", exploring_starts=share)
        worlds.append(jax.jit(jax.vmap(lambda key, env=env, params=params: reset_state(env, params, key).scene))(keys))
    jax.tree.map(np.testing.assert_array_equal, *worlds)


def test_without_a_free_place_an_episode_begins_at_its_own_start(monkeypatch):
    task, key = make_task("obstacle_course"), jax.random.key(2)
    world = sample_world(task, key)
    monkeypatch.setattr("whill_mjx.tasks.starts.CLEAR", 1e6)
    np.testing.assert_array_equal(anywhere(task, WHILL_CR, world, key), world.start)


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_what_is_no_share_is_refused(share):
    with pytest.raises(ValueError, match="exploring_starts"):
        make_env(exploring_starts=share)


def bent_corridor():
    """A map of two corridors, 2.5 m wide and 11 m long, that meet at a right angle."""
    cells = np.full((240, 240), OCCUPIED, np.uint8)
    cells[10:60, 10:230] = cells[10:230, 180:230] = FREE
    return GridMap(cells, 0.05, (0.0, 0.0, 0.0))


def test_no_episode_in_a_map_begins_inside_its_walls_or_beyond_them():
    """The straight line from start to goal cuts the corner, and a place far outside has nothing near it."""
    grid = bent_corridor()
    task, sample = MapGoal(), map_scene_sampler(make_map_scene(grid, Reach(nearest=6.0, farthest=14.0)))

    @jax.jit
    @jax.vmap
    def draw(key):
        scene, own = sample(key)
        return anywhere(task, WHILL_CR, World(scene, own), key), own

    starts, own = (np.asarray(leaf) for leaf in draw(jax.random.split(jax.random.key(5), 400)))
    column, row = (starts[:, :2] / grid.resolution).astype(int).T
    assert (grid.cells[row, column] == FREE).all()
    elsewhere = np.hypot(*(starts - own)[:, :2].T) > 0.1
    assert 0.5 < elsewhere.mean() < 1.0 and (starts[elsewhere, 1] > 3.5).any() and (starts[elsewhere, 0] < 8.5).any()


def test_no_episode_begins_behind_the_walls_of_a_room():
    @dataclasses.dataclass(frozen=True)
    class Narrow(Task):
        walls: ClassVar[int] = 2

        def sample_world(self, key):
            sides = [box(2.0, y, 6.0, 0.05, 1.0, jnp.ones(3)) for y in (-0.525, 0.525)]
            return World(Scene(stack_boxes(sides), make_marker(4.0, 0.0, 0.4, 0.8), default_looks()), jnp.zeros(3))

    world = Narrow().sample_world(None)
    starts = jax.jit(jax.vmap(lambda key: anywhere(Narrow(), WHILL_CR, world, key)))
    seen = np.asarray(starts(jax.random.split(jax.random.key(0), 400)))
    assert np.abs(seen[:, 1]).max() < 0.5 and (seen[:, 0] > 1.0).mean() > 0.3
