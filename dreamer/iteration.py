"""One training iteration as a pure function: collect, store, update k times, write the latents back."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.sharding import Mesh

from dreamer import agent as agents
from dreamer import parallel, replay, sensors, spaces
from dreamer.agent import AgentState
from dreamer.config import DreamerConfig
from dreamer.replay import Batch, Replay
from dreamer.rssm import Latent
from dreamer.types import Carry, EnvState, FunctionalEnv, Transition

Metrics = dict[str, jax.Array]


@struct.dataclass
class TrainState:
    """Everything a run needs to go on exactly where it was."""

    agent: AgentState
    env_state: EnvState
    transition: Transition
    """Frames waiting for an action."""
    carry: Carry
    replay: Replay
    key: jax.Array
    env_steps: jax.Array
    """() int32 control steps summed over instances."""
    credit: jax.Array
    """() int32 replayed steps owed to the collected ones, in units of the train ratio's denominator."""
    episode_return: jax.Array
    """(N,) of the running episodes."""
    episode_length: jax.Array
    """(N,) int32 steps of the running episodes."""


def init_state(env: FunctionalEnv, config: DreamerConfig, seed: int | jax.Array) -> TrainState:
    """State before the first step.

    Raises:
        ValueError: observation, action or replay do not fit.
    """
    sensors.check(config, env.obs_shape)
    agent_key, env_key, key = jax.random.split(jax.random.PRNGKey(seed), 3)
    env_state, transition = env.reset(env_key)
    spaces.check(env.obs_shape, transition.obs, env.num_envs)
    return TrainState(
        agent=agents.init_agent(config, env.obs_shape, env.action_dim, agent_key),
        env_state=env_state,
        transition=transition,
        carry=agents.init_carry(config, env.num_envs, env.action_dim),
        replay=replay.init(config, env.num_envs, env.obs_shape, spaces.actions(env.action_dim).width),
        key=key,
        env_steps=jnp.zeros((), jnp.int32),
        credit=jnp.zeros((), jnp.int32),
        episode_return=jnp.zeros((env.num_envs,), jnp.float32),
        episode_length=jnp.zeros((env.num_envs,), jnp.int32),
    )


