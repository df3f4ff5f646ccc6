"""The foreign rooms that transfer is measured in: the truth arrives, and who sees nothing does not."""

import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from benchmarks import sight
from benchmarks.foreign.__main__ import task_of
from benchmarks.foreign.drivers import Sighted, load
from benchmarks.foreign.plan import PLANS
from benchmarks.foreign.room import BODY, VARIANTS, make_room
from benchmarks.foreign.run import drive

ROOMS = pytest.mark.parametrize("variant, task", [(variant, task) for variant in VARIANTS for task in PLANS])


@ROOMS
def test_a_planner_that_knows_the_truth_arrives(variant, task):
    driven = drive(variant, 5001, "planner", task=task)
    assert (driven["end"], driven["task"]) == ("arrived", task)


def test_straight_ahead_runs_into_a_carton_in_the_way():
    seeds = [seed for seed in range(5000, 5040) if abs(make_room("plain", seed).plan.obstacles[0].y) < 0.1]
    ends = [drive("plain", seed, "straight")["end"] for seed in seeds[:3]]
    assert "collided" in ends


def test_straight_ahead_runs_into_the_first_gate_of_every_course():
    for seed in range(5000, 5030):
        plan = make_room("plain", seed, "obstacle_course").plan
        x, y, heading = plan.start
        ahead = y + (plan.obstacles[0].x - x) * np.tan(heading)
        assert any(abs(ahead - gate.y) < gate.half_y + BODY[1] for gate in plan.obstacles[:2]), f"seed {seed}"
    assert drive("plain", 5000, "straight", task="obstacle_course")["end"] == "collided"


def test_the_gaps_of_a_course_are_as_wide_as_in_training_and_nothing_else_lets_the_chair_pass():
    for seed in range(5000, 5030):
        plan = make_room("plain", seed, "obstacle_course").plan
        for first, second in (plan.obstacles[:2], plan.obstacles[2:]):
            left, right = sorted((first, second), key=lambda one: -one.y)
            gap = (left.y - left.half_y) - (right.y + right.half_y)
            outer = [plan.half_width - abs(one.y) - one.half_y for one in (left, right)]
            assert 0.96 <= gap <= 1.1 and max(outer) <= 0.35, f"seed {seed}"


@pytest.mark.parametrize("task", PLANS)
def test_variants_share_the_plan_of_a_seed_and_differ_in_looks(task):
    rooms = [make_room(variant, 5002, task) for variant in VARIANTS]
    assert rooms[0].plan == rooms[1].plan == rooms[2].plan
    assert len({tuple((one.x, one.y) for one in room.obstacles) for room in rooms}) == 1
    np.testing.assert_array_less(rooms[0].model.ngeom, rooms[2].model.ngeom)


def test_what_stands_along_the_walls_of_a_course_leaves_its_gates_and_their_gaps_alone():
    things = 0
    for seed in range(5000, 5030):
        room = make_room("unseen", seed, "obstacle_course")
        for thing in room.things:
            things += 1
            assert all(abs(thing.x - one.x) > thing.half_x + one.half_x for one in room.obstacles), f"seed {seed}"
    assert things > 30


@ROOMS
def test_all_that_is_seen_in_the_way_of_the_chair_can_be_touched(variant, task):
    """What cannot be touched is the floor, hangs at the ceiling or on a wall, or is the goal."""
    for seed in range(5000, 5030):
        room = make_room(variant, seed, task)
        model = room.model
        seen = np.flatnonzero((model.geom_group != 4) & (model.geom_contype == 0) & (model.geom_conaffinity == 0))
        away = np.abs(model.geom_pos[seen, 1]) > room.plan.half_width - 0.1
        above = model.geom_pos[seen, 2] - model.geom_size[seen, 2] > 2.0
        goal = np.abs(model.geom_pos[seen, 0] - room.plan.goal[0]) < 0.1
        floor = model.geom_type[seen] == mujoco.mjtGeom.mjGEOM_PLANE
        leaves = model.geom_type[seen] == mujoco.mjtGeom.mjGEOM_ELLIPSOID  # of a plant, whose pot is solid
        assert np.all(away | above | goal | floor | leaves), f"seed {seed}: {model.geom_pos[seen]}"


@ROOMS
def test_lamps_and_their_lights_hang_at_the_ceiling(variant, task):
    for seed in range(5000, 5030):
        model = make_room(variant, seed, task).model
        placed = model.light_pos[model.light_type != 1]
        glowing = model.geom_pos[model.mat_emission[model.geom_matid] * (model.geom_matid >= 0) > 0.5]
        assert len(placed) == len(glowing) == (0 if variant == "plain" else 3)
        assert np.all(np.concatenate([placed, glowing])[:, 2] > 2.0), f"seed {seed}"


