"""Another floor as one change of several quantities, on drives of a vehicle that is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from sysid.errors.noise import Whitener
from sysid.errors.space import Space
from sysid.logs.floor import BLOCKS, QUANTITIES, FloorChange, Member, in_blocks, last_change, over_days, sums_of
from sysid.logs.records import Command, GyroStream, Log, OdometryStream, Start, Trial
from sysid.missing.days import Leftover, Reference
from sysid.missing.reference import BLOCK
from sysid.verdict import vehicles
from sysid.verdict.preparation import days_of
from sysid.verdict.surroundings import floor_change
from whill_mjx.vehicle.specs import HUSKY

ALPHA = 0.005
SPACE = Space(("a.b",), np.zeros(1), np.ones(1), np.array([0.5]), np.zeros(1, bool))

pytestmark = pytest.mark.quick


def windows(seed, count=80, efficiency=0.6, lag=1.2, gyro=True):
    """Steps of 6 s of a skid-steered vehicle whose wheels follow with lags, and turn it by a share."""
    random = np.random.default_rng(seed)
    t, trials = np.arange(0.0, 6.0, 0.05), []
    for i in range(count):
        v, omega = random.uniform(-2, 2), random.uniform(-2, 2)
        start = random.uniform(-1, 1, 2)
        wheels = [0.95 * one + (begin - 0.95 * one) * np.exp(-t / time) + 0.02 * random.standard_normal(len(t))
                  for one, begin, time in ((v, start[0], 0.5), (omega, start[1], lag))]
        rate = efficiency * (1 + 0.03 * random.standard_normal()) * wheels[1] + 0.02 * random.standard_normal(len(t))
        trials.append(Trial(f"run/{i:03d}", "run", Command(np.zeros(1), np.array([v]), np.array([omega])),
                            OdometryStream(t, None, None, None, *wheels), None, Start(v=start[0], omega=start[1]),
                            gyro=GyroStream.of_rates(t, rate) if gyro else None))
    return tuple(trials)


def reference(days, blocks=True):
    left = tuple(Leftover(trial, day, np.zeros((4, 5)), np.ones((4, 5))) for day, trials in enumerate(days)
                 for trial in trials)
    whitener = Whitener(np.ones(5), np.zeros((1, 5, 5)), np.eye(5))
    return Reference(None, SPACE, np.array([0.5]), np.eye(1), np.zeros((len(days), 1)), whitener, np.ones((4, 5)), left,
                     0.25, True, "", blocks=blocks)


def test_the_quantities_of_a_floor_are_those_that_were_driven():
    found = in_blocks([sums_of(trial) for trial in windows(0)])
    assert found.value[0] == pytest.approx(0.6, abs=4 * found.error[0]) and found.error[0] < 0.01
    assert np.exp(found.value[1:3]) == pytest.approx([1.2, 0.5], rel=0.1)
    assert found.value[3:] == pytest.approx(0.95, abs=0.08)  # 2 s after a command a lag of 1.2 s still shows


def test_the_same_floor_is_seldom_another_one():
    known = reference([windows(100)])
    named = [floor_change(known, windows(seed), ALPHA).named for seed in range(10)]
    assert not any(named)


@pytest.mark.parametrize(("change", "first"), [({"efficiency": 0.52}, "turn efficiency"),
                                               ({"lag": 0.8}, "lag of turning")])
def test_another_floor_is_named_with_what_changed(change, first):
    found = floor_change(reference([windows(1)]), windows(2, **change), ALPHA)
    assert found.named and found.members[0].quantity.name == first
    low, high = found.members[0].interval
    assert low - 0.01 < next(iter(change.values())) < high + 0.01
    assert first in found.said() and found.report()["name"] == "floor"
    assert found.classes[0] == found.members[0].quantity.effects[0]


def test_days_differ_by_more_than_blocks():
    """Where reference days differ as much as the drives in question, the floor is the same."""
    days = [windows(10 + i, 20, efficiency=one) for i, one in enumerate((0.52, 0.56, 0.6, 0.64, 0.68))]
    drives = windows(20, efficiency=0.55)
    assert not floor_change(reference(days, blocks=False), drives, ALPHA).named
    assert floor_change(reference([windows(3)]), drives, ALPHA).named
    assert over_days([[sums_of(one) for one in day] for day in days]).error[0] > 0.05


def test_without_gyro_or_reference_nothing_shows_a_floor():
    assert floor_change(reference([windows(1)]), windows(2, gyro=False), ALPHA) is None
    assert floor_change(reference([windows(1, gyro=False)]), windows(2), ALPHA) is None
    assert in_blocks([sums_of(trial) for trial in windows(0, 2 * BLOCKS - 1)]) is None


def test_speeds_count_as_reached_when_the_command_has_not_changed_for_a_while():
    command = Command(np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 1.0, 1.0, 0.0]), np.zeros(4))
    assert last_change(command, np.array([0.5, 1.5, 2.5, 4.0])).tolist() == [0.0, 1.0, 1.0, 3.0]


def test_blocks_of_one_run_know_that_they_are():
    days = days_of((Log("run", HUSKY, windows(0, 40), ""),))
    assert [day.fields[BLOCK] for day in days] == list(range(1, BLOCKS + 1))


@pytest.mark.parametrize("named", [True, False])
def test_another_floor_moves_what_changed_and_nothing_else(named, monkeypatch):
    fitted = []
    monkeypatch.setattr(vehicles, "_to_poses", lambda result, vehicle, names, _: fitted.append(names) or "moved")
    monkeypatch.setattr(vehicles, "describe", lambda vehicle: ("turn_lag.time_constant", "yaw_scrub.torque"))
    members = tuple(Member(quantity, 1.0, 2.0, (1.5, 2.5), 9.0) for quantity in QUANTITIES[:2])
    result = SimpleNamespace(reference=SimpleNamespace(params="as it was"), floor=FloorChange(members, 0.0, 5, named))
    assert vehicles.on_other_floor(result) == ("moved" if named else "as it was")
    assert fitted == ([["turn_lag.time_constant"]] if named else [])  # it has no turn efficiency
