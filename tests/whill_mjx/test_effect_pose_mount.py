"""An outside pose that follows another point than the reference point, on known paths."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from effects_in_hand import quick

from whill_mjx.effects import make_effect

pytestmark = quick


def test_without_an_offset_no_bit_of_the_path_changes():
    path = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)))
    np.testing.assert_array_equal(make_effect("pose_mount").outside((), path, 0.01)[1], path)


def test_a_turn_on_the_spot_moves_the_tracked_point_on_a_circle_around_the_reference_point():
    yaw = jnp.linspace(0.0, 6.0, 50)
    seen = np.asarray(make_effect("pose_mount", x=0.3, y=0.4, yaw=0.2).outside(
        (), jnp.stack([0 * yaw + 1.0, 0 * yaw - 2.0, yaw], axis=-1), 0.01)[1])
    np.testing.assert_allclose(np.hypot(seen[:, 0] - 1.0, seen[:, 1] + 2.0), 0.5, atol=1e-6)
    np.testing.assert_allclose(seen[:, 2], yaw + 0.2, atol=1e-6)
    np.testing.assert_allclose(seen[0], [1.3, -1.6, 0.2], atol=1e-6)


def test_the_reference_point_of_a_tracked_start_is_tracked_there():
    mount = make_effect("pose_mount", x=-0.1, y=0.25, yaw=-0.6)
    start = jnp.array([1.0, 2.0, 0.7, 0.3, -0.2])
    back = mount.outside((), mount.reference(start)[None, :3], 0.01)[1][0]
    np.testing.assert_allclose(back, start[:3], atol=1e-6)
    np.testing.assert_array_equal(mount.reference(start)[3:], start[3:])
