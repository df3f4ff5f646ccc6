"""Effects that a replay takes out of the vehicle, since their law applies to all commands or all records at once.

Within the vehicle every physics step would carry their memory.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax

from whill_mjx.effects.command_delay import CommandDelay


def without(params: Any, name: str) -> tuple[Any, Any]:
    """The vehicle without the last of its effects of sensing, where that is the named one, and that effect or None.

    What was recorded is read by its law instead, without a buffer that every step would have to carry.
    """
    effects = getattr(params, "effects", ())
    last = [effect for effect in effects if hasattr(effect, "sensing")][-1:]
    if not last or getattr(last[0], "name", "") != name:
        return params, None
    return replace(params, effects=tuple(effect for effect in effects if effect is not last[0])), last[0]


def delayed(params: Any, command: jax.Array, dt: float) -> tuple[Any, jax.Array]:
    """The vehicle without the first of its effects on commands, where that is a delay, and commands (R, K, 2) that are
    delayed by its law: every step would carry the changes under way, on an accelerator as a kernel for each number."""
    effects = getattr(params, "effects", ())
    first = next((effect for effect in effects if hasattr(effect, "command")), None)
    if not isinstance(first, CommandDelay):
        return params, command
    kept = replace(params, effects=tuple(effect for effect in effects if effect is not first))
    return kept, first.ahead(command.reshape(-1, 2), dt).reshape(command.shape)
