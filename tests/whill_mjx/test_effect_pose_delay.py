"""A late outside pose, on known paths."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from effects_in_hand import quick

from whill_mjx.effects import make_effect

pytestmark = quick
DT = 0.025


def arc(t, speed=1.2, rate=0.8, start=(0.5, -0.3, 0.4)):
    """Poses (R, 3) at times t (R,) on a circle driven at constant speed."""
    x, y, yaw = start
    turned = yaw + rate * t
    return jnp.stack([x + speed / rate * (jnp.sin(turned) - np.sin(yaw)),
                      y - speed / rate * (jnp.cos(turned) - np.cos(yaw)), turned], axis=-1)


def late(path, delay):
    return make_effect("pose_delay", delay=delay).outside((), path, DT)[1]


def test_without_a_delay_no_bit_of_the_path_changes():
    path = arc(jnp.arange(60) * DT)
    np.testing.assert_array_equal(late(path, 0.0), path)


@pytest.mark.parametrize("delay", [0.01, 0.1, 0.63])
def test_steady_motion_looks_the_same_however_late_it_is_seen(delay):
    """The first pose is as late as all others, and before it the vehicle went on as in its first instant."""
    path = arc(jnp.arange(60) * DT)
    np.testing.assert_allclose(late(path, delay), path, atol=2e-4)


def test_a_start_from_rest_is_seen_later_by_the_delay():
    t = jnp.arange(120) * DT
    path = jnp.stack([0.5 * t**2, 0 * t, 0 * t], axis=-1)
    seen = late(path, 0.4)
    np.testing.assert_allclose(seen[20:, 0], 0.5 * (t[20:] - 0.4) ** 2, atol=0.01)
    np.testing.assert_allclose(seen[:16, 0], 0.0, atol=0.01)


def test_a_turn_that_began_before_the_drive_is_seen_from_the_late_first_pose():
    """Turning on the spot, then straight on: the late frame is turned by what was turned within the delay."""
    delay, rate = 0.5, 1.0
    t = jnp.arange(120) * DT
    turning = jnp.minimum(t, DT)  # the vehicle goes straight from the first record on
    path = jnp.stack([t - turning, 0 * t, rate * turning], axis=-1)
    seen = np.asarray(late(path, delay))
    moved = seen[-1, :2] - seen[40, :2]
    np.testing.assert_allclose(np.arctan2(moved[1], moved[0]), rate * delay, atol=1e-3)
    np.testing.assert_allclose(seen[0], path[0], atol=1e-6)


def test_the_derivative_by_the_delay_agrees_with_differences():
    with jax.enable_x64(True):
        t = jnp.arange(80) * DT
        path = jnp.stack([jnp.sin(t), 0.3 * t**2, 0.5 * jnp.cos(2 * t)], axis=-1)

        def one(delay):
            return make_effect("pose_delay").replace(delay=delay).outside((), path, DT)[1]

        forward = jax.jacfwd(one)(0.337)
        np.testing.assert_allclose(forward, (one(0.337 + 1e-6) - one(0.337 - 1e-6)) / 2e-6, atol=1e-5)
        assert np.isfinite(jax.jacfwd(one)(0.0)).all()
