"""The foreign corridor that transfer is measured in: the truth arrives, and who sees nothing does not."""

import numpy as np
import pytest

from benchmarks.foreign.room import VARIANTS, make_room
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
