"""Commands that lapse when they are not sent again."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import Motion, parameter

MAKER = {"validity": 0.2, "resend": 0.1}
"""The chair's 200 ms, and a sender at the 10 Hz of the maker's Python driver."""


@struct.dataclass
class Link:
    """State of the line between sender and vehicle."""

    sent: jax.Array  # (2,) command of the latest packet
    heard: jax.Array  # (2,) command of the latest packet that arrived
    since_sent: jax.Array  # () s
    since_heard: jax.Array  # () s
    count: jax.Array  # () packets sent so far


@struct.dataclass
class CommandExpiry(Effect):
    """u -> 0 where no packet has arrived for `validity`; else u -> the command of the latest packet that arrived.

    A packet is sent whenever the command changes, and every `resend` seconds. A share `loss` of the packets never
    arrives; in every drive these are the same ones. With `resend` above `validity` the vehicle moves in spurts. What
    the chair does on expiry is not documented. We assume a command of zero; `acceleration_limit` behind this effect
    ramps it.
    """

    name = "command_expiry"
    typical = {"validity": (0.2, 0.2), "resend": (0.05, 0.1), "loss": (0.0, 0.1)}
    source = "maker's protocol specification: a command is valid for 200 ms; the maker's driver resends every 100 ms"
    card = Card(
        stepped=True,
        limits="How the chair stops when a command lapses is not documented; a command of zero is assumed.",
    )
    validity: jax.Array = parameter("s", 0.05, 2.0, float("inf"), "time after which a command lapses")
    resend: jax.Array = parameter("s", 0.01, 2.0, 0.1, "period at which the sender repeats its command")
    loss: jax.Array = parameter("-", 0.0, 0.9, 0.0, "share of the packets that are lost")

    def init(self) -> Link:
        return Link(jnp.zeros(2), jnp.zeros(2), 1e3 * jnp.ones(()), jnp.zeros(()), jnp.zeros((), jnp.uint32))

    def command(self, memory: Link, command: jax.Array, motion: Motion) -> tuple[Link, jax.Array]:
        """Command (2,) in force on the vehicle."""
        half = motion.dt / 2  # times are multiples of dt up to rounding
        sends = (command != memory.sent).any() | (memory.since_sent + half >= self.resend)
        arrives = sends & (_uniform(memory.count) >= self.loss)
        heard = jnp.where(arrives, command, memory.heard)
        silence = jnp.where(arrives, 0.0, memory.since_heard)
        after = Link(
            sent=jnp.where(sends, command, memory.sent),
            heard=heard,
            since_sent=jnp.where(sends, 0.0, memory.since_sent) + motion.dt,
            since_heard=silence + motion.dt,
            count=memory.count + sends.astype(jnp.uint32),
        )
        return after, jnp.where(silence + half > self.validity, 0.0, heard)


def _uniform(count: jax.Array) -> jax.Array:
    """A number in [0, 1) for each packet, from an integer hash."""
    mixed = (count + jnp.uint32(1)) * jnp.uint32(0x9E3779B1)
    mixed = (mixed ^ (mixed >> 16)) * jnp.uint32(0x85EBCA6B)
    mixed = mixed ^ (mixed >> 13)
    return (mixed >> 8).astype(jnp.result_type(float)) * 2.0**-24