def train_iteration(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None = None
) -> tuple[TrainState, Metrics]:
    """Advance every instance by `steps_per_iter` steps, with the updates that the train ratio asks for in between.

    Compile it once with the state donated; the replay is then changed in place.

    Args:
        env: vector environment, static.
        config: hyperparameters, static.
        state: from `init_state` or the previous call.
        mesh: devices over which batches are split; None for one device.

    Returns:
        New state, and sums over the iteration: `updates` and `episodes` count the terms of `update/...` and
        `episode/...`.
    """

    def body(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key, act_key, update_key = jax.random.split(state.key, 3)
        state, episode_metrics = collect(env, config, dataclasses.replace(state, key=key), act_key)
        state, update_metrics = learn(env, config, state, update_key, mesh)
        return state, {**episode_metrics, **update_metrics}

    if config.steps_per_iter == 1:
        return body(state, None)
    state, metrics = jax.lax.scan(body, state, None, length=config.steps_per_iter)
    return state, jax.tree.map(lambda x: jnp.sum(x, 0), metrics)


def collect(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, key: jax.Array
) -> tuple[TrainState, Metrics]:
    """One step of every instance, written to the replay. Actions are random until `learning_starts`."""
    policy_key, random_key = jax.random.split(key)
    frame = state.transition
    carry, action = agents.act(config, state.agent.params, state.carry, frame.obs, frame.is_first, policy_key)
    actions = spaces.actions(env.action_dim)
    random_action = actions.random(random_key, action.shape[:1])
    action = jnp.where(state.env_steps < config.learning_starts, random_action, action)
    latent = Latent(carry["deter"], carry["stoch"])
    memory = replay.write(config, state.replay, frame, action, latent)
    env_state, transition = env.step(state.env_state, actions.to_env(action))
    begun = transition.is_first
    episode_return = jnp.where(begun, 0.0, state.episode_return) + transition.reward
    episode_length = jnp.where(begun, 0, state.episode_length + 1)
    done = transition.is_last.astype(jnp.float32)
    watched = {"return": episode_return, "length": episode_length, **transition.metrics}
    metrics = {f"episode/{name}": jnp.sum(done * value) for name, value in watched.items()}
    metrics["episodes"] = jnp.sum(done)
    state = dataclasses.replace(
        state,
        env_state=env_state,
        transition=transition,
        carry={**carry, "action": action},
        replay=memory,
        env_steps=state.env_steps + env.num_envs,
        episode_return=episode_return,
        episode_length=episode_length,
    )
    return state, metrics


def learn(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, key: jax.Array, mesh: Mesh | None = None
) -> tuple[TrainState, Metrics]:
    """As many updates as the collected steps have earned.

    Steps earn credit only once learning has started and is kept exactly, so nothing is caught up later and a resumed
    run goes on at the same rate.
    """
    gain, price = credit_rates(config, env.num_envs)
    enough = replay.size(state.replay) > config.batch_length
    ready = (state.env_steps >= config.learning_starts) & enough
    credit = state.credit + jnp.where(ready, gain, 0)
    updates = credit // price

    def one(i: jax.Array, carry: tuple[AgentState, Replay]) -> tuple[AgentState, Replay, Metrics]:
        agent, memory = carry
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        memory, batch, window = replay.sample(config, memory, sample_key)
        agent, latent, metrics = agents.update(config, agent, split_batch(mesh, batch), update_key)
        return agent, replay.write_back(config, memory, window, latent), metrics

    def add(i: jax.Array, carry: tuple[AgentState, Replay, Metrics]) -> tuple[AgentState, Replay, Metrics]:
        agent, memory, metrics = one(i, carry[:2])
        return agent, memory, jax.tree.map(jnp.add, carry[2], metrics)

    shapes = jax.eval_shape(one, jnp.zeros((), jnp.int32), (state.agent, state.replay))[2]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    agent, memory, sums = jax.lax.fori_loop(0, updates, add, (state.agent, state.replay, zeros))
    metrics = {**{f"update/{name}": value for name, value in sums.items()}, "updates": updates}
    return dataclasses.replace(state, agent=agent, replay=memory, credit=credit - updates * price), metrics


def split_batch(mesh: Mesh | None, batch: Batch) -> Batch:
    """The batch with its sequences split over the devices."""
    steps = {field.name: getattr(batch, field.name) for field in dataclasses.fields(batch) if field.name != "start"}
    return Batch(**parallel.split(mesh, steps, 1), start=parallel.split(mesh, batch.start, 0))


def credit_rates(config: DreamerConfig, num_envs: int) -> tuple[int, int]:
    """Credit earned by one step of all instances, and the price of one update, as whole numbers."""
    ratio = Fraction(config.train_ratio).limit_denominator(1000)
    return num_envs * ratio.numerator, config.replayed_per_update * ratio.denominator


def compile_iteration(env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None = None) -> Any:
    """The compiled iteration, state -> (state, metrics), with the state donated."""

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        return train_iteration(env, config, state, mesh)

    if mesh is None:
        return jax.jit(iterate, donate_argnums=0).lower(state).compile()
    placement = parallel.state_shardings(mesh, state, env.num_envs)
    out = (placement, parallel.replicated(mesh))
    return jax.jit(iterate, donate_argnums=0, in_shardings=(placement,), out_shardings=out).lower(state).compile()


def compile_init(env: FunctionalEnv, config: DreamerConfig, seed: int, mesh: Mesh | None = None) -> Any:
    """The compiled `init_state`, () -> state, each array made where it belongs."""

    def begin() -> TrainState:
        return init_state(env, config, seed)

    if mesh is None:
        return jax.jit(begin)
    return jax.jit(begin, out_shardings=parallel.state_shardings(mesh, jax.eval_shape(begin), env.num_envs))