class Driven:
    """A policy that drives ahead at 0.3 m/s, counts its decisions, and is surprised from one of them on."""

    def __init__(self, repeat=1, novelty=(1.0, 2.0), surprise=lambda decisions: 0.0, rate_hz=10.0):
        camera = {"x": 0.532, "y": 0.0, "z": 0.682, "roll": 0.0, "pitch": 0.15, "yaw": 0.0, "fov_y": 1.2}
        self.contract = SimpleNamespace(camera=camera, height=8, action_repeat=repeat, rate_hz=rate_hz, novelty=novelty)
        self.surprise, self.decisions = surprise, 0

    def reset(self):
        self.decisions = 0

    def step(self, image):
        self.decisions += 1
        return np.array([0.3, 0.01 * self.decisions])

    @property
    def novelty(self):
        return self.surprise(self.decisions)


def test_a_decision_is_held_as_long_as_in_training():
    policy = Driven(repeat=3)
    sighted = Sighted(policy, "policy")
    looked, turns = [], []
    for _ in range(7):
        looked.append(sighted.looks)
        turns.append(sighted.command(np.zeros((8, 8, 3), np.uint8))[1])
    assert policy.decisions == 3 and looked == [True, False, False] * 2 + [True]
    assert turns == pytest.approx([0.01] * 3 + [0.02] * 3 + [0.03])


def test_surprise_slows_down_and_then_stops_for_good_by_the_limits_of_the_file():
    image = np.zeros((8, 8, 3), np.uint8)
    swinging = Driven(surprise=lambda decisions: [0.5, 1.0, 0.5, 2.0, 0.0, 0.0][decisions - 1])
    sighted = Sighted(swinging, "with_stop")
    assert [sighted.command(image)[0] for _ in range(6)] == pytest.approx([0.3, 0.09, 0.3, 0.0, 0.0, 0.0])
    assert sighted.stopped and swinging.decisions == 4
    careless = Sighted(Driven(surprise=lambda decisions: 9.0), "policy")
    assert careless.command(image)[0] == pytest.approx(0.3)


def test_a_drive_ends_as_stopped_only_where_the_chair_came_to_a_stand_before_it_touched_anything(monkeypatch):
    seed = next(seed for seed in range(5000, 5040) if abs(make_room("plain", seed).plan.obstacles[0].y) < 0.1)
    black = np.zeros((8, 8, 3), np.uint8)
    monkeypatch.setattr("benchmarks.foreign.camera.Camera.image", lambda self, size: black)
    hit = drive("plain", seed, "policy", Driven())
    assert hit["end"] == "collided"
    early = drive("plain", seed, "with_stop", Driven(surprise=lambda decisions: 3.0 * (decisions > 5)))
    late = drive("plain", seed, "with_stop", Driven(surprise=lambda decisions: 3.0 * (decisions >= hit["steps"] - 1)))
    assert early["end"] == "stopped" and late["end"] == "collided"


@pytest.mark.parametrize("driven, said", [
    (Driven(rate_hz=5.0), "rate_hz is 5; the plant takes 10 commands a second"),
    (Driven(novelty=None), "has no novelty"),
])  # fmt: skip
def test_a_policy_that_the_plant_cannot_drive_is_refused(driven, said, monkeypatch):
    monkeypatch.setattr("bridge.policy.Policy.load", lambda path: driven)
    with pytest.raises(ValueError, match=said):
        load("mine", "with_stop")


def test_rooms_are_those_of_the_task_that_the_policies_have_learned():
    assert task_of({}) == "corridor"
    assert task_of({"one": "obstacle_course", "other": "obstacle_course"}) == "obstacle_course"
    with pytest.raises(
        ValueError, match=r"mine/policy.json: task is 'docking'; there are rooms for corridor, obst.*--task"
    ):
        task_of({"mine": "docking"})
    with pytest.raises(ValueError, match=r"different tasks \(one corridor, other obstacle_course\)"):
        task_of({"one": "corridor", "other": "obstacle_course"})
    with pytest.raises(ValueError, match="unknown task 'docking'"):
        make_room("plain", 5000, "docking")


def test_figures_of_the_course_stand_beside_those_of_the_corridor(tmp_path):
    def end(policy, driver, end, **more):
        return {"policy": policy, "driver": driver, "variant": "plain", "end": end, **more}

    drives = [end("transfer0", "policy", "arrived"), end("transfer0", "policy", "collided", task="corridor"),
              end("transfer0", "policy", "collided", task="obstacle_course"),
              end("planner", "planner", "arrived", task="obstacle_course")]  # fmt: skip
    path = tmp_path / "drives.json"
    path.write_text(json.dumps({"drives": drives}))
    found = {name: one["value"] for name, one in sight.foreign(sight.Options(drives=(path,), device="here")).items()}
    assert found["foreign_plain"] == found["foreign_collided_worst"] == 0.5
    assert found["foreign_obstacle_course_plain_collided"] == 1.0
    assert found["foreign_obstacle_course_planner_plain_arrived"] == 1.0
