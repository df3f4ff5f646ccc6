"""Tasks with people: what sensors see of them, following one, and recordings for the Rerun viewer."""

from __future__ import annotations

import dataclasses
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from whill_mjx.env import make_env, observe, reset_state, sense, step_state
from whill_mjx.evaluation.output.rerun_log import RerunLog, _capsules, load_rerun
from whill_mjx.gym import WhillEnv
from whill_mjx.gym.kinds import info_names
from whill_mjx.io.command_line import OptionError
from whill_mjx.learning.setup import to_transition
from whill_mjx.look import Look, main
from whill_mjx.sensors.camera import Camera
from whill_mjx.sensors.depth import Depth
from whill_mjx.sensors.goal import Goal
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.tasks import terms
from whill_mjx.tasks.corridor import Corridor
from whill_mjx.tasks.follow import Follow
from whill_mjx.tasks.terms import to_body
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.types import TimeStep
from whill_mjx.world.maps.walls import map_walls
from whill_mjx.world.people.contact import scene_with_people
from whill_mjx.world.people.crowd import TRUNK, scripted
from whill_mjx.world.scene import no_boxes, stack_boxes
from whill_mjx.world.solids import rod, stack_rounds

quick, long = pytest.mark.quick, pytest.mark.long


@pytest.fixture(scope="module")
def following():
    """Environment, first state, and function of (state, action) to the next state, observations and metrics."""
    sensors = {"camera": Camera(), "depth": Depth(), "goal": Goal(), "lidar": Lidar(rays=180, reach=6.0, z=0.9)}
    env, params = make_env(Follow(layout="fixed", slowest=0.7, people=2, yielding=1.0), observations=sensors)

    @jax.jit
    def begin(key):
        return sense(env, params, reset_state(env, params, key))

    @jax.jit
    def step(state, action):
        state, outcome = step_state(env, params, state, action)
        state, obs = sense(env, params, state)
        return state, obs, outcome.metrics

    return env, params, *begin(jax.random.key(0)), step


@long
def test_camera_depth_and_scan_see_the_same_person(following):
    env, _, state, obs, _ = following
    ahead, left = (float(value) for value in obs["goal"])
    bearing = np.arctan2(left, ahead)
    ray = int(np.argmin(np.abs(np.asarray(Lidar(rays=180).angles()) - bearing)))
    scanned = float(obs["lidar"][ray])
    column = int(np.clip(32 - 32 * np.tan(bearing) / np.tan(env.model.spec.camera.fov_y / 2), 0, 63))
    depth = np.asarray(obs["depth"])[:, column - 1 : column + 2]
    # Scanner and camera do not stand at the driven axle, from which the goal is measured.
    assert scanned < np.hypot(ahead, left) < 2.0
    assert abs(depth.min() - scanned) < 0.6
    person_there = np.asarray(obs["camera"]).astype(int)
    people = state.scene.people
    alone = dataclasses.replace(state.scene, solids=jax.tree.map(
        lambda leaf: jnp.zeros_like(leaf) if leaf.dtype == bool else leaf, state.scene.solids))  # fmt: skip
    without = np.asarray(observe(env, dataclasses.replace(state, scene=alone))).astype(int)
    changed = np.abs(person_there - without).sum(-1) > 0
    assert changed[:, column - 1 : column + 2].any() and changed.mean() > 0.02
    assert int(people.there.sum()) >= 1


@long
def test_a_vehicle_that_keeps_its_distance_follows_to_the_end(following):
    env, _, state, obs, step = following
    task, metrics, lowest = env.task, {}, 9.0
    for _ in range(task.max_steps):
        ahead, left = obs["goal"]
        far = float(jnp.hypot(ahead, left))
        lowest = min(lowest, far)
        v = np.clip(1.5 * (far - task.keep), task.v_min, task.v_max)
        omega = np.clip(2.0 * np.arctan2(left, ahead), -task.omega_max, task.omega_max)
        action = [2.0 * (v - task.v_min) / (task.v_max - task.v_min) - 1.0, omega / task.omega_max]
        state, obs, metrics = step(state, jnp.asarray(action, jnp.float32))
        if bool(state.done):
            break
    assert float(metrics["success"]) == 1.0 and lowest > 0.6


@long
def test_a_vehicle_that_stands_loses_the_person(following):
    env, _, state, _, step = following
    stand = jnp.array([2.0 * (0.0 - env.task.v_min) / (env.task.v_max - env.task.v_min) - 1.0, 0.0])
    metrics = {}
    for _ in range(env.task.max_steps):
        state, _, metrics = step(state, stand)
        if bool(state.done):
            break
    assert float(metrics["lost"]) == 1.0 and float(metrics["collision"]) == 0.0


