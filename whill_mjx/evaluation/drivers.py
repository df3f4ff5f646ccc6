"""Who may drive in an evaluation: an exported policy, random actions, the planner with the truth, recorded actions.

A driver is a pair of pure functions of ONE instance; `rollouts.py` adds the instance axis.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from whill_mjx.env import Env, State
from whill_mjx.evaluation.planner import first_plan, for_task, plan_action
from whill_mjx.evaluation.policies.policy_file import PolicyFile


@dataclass(frozen=True, eq=False)
class Driver:
    """Memory at the start of an episode, and the action for what is seen."""

    name: str
    begin: Callable[[State, jax.Array], Any]
    """(state, key) -> memory."""
    act: Callable[..., tuple[Any, jax.Array]]
    """(memory, true state, image (H, W, 3) uint8 or the sensors' values by name, key) -> memory, action (2,) in
    [-1, 1]."""
    period: int = 1
    """Control periods from one decision to the next; the action is held in between."""
    sees: bool = True
    """Whether `act` looks at the image; if not, none is rendered."""
    weights: Any = None
    """Arrays that `act` then gets before the others: arguments of a compiled evaluation, which serves any values."""
    memory: Any = None
    """First memory of each episode, leaves (N, ...), in place of what `begin` gives."""

    def decide(self, memory: Any, state: State, image: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        """Memory and action of one instance."""
        before = () if self.weights is None else (self.weights,)
        return self.act(*before, memory, state, image, key)


def policy_driver(policy: PolicyFile) -> Driver:
    """The policy of a file, as it would drive the vehicle: deterministic, from images alone."""

    def act(memory: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        return policy.step(memory, image)

    return Driver(policy.path.name, lambda state, key: policy.start(), act, policy.action_repeat)


def random_driver(period: int = 1) -> Driver:
    """Every action uniform in [-1, 1]."""

    def act(memory: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        return memory, jax.random.uniform(key, (2,), minval=-1.0)

    return Driver("random", lambda state, key: (), act, period, sees=False)


def planner_driver(env: Env) -> Driver:
    """The planner that knows the scene and the pose: the ceiling. It decides in every control period."""
    env = dataclasses.replace(env, task=dataclasses.replace(env.task, action_repeat=1))
    config = for_task(env.task)

    def act(plan: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        action, plan = plan_action(config, env, state, plan, key)
        return plan, action

    return Driver("planner", lambda state, key: first_plan(config, env, state, key), act, sees=False)


def replay_driver() -> Driver:
    """Recorded actions, open loop. Its memory is handed in: actions (T, 2) and the count of the next one."""

    def begin(state: State, key: jax.Array) -> Any:
        raise ValueError("the recorded actions are missing; hand in the memory (actions, 0).")

    def act(memory: Any, state: State, image: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        actions, count = memory
        return (actions, count + 1), actions[jnp.minimum(count, actions.shape[0] - 1)]

    return Driver("replay", begin, act, sees=False)
