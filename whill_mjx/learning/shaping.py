"""Safer policies: a limit on how fast commands may change, and rewards for keeping away from things.

Both belong to the training, not to the task: the returns that evaluations report stay the task's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.tasks.tasks import Task


@dataclass(frozen=True)
class Safety:
    """What is asked of a policy besides the task. The defaults ask nothing."""

    clearance_gain: float = 0.0
    """Reward lost per second and per metre that the distance to the nearest thing falls short of the margin."""
    clearance_margin: float = 0.25
    """Distance that is to be kept [m]."""
    change_gain: float = 0.0
    """Reward lost per unit that an action in [-1, 1] has changed, summed over its components."""
    acceleration: float = 0.0
    """Largest change of the commanded speed [m/s^2]; 0 sets no limit."""
    yaw_acceleration: float = 0.0
    """Largest change of the commanded yaw rate [rad/s^2]; 0 sets no limit."""

    def __post_init__(self) -> None:
        for name in ("clearance_gain", "clearance_margin", "change_gain", "acceleration", "yaw_acceleration"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"Safety.{name} = {getattr(self, name)}: it must not be negative. Change {name}.")

    @property
    def limits(self) -> bool:
        """Whether commands are limited."""
        return self.acceleration > 0 or self.yaw_acceleration > 0


SAFETY = {
    "none": Safety(),
    "smooth": Safety(change_gain=0.2, acceleration=1.0, yaw_acceleration=2.0),
    "safe": Safety(clearance_gain=40.0, change_gain=0.2, acceleration=1.0, yaw_acceleration=2.0),
}
"""The paper's reward; commands that change gently; and these with a distance kept."""


def find_safety(name: str) -> Safety:
    """Settings by name; ValueError names the known ones."""
    if name not in SAFETY:
        raise ValueError(f"unknown safety {name!r} (known: {', '.join(SAFETY)}).")
    return SAFETY[name]


def limit_action(task: Task, safety: Safety, action: jax.Array, before: jax.Array, seconds: float) -> jax.Array:
    """The action (2,) whose command lies within reach of the command `before` (2,) in this time [s].

    Args:
        task: gives the range of v and omega.
        safety: the limits; a limit of 0 is none.
        action: (2,) wanted, in [-1, 1].
        before: (2,) v [m/s] and omega [rad/s] commanded last; zeros at the start of an episode.
        seconds: from one decision to the next.
    """
    low, high = command_range(task)
    wanted = low + (jnp.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (high - low)
    rates = jnp.array([safety.acceleration, safety.yaw_acceleration])
    reach = jnp.where(rates > 0, rates * seconds, jnp.inf)
    return (jnp.clip(wanted, before - reach, before + reach) - low) / (high - low) * 2.0 - 1.0


def command_range(task: Task) -> tuple[jax.Array, jax.Array]:
    """Commands (2,) at action -1 and at +1."""
    return jnp.array([task.v_min, -task.omega_max]), jnp.array([task.v_max, task.omega_max])


def penalty(safety: Safety, clearance: jax.Array, change: jax.Array, seconds: float) -> jax.Array:
    """() reward lost in one step of this length [s], for a distance () m and a change (2,) of the action."""
    short = jnp.maximum(safety.clearance_margin - clearance, 0.0)
    return safety.clearance_gain * seconds * short + safety.change_gain * jnp.sum(jnp.abs(change))


Step = Callable[[Any, dict[str, jax.Array], Any], tuple[dict[str, jax.Array], jax.Array]]
"""(weights, carry, image or observations by name) -> carry, action (2,), of one instance."""


def limited_policy(
    task: Task, safety: Safety, step: Step, carry: dict[str, Any], seconds: float
) -> tuple[Step, dict[str, Any]]:
    """A policy step that keeps to the limits by itself, and its first carry, which now also holds the last command.

    So the exported file needs no limiter beside it. Without limits the policy is given back as it is.
    """
    if not safety.limits:
        return step, carry
    low, high = command_range(task)

    def limited(weights: Any, carry: dict[str, jax.Array], image: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        inner = {name: value for name, value in carry.items() if name != "command"}
        inner, action = step(weights, inner, image)
        action = limit_action(task, safety, action, carry["command"], seconds)
        return {**inner, "command": low + (action + 1.0) / 2.0 * (high - low)}, action

    return limited, {**carry, "command": jnp.zeros(2)}