@quick
def test_without_people_a_scene_and_its_program_have_none():
    env, params = make_env(Corridor())
    state = jax.eval_shape(lambda key: reset_state(env, params, key), jax.random.key(0))
    assert state.scene.people is None and state.scene.solids is None
    _, outcome = jax.eval_shape(lambda state: step_state(env, params, state, jnp.zeros(2)), state)
    assert "bumped" not in outcome.metrics


@dataclasses.dataclass(frozen=True)
class Crossing(Corridor):
    """Somebody comes from ahead and somebody from behind, a little later; it ends when both stand at the vehicle."""

    action_repeat: int = 8

    def sample_world(self, key):
        world = super().sample_world(key)
        people = scripted([[[2.5, 0.2], [-1.0, 0.2]], [[-2.1, -0.2], [3.0, -0.2]]], 1.3)
        return dataclasses.replace(world, scene=scene_with_people(world.scene, people, key))

    def endings(self, moment):
        return {"met": moment.scene.people.held.all()}


@quick
def test_each_person_who_walks_into_the_vehicle_is_counted_once_in_whichever_period_of_a_step():
    task = Crossing(layout="fixed")
    env = WhillEnv(task, height=8, width=8)
    still = np.array([2.0 * (0.0 - task.v_min) / (task.v_max - task.v_min) - 1.0, 0.0], np.float32)
    counts, ended = [env.reset(seed=0)[1]["bumped"]], False
    while not ended and len(counts) < 12:
        _, _, ended, _, info = env.step(still)
        counts.append(info["bumped"])
    assert info["met"] is True and counts == [0.0, 0.0, 2.0]  # in two periods of the second step
    assert env.step(still)[4]["bumped"] == 0.0  # nothing happens after the end


@quick
def test_counts_are_numbers_of_an_info_and_learners_read_the_count_of_the_episode():
    metrics = {name: jnp.zeros(3) for name in ("x", "success", "bumped", "met")}
    numbers, flags = info_names(metrics)
    assert "bumped" in numbers and flags == ["success", "met"]
    assert "bumped" not in info_names({"success": 0.0})[0]
    people = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), scripted([[[0.0, 0.0], [1.0, 0.0]]] * 2, 1.0))
    people = dataclasses.replace(people, held=jnp.array([[False, False], [True, False], [True, True]]))
    flag = jnp.zeros(3, bool)
    frame = TimeStep(jnp.zeros(3), jnp.zeros(3), flag, flag, flag, metrics)
    np.testing.assert_array_equal(to_transition(frame, people).metrics["bumped"], [0.0, 1.0, 2.0])
    assert "x" not in to_transition(frame, None).metrics


@long
def test_any_task_takes_people_and_they_share_its_room():
    env, params = make_env(Corridor(people=3))
    state = jax.jit(lambda key: reset_state(env, params, key))(jax.random.key(1))
    walls, people = state.scene.boxes, state.scene.people
    assert people.there.any()
    inside = jnp.abs(people.position[:, 1]) < walls.centre[0, 1] - walls.half[0, 1]
    assert (inside | ~people.there).all()
    assert state.scene.solids.rounds.mask.shape == (12,)


@quick
@pytest.mark.parametrize("field, value, message", [("people", 500, "people"), ("yielding", 1.5, "yielding")])
def test_a_wrong_number_of_people_is_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        Corridor(**{field: value})


@long
def test_a_recording_has_chair_camera_scan_people_way_and_rewards(following, tmp_path):
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed (pip install 'whill-mjx[viewer]')")
    env, params, state, _, step = following
    with RerunLog(env, tmp_path / "drive.rrd") as log:
        log.begin(state)
        for _ in range(3):
            state, _, metrics = step(state, jnp.array([0.0, 0.2]))
            log.moment(state, {"total": 0.1, "distance": 0.1})
    data = (tmp_path / "drive.rrd").read_bytes()
    assert data[:4] == b"RRF2" and len(data) > 10_000 and rerun.__version__
    for name in ("chair", "camera", "scan", "people", "way", "reward"):
        assert name.encode() in data


