"""Safer policies: limits on how fast commands may change and how fast the vehicle may near what it scans, and rewards
for keeping away from things.

All belong to the training, not to the task: the returns that evaluations report stay the task's own. The limits are
part of the exported policy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.env import Env
from whill_mjx.learning.monitor import Monitor, monitor_of
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
    monitor_time: float = 0.0
    """Time until the vehicle would touch what its scanners see on its way: it slows down to leave so much [s]; 0 does
    not."""
    monitor_margin: float = 0.1
    """Distance at which it no longer nears that [m]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) >= 0:
                raise ValueError(f"Safety.{field.name} = {getattr(self, field.name)}: it must not be negative. "
                                 f"Change {field.name}.")

    @property
    def limits(self) -> bool:
        """Whether commands are limited."""
        return self.acceleration > 0 or self.yaw_acceleration > 0 or self.monitor_time > 0

    def monitor(self, env: Env) -> Monitor | None:
        """The monitor of an environment's vehicle, if one is asked for; ValueError where nothing scans."""
        return monitor_of(env, self.monitor_time, self.monitor_margin) if self.monitor_time else None


SAFETY = {
    "none": Safety(),
    "smooth": Safety(change_gain=0.2, acceleration=1.0, yaw_acceleration=2.0),
    "safe": Safety(clearance_gain=40.0, change_gain=0.2, acceleration=1.0, yaw_acceleration=2.0),
    "monitor": Safety(monitor_time=1.0),
}
"""The paper's reward; commands that change gently; these with a distance kept; and a collision monitor on the scans."""


def find_safety(name: str) -> Safety:
    """Settings by name; ValueError names the known ones."""
    if name not in SAFETY:
        raise ValueError(f"unknown safety {name!r} (known: {', '.join(SAFETY)}).")
    return SAFETY[name]


@dataclass(frozen=True)
class Limiter:
    """Limits of the commands of one environment. Hashable: a static part of a policy."""

    task: Task
    safety: Safety
    monitor: Monitor | None
    seconds: float
    """From one decision to the next."""

    def memory(self) -> dict[str, jax.Array]:
        """What the monitor remembers at the start of an episode; nothing without one."""
        return self.monitor.memory() if self.monitor else {}

    def limited(
        self, action: jax.Array, before: jax.Array, seen: Any, memory: dict[str, jax.Array]
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The action (2,) in [-1, 1] next to the one that is wanted, within the limits; and the memory after it.

        Args:
            action: (2,) wanted, in [-1, 1].
            before: (2,) v [m/s] and omega [rad/s] commanded last; zeros at the start of an episode.
            seen: image, or observations by name, by which the action was chosen.
            memory: after the decision before.
        """
        low, high = command_range(self.task)
        wanted = low + (jnp.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (high - low)
        rates = jnp.array([self.safety.acceleration, self.safety.yaw_acceleration])
        reach = jnp.where(rates > 0, rates * self.seconds, jnp.inf)
        command = jnp.clip(wanted, before - reach, before + reach)
        if self.monitor is not None:  # it may brake harder than the limits of change
            command, memory = self.monitor.slowed(command, before, seen, memory)
        return jnp.clip((command - low) / (high - low) * 2.0 - 1.0, -1.0, 1.0), memory


def limiter_of(safety: Safety, env: Env) -> Limiter | None:
    """The limits of an environment's commands, if there are any; ValueError where they need scans that it lacks."""
    if not safety.limits:
        return None
    seconds = env.model.config.control_dt * env.task.action_repeat
    return Limiter(env.task, safety, safety.monitor(env), seconds)


def command_range(task: Task) -> tuple[jax.Array, jax.Array]:
    """Commands (2,) at action -1 and at +1."""
    return jnp.array([task.v_min, -task.omega_max]), jnp.array([task.v_max, task.omega_max])


def penalty(safety: Safety, clearance: jax.Array, change: jax.Array, seconds: float) -> jax.Array:
    """() reward lost in one step of this length [s], for a distance () m and a change (2,) of the action."""
    short = jnp.maximum(safety.clearance_margin - clearance, 0.0)
    return safety.clearance_gain * seconds * short + safety.change_gain * jnp.sum(jnp.abs(change))


BEFORE = "before_"
"""Prefix of the carries of what the monitor remembers."""
Step = Callable[[Any, dict[str, jax.Array], Any], tuple[dict[str, jax.Array], jax.Array]]
"""(weights, carry, image or observations by name) -> carry, action (2,), of one instance."""


def limited_policy(limiter: Limiter | None, step: Step, carry: dict[str, Any]) -> tuple[Step, dict[str, Any]]:
    """A policy step that keeps to the limits by itself, and its first carry, which now also holds the last command.

    So the exported file needs no limiter beside it. Without limits the policy is given back as it is.
    """
    if limiter is None:
        return step, carry
    low, high = command_range(limiter.task)

    def named(memory: dict[str, jax.Array]) -> dict[str, jax.Array]:
        return {BEFORE + name: value for name, value in memory.items()}

    own = {"command": jnp.zeros(2), **named(limiter.memory())}

    def limited(weights: Any, carry: dict[str, jax.Array], seen: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        inner = {name: value for name, value in carry.items() if name not in own}
        memory = {name: carry[BEFORE + name] for name in limiter.memory()}
        inner, action = step(weights, inner, seen)
        action, memory = limiter.limited(action, carry["command"], seen, memory)
        return {**inner, "command": low + (action + 1.0) / 2.0 * (high - low), **named(memory)}, action

    return limited, {**carry, **own}
