"""The contact plant driven a command at a time: the same motion as from the whole table."""

import json

import numpy as np
import pytest

from benchmarks.plant.draw import draw_effect
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.make import Experiment, drive_all, plan
from benchmarks.plant.online import OnlinePlant

TABLE = np.array([[0, 0, 0], [0.5, 0.6, 0.4], [1.5, 0.1, -0.5], [2.0, 0.7, 0.0], [3.0, 0, 0]])


def online(setting, table, until):
    plant = OnlinePlant(setting)
    rows, poses, sent = [], [], 0
    while plant.t < until:
        while sent < len(table) and table[sent, 0] <= plant.t + 1e-9:
            plant.command(*table[sent])
            sent += 1
        plant.advance(5)
        for found, new in zip((rows, poses), plant.reports(), strict=True):
            found.extend(new)
    return np.array(rows), np.array(poses)


@pytest.mark.parametrize("effects", [{}, {"command_delay": 0.3}, {"acceleration_limit": 0.8}, {"sensor_delay": 0.1},
                                     {"wind": 20.0}], ids=lambda effects: "".join(effects) or "plain")
def test_a_drive_command_by_command_is_the_drive_of_the_whole_table(effects):
    setting, jobs = plan(Experiment(effects, 3, 0.0, True, {"steps": TABLE}, 1))
    ((_, odometry, pose, *_),) = drive_all(setting, jobs)
    rows, poses = online(setting, TABLE, 3.0)
    count = min(len(rows), len(odometry))
    assert count > 55
    np.testing.assert_allclose(rows[:count], odometry[:count], atol=2e-3)
    np.testing.assert_allclose(poses[:count], pose[:count], atol=1e-6)


def test_a_vehicle_that_is_placed_anew_stands_at_its_start():
    setting, _ = plan(Experiment({}, 1, 1.0, True))
    plant = OnlinePlant(setting)
    plant.command(0.0, 0.8, 0.0)
    plant.advance(500)
    assert np.hypot(*plant.state[:2]) > 0.5
    plant.place(4, (1.0, 2.0, 0.5))
    plant.advance(10)
    assert plant.state == pytest.approx((1.0, 2.0, 0.5, 0.0, 0.0), abs=2e-3) and plant.t == pytest.approx(0.04)


@pytest.mark.quick
def test_draws_are_effects_that_can_be_named_and_neighbouring_numbers_differ():
    drawn = [draw_effect(number) for number in range(10)]
    names = [name for one in drawn for name in one]
    assert len(set(names)) == 10 and all(EFFECTS[name].can_be_named for name in names)
    assert json.dumps(drawn) == json.dumps([draw_effect(number) for number in range(10)])
    assert all(0 < size <= EFFECTS[name].most for one in drawn for name, size in one.items())
