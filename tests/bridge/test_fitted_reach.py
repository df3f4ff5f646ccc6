"""A manoeuvre is checked with the vehicle as its fit knows it, before anything moves."""

import os
from pathlib import Path

import numpy as np
import pytest

from bridge.driving import fitted_reach
from bridge.manoeuvre import main

pytestmark = pytest.mark.quick


@pytest.fixture
def check(tmp_path, monkeypatch, capfd):
    """Check 2 m straight ahead on a floor with a vehicle file; return the exit code and what was said."""
    monkeypatch.setattr(fitted_reach, "SIMULATOR", "fake_paths")
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))
    (tmp_path / "ahead.csv").write_text("t,v,omega\n0,1,0\n2,0,0\n3,0,0\n")

    def run(vehicle, length, width):
        code = main([str(tmp_path / "ahead.csv"), "--space", str(length), str(width), "--check", "--radius", "0.5",
                     "--slew", "1000", "1000", "--vehicle-file", vehicle])
        return code, capfd.readouterr().err

    return run


def test_the_own_path_of_a_surely_known_vehicle_decides(check):
    code, said = check("sure.toml", 3.6, 1.6)
    assert code == 0 and "the fitted vehicle needs 3.5 x 1.5 m" in said


def test_a_manoeuvre_that_one_of_the_possible_vehicles_may_leave_the_floor_with_is_refused_in_numbers(check):
    code, said = check("uncertain.toml", 3.6, 1.6)
    assert code == 2
    assert "the fitted vehicle needs 3.5 x 1.5 m, the widest of 2 vehicles that it may be 4.0 x 2.2 m" in said
    assert "3.6 x 1.6 m are free" in said
    assert check("uncertain.toml", 4.2, 3)[0] == 0


def test_what_the_simulator_refuses_is_said_in_one_line(check):
    code, said = check("refused.toml", 4, 3)
    assert code == 1 and said.splitlines()[-1].endswith("refused.toml: fake: refused.toml: is no vehicle file.")


def test_a_computer_without_the_simulator_is_told_what_to_do(check, monkeypatch):
    monkeypatch.setattr(fitted_reach, "SIMULATOR", "no_such_simulator")
    code, said = check("sure.toml", 4, 3)
    assert code == 1 and "not installed here" in said and "--check" in said


def test_a_path_is_widened_by_the_vehicle_and_by_what_it_drives_on():
    t = np.arange(0, 2.01, 0.05)
    path = np.column_stack([t, t, 0 * t, 0 * t])
    reach = fitted_reach.reach_of_paths([path], 0.5).own
    assert reach.ahead == pytest.approx(2.0 + 0.5 + 0.25) and reach.behind == pytest.approx(0.5 + 0.25 - 0.05)
    assert reach.width == pytest.approx(2 * (0.5 + 0.25)) and reach.speed == pytest.approx(1.0)
