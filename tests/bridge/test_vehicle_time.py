"""The time that passes for a vehicle in simulation: it stands while /clock stands."""

import pytest

from bridge.driving.vehicle_time import VehicleTime


def driven(intervals):
    """A vehicle's time after messages on /clock at these intervals, and the steady clock as a list."""
    steady = [0.0]
    vehicle = VehicleTime(lambda: steady[0])
    for interval in intervals:
        steady[0] += interval
        vehicle.on_clock()
    return vehicle, steady


@pytest.mark.quick
def test_it_runs_like_the_steady_clock_while_the_simulation_runs_and_never_faster():
    vehicle, steady = driven([0.01] * 100)
    before = vehicle()
    for _ in range(100):
        steady[0] += 0.01
        vehicle.on_clock()
    assert vehicle() - before == pytest.approx(1.0) and vehicle() <= steady[0]


@pytest.mark.quick
@pytest.mark.parametrize("interval", [0.005, 0.05, 0.1])
def test_a_simulation_that_stands_for_long_costs_two_of_its_intervals(interval):
    vehicle, steady = driven([interval] * 20)
    before = vehicle()
    steady[0] += 60.0
    stood = 2 * min(interval, VehicleTime.LONGEST)
    assert vehicle() - before == pytest.approx(stood)
    vehicle.on_clock()
    steady[0] += interval
    vehicle.on_clock()
    assert vehicle() - before == pytest.approx(stood + interval)  # one stall changes no usual interval


@pytest.mark.quick
def test_it_stands_until_the_simulation_has_begun():
    vehicle, steady = driven([])
    steady[0] += 10.0
    assert vehicle() == 0.0
