"""The foreign corridor that transfer is measured in: the truth arrives, and who sees nothing does not."""

import mujoco
import numpy as np
import pytest

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
