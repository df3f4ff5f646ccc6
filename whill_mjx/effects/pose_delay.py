"""Latency of the outside pose."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import SAME_ALL_DRIVE, SHOWS_AT_BOTH_ENDS, Axis, Card, Variant
from whill_mjx.vehicle.types import parameter


@struct.dataclass
class PoseDelay(Effect):
    """y(t) = x(t - tau) of the outside pose: its time stamps are those of receipt, not of measurement.

    It acts in replays of logs only. The first pose of a drive is as late as all others, so the path is aligned to it.
    Before the first instant the vehicle is assumed to have moved as in it.
    """

    name = "pose_delay"
    typical = {"delay": (0.05, 0.6)}
    source = "lidar poses of the published DRIVE logs lag their own gyro by 0.2 to 0.6 s"
    card = Card(
        order=280,
        variants=(Variant((Axis("delay", 0.05, limit=20.0),)),),
        forbids=(SHOWS_AT_BOTH_ENDS, SAME_ALL_DRIVE),
        shown_by_pose=True,
    )
    delay: jax.Array = parameter("s", 0.0, 1.5, 0.0, "age of an outside pose at its time stamp")

    def outside(self, memory: tuple[()], path: jax.Array, dt: float) -> tuple[tuple[()], jax.Array]:
        """Late poses (R, 3) for true ones every `dt` [s], yaw unwrapped."""
        place = jnp.arange(path.shape[0]) - self.delay / dt
        before = jnp.clip(jnp.floor(place).astype(int), 0, path.shape[0] - 1)
        after = jnp.minimum(before + 1, path.shape[0] - 1)
        share = jnp.maximum(place - before, 0.0)[:, None]
        late = path[before] + share * (path[after] - path[before])
        late = _gone_back(late, path, dt * jnp.minimum(place, 0.0), dt)
        # Seen from the start: what is added is exactly 0 without a delay.
        start, first = path[0], late[0]
        turn = start[2] - first[2]
        cos, sin = jnp.cos(turn) - 1.0, jnp.sin(turn)
        x, y = (late - first)[:, 0], (late - first)[:, 1]
        turned = jnp.stack([cos * x - sin * y, sin * x + cos * y, jnp.zeros_like(x)], axis=-1)
        return memory, late + (start - first) + turned


def _gone_back(poses: jax.Array, path: jax.Array, time: jax.Array, dt: float) -> jax.Array:
    """Poses (R, 3) moved by times (R,) [s], all at most 0, along the arc of the path's first step."""
    step = (path[1] - path[0]) / dt
    turned = step[2] * time
    chord = time * jnp.sinc(turned / (2 * jnp.pi)) / jnp.sinc(step[2] * dt / (2 * jnp.pi))
    turn = (turned - step[2] * dt) / 2  # from the chord of the first step to that of the way back
    x, y = jnp.cos(turn) * step[0] - jnp.sin(turn) * step[1], jnp.sin(turn) * step[0] + jnp.cos(turn) * step[1]
    return poses + jnp.stack([chord * x, chord * y, turned], axis=-1)
