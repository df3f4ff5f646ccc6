"""Laws of the effects on the drive, for the force of the paper's drive and for the torque of the physical one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import DT, motion_at, quick, run, signal, still, yielding

from whill_mjx.effects import make_effect
from whill_mjx.vehicle.specs import HUSKY


def both(effect, force, motion=None):
    """What comes out for a force, and for the torque of that force at the wheel, as a force again."""
    motion = motion or still()
    radius = motion.wheel_radius
    force = np.asarray(force)
    _, pushed = effect.actuation(effect.init(), signal(force=force), motion)
    _, turned = effect.actuation(effect.init(), signal(torque=force * radius), motion)
    np.testing.assert_allclose(turned.torque / radius, pushed.force, rtol=1e-4)
    return np.asarray(pushed.force)


@quick
def test_actuator_lag_reaches_63_percent_after_its_time_constant():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (40, 2)), signal((100.0, -50.0), (10.0, 5.0)))
    lagged = run(make_effect("actuator_lag", time_constant=0.1), drives)
    np.testing.assert_allclose(lagged.force[19] / drives.force[19], 1 - np.exp(-1), atol=0.02)
    np.testing.assert_allclose(lagged.torque[19] / drives.torque[19], 1 - np.exp(-1), atol=0.02)


@quick
def test_two_lags_behind_one_another_are_as_slow_together_and_begin_gently():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (400, 2)), signal((100.0, 100.0), (0.0, 0.0)))
    one, two = (np.asarray(run(make_effect("actuator_lag", time_constant=0.1, cascade=c), drives).force)[:, 0] / 100
                for c in (0.0, 0.5))
    for lagged in (one, two):
        np.testing.assert_allclose((1 - lagged).sum() * DT, 0.1, rtol=0.02)
    assert two[1] < 0.3 * one[1] and np.diff(two).argmax() > 5


@quick
def test_saturation_limits_each_side():
    effect = make_effect("torque_saturation", limit=80.0)
    np.testing.assert_allclose(both(effect, [1000.0, -1000.0]), [80.0, -80.0], rtol=1e-3)
    np.testing.assert_allclose(both(effect, [20.0, -10.0]), [20.0, -10.0], rtol=2e-3)


@quick
def test_traction_limit_is_the_grip_of_the_driven_wheels():
    motion = still()
    load = float(motion.normal_force[:2].sum())
    effect = make_effect("traction_limit", mu=0.3)
    np.testing.assert_allclose(both(effect, [5e3, 5e3]).sum(), 0.3 * load, rtol=1e-3)
    np.testing.assert_allclose(both(effect, [5.0, -5.0]), [5.0, -5.0], rtol=2e-3)


@quick
def test_traction_limit_counts_all_wheels_of_a_skid_drive():
    forces = both(make_effect("traction_limit", mu=0.3), [5e4, 5e4], motion_at(name="husky"))
    np.testing.assert_allclose(forces.sum(), 0.3 * HUSKY.mass * 9.81, rtol=0.02)


@quick
def test_supply_sags_with_time():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2001, 2)), signal((100.0, -50.0), (10.0, 5.0)))
    weak = run(make_effect("supply_sag", per_second=0.01), drives)
    np.testing.assert_array_equal(weak.force[0], drives.force[0])
    np.testing.assert_allclose(weak.force[-1], drives.force[-1] / 1.1, rtol=1e-3)
    np.testing.assert_allclose(weak.torque[-1], drives.torque[-1] / 1.1, rtol=1e-3)


@quick
def test_a_session_drains_the_supply_before_the_drive_begins_and_on():
    drives = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2001, 2)), signal((100.0, -50.0), (10.0, 5.0)))
    weak = run(make_effect("supply_sag", drain=0.001, session=300.0), drives)
    np.testing.assert_allclose(weak.force[0], drives.force[0] / 1.3, rtol=1e-5)
    np.testing.assert_allclose(weak.torque[-1], drives.torque[-1] / 1.31, rtol=1e-3)


@quick
@pytest.mark.parametrize(("v", "gain"), [(1.0, 1 / 1.2), (-1.0, 1.0), (0.0, 1.0)])
def test_supply_sags_with_the_power_drawn_and_not_with_power_fed_back(v, gain):
    """Two sides of 100 N at 1 m/s are 200 W."""
    forces = both(make_effect("supply_sag", per_watt=0.001), [100.0, 100.0], motion_at(v))
    np.testing.assert_allclose(forces, 100.0 * gain, rtol=1e-3)


@quick
def test_a_gain_difference_strengthens_the_left_drive():
    np.testing.assert_allclose(both(make_effect("drive_gain_difference", difference=0.1), [100.0, 100.0]), [105, 95])


@quick
@pytest.mark.parametrize("rotor", [1.0, 0.5])
def test_after_a_reversal_backlash_passes_nothing_and_then_what_the_motor_gathered(rotor):
    """0.05 rad, 0.02 kg m^2 and 4 N m: late by sqrt(4 beta I / T), 32 ms, and nothing of the momentum is lost."""
    torque = jnp.concatenate([jnp.full((40, 2), 4.0), jnp.full((40, 2), -4.0)])
    drives = yielding(jnp.zeros_like(torque), jnp.zeros_like(torque), torque)
    effect = make_effect("backlash", play=0.05, rotor=rotor)
    passed = np.asarray(run(effect, drives).torque)[40:, 0]
    late = np.sqrt(4 * 0.05 * rotor * 0.02 / 4)
    first = np.argmax(np.abs(passed) > 1e-3)
    assert abs(first * DT - late) < 2 * DT
    assert passed[first : first + 2].sum() < -4.0 * late / DT  # the blow
    np.testing.assert_allclose(passed.sum(), -4.0 * 40, rtol=1e-3)
    np.testing.assert_allclose(passed[first + 2 :], -4.0, rtol=1e-3)