@quick
def test_a_rod_of_any_direction_stands_in_a_recording_where_it_is_hit():
    ends = np.array([[[0, 0, 2], [0, 0, 0]], [[1, 0, 0.3], [2, 1, 0.3]], [[0, 1, 1], [0.5, 2, 0]]], np.float32)
    shown = _capsules(SimpleNamespace(Capsules3D=lambda **fields: fields),
                      stack_rounds([rod(*one, 0.1, (0.5, 0.5, 0.5)) for one in ends]))  # fmt: skip
    x, y, _, w = shown["quaternions"].T
    along = np.stack([2 * w * y, -2 * w * x, w**2 - x**2 - y**2], 1)  # of z, turned
    found = np.stack([shown["translations"], shown["translations"] + shown["lengths"][:, None] * along], 1)
    swapped = np.abs(found[:, 0] - ends[:, 0]).max(-1, keepdims=True)[..., None] > 1e-3
    np.testing.assert_allclose(np.where(swapped, found[:, ::-1], found), ends, atol=1e-5)


@quick
def test_a_viewer_that_is_not_installed_is_named_with_the_remedy(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"pip install 'whill-mjx\[viewer\]'"):
        load_rerun()
    with pytest.raises(OptionError, match="viewer"):
        main(Look(scene="corridor", out=tmp_path / "drive.rrd"))


@quick
def test_a_recording_of_no_single_task_is_refused(tmp_path):
    with pytest.raises(OptionError, match="one task"):
        main(Look(scene="all", out=tmp_path / "drive.rrd"))


@long
def test_the_person_to_follow_is_the_goal(following):
    env, _, state, obs, _ = following
    pose = jnp.stack(reference_pose(env.model, state.vehicle.qpos))
    np.testing.assert_allclose(obs["goal"], to_body(pose, state.scene.people.position[0]), atol=1e-5)
    assert float(state.goal_distance) == pytest.approx(float(jnp.hypot(*obs["goal"])), abs=1e-4)


@long
def test_rich_looks_show_the_walls_of_a_map_and_take_people():
    segments = np.array([[[1.5, 0.5], [1.5, -0.5]], [[1.5, -0.5], [1.5, 0.5]]], np.float32)

    @dataclasses.dataclass(frozen=True)
    class Walled(Corridor):
        def sample_world(self, key):
            world = super().sample_world(key)
            boxes = stack_boxes([world.scene.boxes, no_boxes(8)])
            return dataclasses.replace(
                world, scene=dataclasses.replace(world.scene, boxes=boxes, walls=map_walls(segments, 8))
            )

    env, params = make_env(Walled(people=2), looks="rich")

    @jax.jit
    def draw(key):
        state = reset_state(env, params, key)
        bare = dataclasses.replace(state, scene=dataclasses.replace(state.scene, walls=None))
        return observe(env, state), observe(env, bare)

    seen, bare = (np.asarray(image).astype(int) for image in draw(jax.random.key(2)))
    assert (np.abs(seen - bare).sum(-1) > 10).mean() > 0.1


@quick
@pytest.mark.parametrize(
    ("place", "walks", "speed", "turns", "haste"),
    [
        ((2.0, 0.0), (0.0, 0.0), 0.8, 0.0, 0.0),  # far enough to stop
        ((1.0, 0.0), (0.0, 0.0), 0.8, 0.0, 0.8 - (1.0 - 0.5 - 0.2)),
        ((2.0, 0.0), (-1.3, 0.0), 0.8, 0.0, 0.8 - (2.0 - 0.5 - 0.2 - 1.3)),  # who comes leaves less
        ((2.0, 0.0), (-1.3, 0.0), 0.0, 0.0, 0.0),  # who stands is in no haste
        ((0.0, 0.6), (0.0, 0.0), 0.8, 0.0, 0.0),  # nor who drives past
        ((0.4, 0.6), (0.0, -1.0), 0.0, 1.0, 0.7),  # the front swings towards who comes from the side
    ],
)
def test_haste_is_what_the_vehicle_nears_a_person_too_fast(place, walks, speed, turns, haste):
    people = dataclasses.replace(scripted(jnp.array([[place, (0.0, 9.0)]]), 0.0), velocity=jnp.array([walks]))
    people = dataclasses.replace(people, height=jnp.full(1, 0.2 / TRUNK))
    body = SimpleNamespace(x=0.0, y=0.0, yaw=0.0, half_length=0.5, half_width=0.3)
    moment = SimpleNamespace(scene=SimpleNamespace(people=people), body=body, pose=jnp.array([-0.3, 0.0, 0.0]),
                             twist=jnp.array([speed, turns]), diverged=jnp.array(False))  # fmt: skip
    assert float(terms.haste(moment, 1.0)) == pytest.approx(haste, abs=1e-5)
    nobody = dataclasses.replace(people, there=jnp.zeros(1, bool))
    assert float(terms.haste(SimpleNamespace(**{**vars(moment), "scene": SimpleNamespace(people=nobody)}), 1.0)) == 0.0
