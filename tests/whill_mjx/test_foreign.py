"""The foreign corridor that transfer is measured in: the truth arrives, and who sees nothing does not."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from benchmarks.foreign.drivers import Sighted, load
from benchmarks.foreign.room import GOAL, VARIANTS, WIDTH, make_room
from benchmarks.foreign.run import drive


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_planner_that_knows_the_truth_arrives(variant):
    assert drive(variant, 5001, "planner")["end"] == "arrived"


def test_straight_ahead_runs_into_a_carton_in_the_way():
    seeds = [seed for seed in range(5000, 5040) if abs(make_room("plain", seed).carton[1]) < 0.1]
    ends = [drive("plain", seed, "straight")["end"] for seed in seeds[:3]]
    assert "collided" in ends


def test_variants_share_the_plan_of_a_seed_and_differ_in_looks():
    rooms = [make_room(variant, 5002) for variant in VARIANTS]
    assert len({room.start for room in rooms}) == 1
    assert len({room.carton[:2] for room in rooms}) == 1
    np.testing.assert_array_less(rooms[0].model.ngeom, rooms[2].model.ngeom)


@pytest.mark.parametrize("variant", VARIANTS)
def test_all_that_is_seen_in_the_way_of_the_chair_can_be_touched(variant):
    """What cannot be touched is the floor, hangs at the ceiling or on a wall, or is the goal."""
    for seed in range(5000, 5030):
        model = make_room(variant, seed).model
        seen = np.flatnonzero((model.geom_group != 4) & (model.geom_contype == 0) & (model.geom_conaffinity == 0))
        away = np.abs(model.geom_pos[seen, 1]) > WIDTH / 2 - 0.1
        above = model.geom_pos[seen, 2] - model.geom_size[seen, 2] > 2.0
        goal = np.abs(model.geom_pos[seen, 0] - GOAL[0]) < 0.1
        floor = model.geom_type[seen] == mujoco.mjtGeom.mjGEOM_PLANE
        leaves = model.geom_type[seen] == mujoco.mjtGeom.mjGEOM_ELLIPSOID  # of a plant, whose pot is solid
        assert np.all(away | above | goal | floor | leaves), f"seed {seed}: {model.geom_pos[seen]}"


@pytest.mark.parametrize("variant", VARIANTS)
def test_lamps_and_their_lights_hang_at_the_ceiling(variant):
    for seed in range(5000, 5030):
        model = make_room(variant, seed).model
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
    seed = next(seed for seed in range(5000, 5040) if abs(make_room("plain", seed).carton[1]) < 0.1)
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
