"""Velocity commands as the deflection of a Model CR's joystick."""

import math

import numpy as np
import pytest

from bridge.chair_joy import ZEROS, Deflection, Expiry

pytestmark = pytest.mark.quick

FULL = Deflection(0.567, 0.557, 0.8)


def driver(axes):
    """Percent forward and to the right as the maker's driver makes them of axes (float32), cut towards zero."""
    left, forward = (float(np.float32(axis)) for axis in axes)
    return tuple(max(-100, min(100, int(np.float32(one) * np.float32(100)))) for one in (forward, -left))


@pytest.mark.parametrize("percent", range(-100, 101, 7))
def test_each_percent_of_deflection_can_be_reached_and_nothing_is_lost_by_the_driver(percent):
    v = percent / 100 * (FULL.forward if percent >= 0 else FULL.backward)
    assert driver(FULL.axes(v, 0.0)) == (percent, 0)
    assert driver(FULL.axes(0.0, percent / 100 * FULL.turn)) == (0, -percent)  # omega counts to the left


def test_commands_beyond_full_deflection_are_full_deflection_and_not_finite_ones_are_zero():
    assert FULL.axes(9.0, -9.0) == (-1.0, 1.0) and FULL.axes(-9.0, 9.0) == (1.0, -1.0)
    for bad in (math.nan, math.inf):
        assert FULL.axes(bad, 0.1) == (0.0, 0.0) and FULL.axes(0.1, bad) == (0.0, 0.0)


def test_a_command_that_is_not_renewed_ends_with_zeros_and_silence():
    expiry = Expiry()
    assert not any(expiry.zero_is_due(t) for t in (0.0, 5.0))  # the rider's, as long as nobody commands
    expiry.command(10.0)
    assert not expiry.zero_is_due(10.19)
    assert [expiry.zero_is_due(10.21 + 0.05 * i) for i in range(ZEROS + 3)] == [True] * ZEROS + [False] * 3
