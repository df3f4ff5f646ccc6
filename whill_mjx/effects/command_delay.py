"""Transport delay of commands."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import GONE_WHEN_SETTLED, SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, Alike, Axis, Card, Variant
from whill_mjx.vehicle.types import Motion, parameter

SLOTS = 8  # changes of the command that can be under way at once; older ones count as arrived


@struct.dataclass
class CommandMemory:
    """The latest changes of the command, newest first."""

    value: jax.Array  # (SLOTS, 2) the command after the change
    age: jax.Array  # (SLOTS,) time since it was sent [s]


@struct.dataclass
class CommandDelay(Effect):
    """A command acts `delay` after it is sent: u(t) = u_sent(t - delay).

    Changes are stored with their age, so any delay is possible. A change is blended in linearly over the last physics
    step of its delay, so the derivative with respect to the delay is defined.
    """

    name = "command_delay"
    typical = {"delay": (0.02, 0.2)}
    source = "estimate; a command takes 2.6 ms on the serial line alone"
    card = Card(
        order=10,
        variants=(Variant((Axis("delay", 0.04, limit=10.0),), kind="parameter_shift"),),
        forbids=(SAME_FOR_ANY_STEP, SHOWS_AT_BOTH_ENDS, GONE_WHEN_SETTLED),
        sensor="a log of the commands as the vehicle receives them",
        shown_by_pose=True,
        alike=(Alike(("sensor_delay", "clock_offset", "state_rate"), "shifts in time",
                     "an outside pose, which sees the first alone"),
               Alike(("pose_delay",), "shifts in time", "odometry, which sees the first alone")),
    )
    delay: jax.Array = parameter("s", 0.0, 0.5, 0.0, "time from sending a command to its effect")

    def init(self) -> CommandMemory:
        return CommandMemory(jnp.zeros((SLOTS, 2)), 1e3 * jnp.ones(SLOTS))

    def command(self, memory: CommandMemory, command: jax.Array, motion: Motion) -> tuple[CommandMemory, jax.Array]:
        """Delayed command (2,)."""
        changed = (command != memory.value[0]).any()
        value = jnp.where(changed, jnp.concatenate([command[None], memory.value[:-1]]), memory.value)
        age = jnp.where(changed, jnp.concatenate([jnp.zeros(1), memory.age[:-1]]), memory.age)
        arrived = jnp.clip((age - self.delay) / motion.dt + 1.0, 0.0, 1.0)
        delayed = value[-1]
        for slot in range(SLOTS - 2, -1, -1):  # from the oldest change to the newest
            blend = delayed + arrived[slot] * (value[slot] - delayed)
            delayed = jnp.where(arrived[slot] >= 1.0, value[slot], blend)  # exact, not only to rounding
        return CommandMemory(value, age + motion.dt), delayed

    def ahead(self, commands: jax.Array, dt: float, before: jax.Array | None = None) -> jax.Array:
        """The command (S, 2) in force in each of S physics steps of `dt` [s], from the commands (S, 2) sent in them.

        The same as `command` step by step, but for any number of changes under way. Before the first step `before` (2,)
        was sent for long; by default none.
        """
        steps = self.delay / dt
        whole = jnp.floor(steps)
        first = jnp.zeros(2, commands.dtype) if before is None else before
        sent = jnp.concatenate([first[None], commands])
        at = jnp.arange(1, len(sent)) - whole.astype(int)
        newer, older = (sent[jnp.clip(index, 0, None)] for index in (at, at - 1))
        return newer + (steps - whole) * (older - newer)
