"""Effects that a replay takes out of the vehicle, since their law applies to all commands or all records at once."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.vehicle.types import Motion

LONG = 1e6
"""A time after which every effect on commands has come to what it makes of a constant command [s]."""


def without(params: Any, name: str) -> tuple[Any, Any]:
    """The vehicle without the last of its effects of sensing, where that is the named one, and that effect or None."""
    effects = getattr(params, "effects", ())
    last = [effect for effect in effects if hasattr(effect, "sensing")][-1:]
    if not last or getattr(last[0], "name", "") != name:
        return params, None
    return replace(params, effects=tuple(effect for effect in effects if effect is not last[0])), last[0]


def delay_apart(params: Any) -> tuple[Any, CommandDelay | None]:
    """The vehicle without the first of its effects on commands, where that is a delay, and that delay or None."""
    effects = getattr(params, "effects", ())
    first = next((effect for effect in effects if hasattr(effect, "command")), None)
    if not isinstance(first, CommandDelay):
        return params, None
    return replace(params, effects=tuple(effect for effect in effects if effect is not first)), first


def delayed(delay: CommandDelay | None, command: jax.Array, dt: float, before: jax.Array | None = None) -> jax.Array:
    """Commands (R, K, 2) delayed by its law; `before` (2,) is the one in force until they begin, by default none."""
    if delay is None:
        return command
    return delay.ahead(command.reshape(-1, 2), dt, before).reshape(command.shape)


@struct.dataclass
class Reached(Effect):
    """An effect on commands as it is where each command has been in force for ever."""

    effect: Any

    def command(self, memory: Any, command: jax.Array, motion: Motion) -> tuple[Any, jax.Array]:
        """What the effect makes of a constant command (2,) in the end."""
        held: Any = SimpleNamespace(dt=LONG, track=getattr(motion, "track", None))
        return self.effect.command(memory, command, held)


def reached(params: Any) -> Any:
    """The vehicle with all effects on commands as they are in the end; memories are those of the vehicle itself."""
    effects = getattr(params, "effects", ())
    if not any(hasattr(effect, "command") for effect in effects):
        return params
    return replace(params, effects=tuple(Reached(one) if hasattr(one, "command") else one for one in effects))
