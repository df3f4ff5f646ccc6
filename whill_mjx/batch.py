"""The instance axis: N environments side by side, auto-reset, random vehicle parameters, sharding over devices."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.devices import platform
from whill_mjx.env import (
    Env,
    Outcome,
    State,
    first_outcome,
    observe,
    repainted,
    reset_state,
    sense,
    step_state,
    time_step,
)
from whill_mjx.io.fields import BATCH, check_fields
from whill_mjx.vehicle.types import TimeStep, VehicleParams
from whill_mjx.world.randomize import Variation, randomize_params, vary_params

FEW = 16
"""Episodes that are begun at once on a processor, where a world costs more than a control period. An accelerator begins
one for every instance, which takes it no longer."""


@struct.dataclass
class BatchState:
    """N instances between two steps."""

    env: State  # leaves (N, ...)
    params: VehicleParams  # leaves (N, ...): each instance has its own vehicle
    origin: jax.Array  # (N,) random key from which world, vehicle and start of the episode were drawn
    tries: jax.Array  # (N,) int32: how often the episode's world was begun again; ~ that after a success

    @property
    def begun_again(self) -> jax.Array:
        """(N,) int32: how often the episode's world was begun again."""
        return jnp.where(self.tries < 0, ~self.tries, self.tries)


@dataclass(frozen=True, eq=False)
class BatchEnv:
    """N instances of one environment. Static: closed over by compiled functions."""

    env: Env
    params: VehicleParams
    """Nominal parameters of the vehicle."""
    count: int
    """N."""
    spread: float = 0.0
    """Relative spread of the vehicle parameters, drawn anew for each episode; 0 gives all the nominal ones."""
    devices: tuple = ()
    """Devices over which the instances are split evenly; none leaves the placement to JAX."""
    second_tries: float = 0.0
    """Share of the episodes without success after which the same world is begun again, with the same vehicle and
    start; for training. What fails is met more often so (cf. prioritised level replay, Jiang et al. 2021)."""

    variations: tuple[Variation, ...] = ()
    """Parameters of the vehicle that are drawn from their ranges, anew for each episode."""

    def __post_init__(self) -> None:
        check_fields("batch", BATCH, self)
        if not 0.0 <= self.second_tries < 1.0:
            raise ValueError(f"second_tries is {self.second_tries}: it is a share of episodes; use 0 to below 1.")
        if self.devices and self.count % len(self.devices):
            raise ValueError(f"{self.count} instances do not split evenly over {len(self.devices)} devices.")

    def reset(self, key: jax.Array) -> tuple[BatchState, TimeStep]:
        """Start N episodes; leaves of the time step are (N, ...)."""
        return self._split(self._reset)(jax.random.split(key, self.count))

    def step(self, state: BatchState, actions: jax.Array) -> tuple[BatchState, TimeStep]:
        """Advance N instances by one environment step.

        An instance whose episode has ended ignores its action: it starts a new episode and returns that one's first
        frame, with `first` True and reward 0. So the last frame of an episode is seen before it is replaced.

        Args:
            state: from `reset` or the previous `step`.
            actions: (N, 2), each in [-1, 1].

        Raises:
            ValueError: actions of another shape.
        """
        wanted = (*state.origin.shape[:1], 2)
        if jnp.shape(actions) != wanted:
            raise ValueError(f"actions have the shape {jnp.shape(actions)}; a step takes {wanted}: speed and yaw rate "
                             "of each instance, as shares of their limits.")
        return self._split(self._step)(state, actions)

    def begin_one(
        self, origin: jax.Array, change: Callable[[VehicleParams, State], State] | None = None
    ) -> tuple[BatchState, TimeStep]:
        """Start an episode of one instance: its state without the instance axis, and its first time step.

        Args:
            origin: random key; the same one gives the same world, vehicle and start.
            change: (parameters, state) -> state, applied before anything is observed; None changes nothing.
        """
        state, outcome = self._begin(origin)
        if change is not None:
            state = dataclasses.replace(state, env=change(state.params, state.env))
            outcome = first_outcome(self.env, state.env)
        env, obs = sense(self.env, state.params, state.env)
        return dataclasses.replace(state, env=env), time_step(obs, outcome, jnp.array(True))

    def step_one(self, state: BatchState, action: jax.Array) -> tuple[BatchState, TimeStep]:
        """Advance one instance, from `begin_one`, by one environment step; nothing begins anew."""
        env, outcome = step_state(self.env, state.params, state.env, action)
        env, obs = sense(self.env, state.params, env)
        return dataclasses.replace(state, env=env), time_step(obs, outcome, jnp.array(False))

    def observe_repainted(self, state: BatchState, worlds: int) -> jax.Array:
        """(K, N, H, W, 3) images of the same moment in K other worlds of the same shape (`env.repainted`).

        Each looks the same until its episode ends.
        """

        def one(state: BatchState, number: jax.Array) -> jax.Array:
            key = jax.random.fold_in(jax.random.fold_in(state.origin, number), state.begun_again)
            return observe(self.env, repainted(self.env, state.env, key))

        numbers = jnp.arange(1, worlds + 1)
        every = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))
        return jnp.swapaxes(self._split(lambda state: every(state, numbers))(state), 0, 1)

    def _reset(self, keys: jax.Array) -> tuple[BatchState, TimeStep]:
        state, outcome = jax.vmap(self._begin)(keys)
        state, obs = self._sense(state)
        return state, time_step(obs, outcome, jnp.ones(keys.shape[:1], bool))

    def _step(self, state: BatchState, actions: jax.Array) -> tuple[BatchState, TimeStep]:
        few = platform() == "cpu" and actions.shape[0] > FEW
        state, outcome, first = (self._advance_few if few else jax.vmap(self._advance))(state, actions)
        state, obs = self._sense(state)  # once, after the choice between step and reset
        return state, time_step(obs, outcome, first)

    def _sense(self, state: BatchState) -> tuple[BatchState, Any]:
        """State with the memory of the sensors, and what they show (N, ...)."""
        env, obs = jax.vmap(lambda one, params: sense(self.env, params, one))(state.env, state.params)
        return dataclasses.replace(state, env=env), obs

    def _begin(self, origin: jax.Array, tries: jax.Array | int = 0) -> tuple[BatchState, Outcome]:
        key, params_key = jax.random.split(origin)
        params = randomize_params(params_key, self.params, self.spread) if self.spread else self.params
        if self.variations:
            params = vary_params(jax.random.fold_in(params_key, 1), params, self.variations)
        params = jax.tree.map(jnp.asarray, params)
        state = reset_state(self.env, params, key)
        return BatchState(state, params, origin, jnp.asarray(tries, jnp.int32)), first_outcome(self.env, state)

    def _again(self, state: BatchState) -> tuple[jax.Array, jax.Array]:
        """Key with which the next episode of an instance begins, and how often its world was begun before."""
        chance = jax.random.uniform(jax.random.fold_in(state.env.key, state.begun_again))
        again = (state.tries >= 0) & (chance < self.second_tries)
        return jnp.where(again, state.origin, state.env.key), jnp.where(again, state.tries + 1, 0)

    def _advance(self, state: BatchState, action: jax.Array) -> tuple[BatchState, Outcome, jax.Array]:
        ended = state.env.done
        chosen, outcome = jax.tree.map(
            lambda new, old: jnp.where(ended, new, old), self._anew(state), self._go_on(state, action)
        )
        return chosen, outcome, ended

    def _go_on(self, state: BatchState, action: jax.Array) -> tuple[BatchState, Outcome]:
        after, outcome = step_state(self.env, state.params, state.env, action)
        state = dataclasses.replace(state, env=after)
        if self.second_tries:
            succeeded = outcome.metrics["success"] > 0
            state = dataclasses.replace(state, tries=jnp.where(succeeded, ~state.tries, state.tries))
        return state, outcome

    def _anew(self, state: BatchState) -> tuple[BatchState, Outcome]:
        return self._begin(*(self._again(state) if self.second_tries else (state.env.key,)))

    def _advance_few(self, state: BatchState, actions: jax.Array) -> tuple[BatchState, Outcome, jax.Array]:
        """The same for all instances; worlds are drawn for those alone that have ended, `FEW` at a time."""
        ended, count = state.env.done, actions.shape[0]
        first = jax.vmap(self._go_on)(state, actions)
        order = jnp.pad(jnp.argsort(~ended, stable=True), (0, FEW))
        place = jnp.cumsum(ended) - 1  # of an instance that has ended, among these

        def some(number: jax.Array, old: tuple[BatchState, Outcome]) -> tuple[BatchState, Outcome]:
            chosen = jax.lax.dynamic_slice_in_dim(order, number * FEW, FEW)
            begun = jax.vmap(self._anew)(jax.tree.map(lambda leaf: leaf[chosen], state))
            here, own = ended & (place // FEW == number), place % FEW

            def pick(new: jax.Array, old: jax.Array) -> jax.Array:
                return jnp.where(here.reshape(count, *[1] * (old.ndim - 1)), new[own], old)

            return jax.tree.map(pick, begun, old)

        return (*jax.lax.fori_loop(0, -(-ended.sum() // FEW), some, first), ended)

    def _split(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function with each device computing its own instances, by the program of a single device.

        Nothing is left to XLA, which cuts plain arithmetic as well, but would have every device run a kernel for all.
        """
        if not self.devices:
            return function
        mesh = jax.sharding.Mesh(self.devices, ("instance",))
        rows = jax.sharding.PartitionSpec("instance")
        return jax.shard_map(function, mesh=mesh, in_specs=rows, out_specs=rows, check_vma=False)


def make_batch(
    env: Env, params: VehicleParams, count: int, spread: float = 0.0, devices: tuple = (), second_tries: float = 0.0,
    variations: tuple[Variation, ...] = (),
) -> BatchEnv:  # fmt: skip
    """`count` instances of `env`; see `BatchEnv` for the rest.

    Raises:
        ValueError: `env` and `params` are exchanged, or a number is out of its range.
    """
    for name, given, kind in (("env", env, Env), ("params", params, VehicleParams)):
        if not isinstance(given, kind):
            raise ValueError(f"make_batch: {name} is a {type(given).__name__}, not {kind.__name__}. Give what make_env "
                             "returns, in its order: make_batch(env, params, count).")
    return BatchEnv(env, params, count, spread, tuple(devices), second_tries, tuple(variations))
