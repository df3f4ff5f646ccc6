"""Paths of a fitted vehicle and of all that it may be."""

import numpy as np
import pytest

from whill_mjx.logs.paths import draw_values, read_table, simulate_paths
from whill_mjx.vehicle.vehicle_file import load_vehicle


@pytest.fixture(scope="module")
def vehicle():
    spec, params, _ = load_vehicle("whill_cr_physical")
    return spec, params


@pytest.mark.quick
def test_draws_keep_the_own_values_first_and_fill_each_side_of_their_interval(vehicle):
    _, params = vehicle
    mass = float(params.body.mass)
    names, values = draw_values(params, {"body.mass": (mass - 1.0, mass + 4.0), "no.such": (0, 1)}, 4000)
    assert names == ("body.mass",) and values[0, 0] == pytest.approx(mass)
    inside = np.mean((values > mass - 1.0) & (values < mass + 4.0))
    assert inside == pytest.approx(0.9, abs=0.02)
    assert values.max() - mass > 3 * (mass - values.min())


def test_an_uncertain_vehicle_leaves_the_path_of_the_certain_one(vehicle):
    spec, params = vehicle
    table = np.array([[0.0, 0.5, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    mass = float(params.body.mass)
    names, values = draw_values(params, {"body.mass": (0.7 * mass, 1.3 * mass)}, 3, seed=1)
    paths = simulate_paths(spec, params, names, values, table)
    assert paths.shape == (3, 62, 4)
    ends = paths[:, -1]
    assert ends[0, 1] == pytest.approx(1.0, abs=0.15)  # about 0.5 m/s for 2 s, straight ahead
    assert np.abs(ends[:, 2:]).max() < 0.05  # whatever the heading at the start
    assert len(set(np.round(ends[:, 1], 6))) == 3


@pytest.mark.quick
def test_a_file_that_holds_no_commands_is_refused(tmp_path):
    path = tmp_path / "commands.csv"
    for text in ("t,v\n0,1\n", "t,v,omega\n0,0,0\n", "t,v,omega\n0,0,0\n0,1,0\n", "t,v,omega\n0,x,0\n1,0,0\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match="commands.csv"):
            read_table(path)
