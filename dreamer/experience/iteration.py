"""One training iteration as a pure function: collect, store, update k times, write the latents back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh

from dreamer import spaces
from dreamer.config import LEAST_TRAIN_RATIO, DreamerConfig
from dreamer.experience import exploration, redraw, replay
from dreamer.experience.host_replay import HostFrames
from dreamer.experience.replay import Batch, Replay
from dreamer.layers import sensors
from dreamer.model import agent as agents
from dreamer.model.agent import AgentState
from dreamer.model.rssm import Latent
from dreamer.refusals import INT32, check_same, whole
from dreamer.training import parallel
from dreamer.training.programs import compile_lowered
from dreamer.types import Carry, EnvState, FunctionalEnv, Transition

Metrics = dict[str, jax.Array]
Update = Callable[[DreamerConfig, AgentState, Batch, jax.Array], tuple[AgentState, Latent, Metrics]]


@struct.dataclass
class Pretrained:
    """What was done before the first counted step."""

    steps: jax.Array
    """() int32 control steps with random actions, summed over instances."""
    updates: jax.Array
    """() int32 updates of the world model alone."""


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
    pretrained: Pretrained | None = None
    """None where the configuration asks for no pretraining."""
    noise: jax.Array | None = None
    """(N, A) of the actions; None where it has no memory."""


def check_fit(env: FunctionalEnv, config: DreamerConfig, total_steps: int = 0) -> None:
    """Raise ValueError where observation, mirror, replay, pretraining or the run's length do not fit; nothing is
    computed."""
    whole("total_steps", total_steps, 0, INT32 - env.num_envs * config.steps_per_iter)
    redraw.check(env, config)
    worlds = 0 if env.mirror is None else env.mirror.worlds
    if config.mirror > worlds:
        raise ValueError(
            f"DreamerConfig.mirror = {int(config.mirror)}, but the environment has no mirror that shows more than "
            f"{worlds} other worlds: lower it, or give one."
        )
    sensors.check(config, env.obs_shape)
    replay.rows_for(config, env.num_envs)
    credit_rates(config, env.num_envs)
    needed = config.batch_length * env.num_envs
    if 0 < config.pretrain_steps <= needed:
        raise ValueError(
            f"DreamerConfig.pretrain_steps = {config.pretrain_steps}: {env.num_envs} instances must each drive more "
            f"than batch_length ({config.batch_length}) steps to learn from. Raise it above {needed}, or set it and "
            "pretrain_updates to 0."
        )


def init_state(env: FunctionalEnv, config: DreamerConfig, seed: int | jax.Array) -> TrainState:
    """State before the first step.

    Raises:
        ValueError: observation, action, replay or pretraining do not fit, or there is no mirror.
    """
    check_fit(env, config)
    zero = jnp.zeros((), jnp.int32)
    agent_key, env_key, key = jax.random.split(jax.random.PRNGKey(seed), 3)
    env_state, transition = env.begin(env_key)
    held = redraw.kept(env, config, env_state, transition)
    redraw.check_memory(env, config, held)
    return TrainState(
        agent=agents.init_agent(config, env.obs_shape, env.action_dim, agent_key),
        env_state=env_state,
        transition=transition,
        carry=agents.init_carry(config, env.num_envs * (1 + config.mirror), env.action_dim),
        replay=replay.init(
            config, env.num_envs, env.obs_shape, spaces.actions(env.action_dim).width, 1 + config.mirror, held
        ),
        key=key,
        env_steps=zero,
        credit=jnp.copy(zero),
        episode_return=jnp.zeros((env.num_envs,), jnp.float32),
        episode_length=jnp.zeros((env.num_envs,), jnp.int32),
        pretrained=Pretrained(jnp.copy(zero), jnp.copy(zero)) if config.pretrain_steps else None,
        noise=exploration.init(config, env.num_envs, env.action_dim, jax.random.fold_in(key, 1)),
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
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, key: jax.Array, always_random: bool = False
) -> tuple[TrainState, Metrics]:
    """One step of every instance, written to the replay. Actions are random until learning has started, or always."""
    policy_key, random_key = jax.random.split(key)
    frame = with_mirrored(env, state.env_state, state.transition, config.mirror)
    actions, noise, drawn = spaces.actions(env.action_dim), None, None
    if state.noise is not None:
        noise = exploration.advance(config, state.noise, random_key)
        drawn = repeated(noise, config.mirror)  # the mirrored ones do not choose
    greedy = exploration.greedy(config, env.num_envs)
    if greedy is not None:
        greedy = repeated(greedy, config.mirror)
    choice = agents.Choice(policy_key, drawn, greedy)
    carry, action = agents.act(config, state.agent.params, state.carry, frame.obs, frame.is_first, choice)
    random_action = actions.random(random_key, action.shape[:1]) if drawn is None else exploration.uniform(drawn)
    action = jnp.where(started(config, state) & (not always_random), action, random_action)
    real = action[: env.num_envs]
    if config.mirror:
        assert env.mirror is not None
        others = env.mirror.action(real, config.mirror)
        action = jnp.concatenate([real, others.reshape(-1, *real.shape[1:])])
    latent = Latent(carry["deter"], carry["stoch"])
    kept = redraw.kept(env, config, state.env_state, state.transition)
    if kept is not None:
        frame = dataclasses.replace(frame, obs=repeated(kept, config.mirror))
    memory = replay.write(config, state.replay, frame, action, latent)
    env_state, transition = env.advance(state.env_state, actions.to_env(real))
    check_same("the Transition: ", state.transition, transition)
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
        noise=noise,
        env_steps=state.env_steps + env.num_envs,
        episode_return=episode_return,
        episode_length=episode_length,
    )
    return state, metrics


def started(config: DreamerConfig, state: TrainState) -> jax.Array:
    """() bool: `learning_starts` random steps have been made, before the counted ones or among them."""
    before = 0 if state.pretrained is None else state.pretrained.steps
    return before + state.env_steps >= config.learning_starts


def with_mirrored(env: FunctionalEnv, env_state: EnvState, transition: Transition, worlds: int) -> Transition:
    """The frames of N instances, and after them the same N as the mirror shows them in each of the other worlds."""
    if not worlds:
        return transition
    assert env.mirror is not None
    others = env.mirror.obs(env_state, transition.obs, worlds)
    obs = jax.tree.map(lambda a, b: jnp.concatenate([a, b.reshape(-1, *a.shape[1:])]), transition.obs, others)
    return dataclasses.replace(repeated(dataclasses.replace(transition, obs=None), worlds), obs=obs)


def repeated(tree: Any, worlds: int) -> Any:
    """What belongs to N instances, (N, ...), and after it the same for each of the other worlds."""
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf] * (1 + worlds)), tree)


def learn(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, key: jax.Array, mesh: Mesh | None = None
) -> tuple[TrainState, Metrics]:
    """As many updates as the collected steps have earned.

    Steps earn credit only once learning has started and is kept exactly, so nothing is caught up later and a resumed
    run goes on at the same rate.
    """
    gain, price = credit_rates(config, env.num_envs)
    enough = replay.size(state.replay) > config.batch_length
    ready = started(config, state) & enough
    credit = state.credit + jnp.where(ready, gain, 0)
    updates = credit // price
    update = redraw.on_redrawn(env, config, agents.update)
    state, metrics = replayed_updates(config, state, updates, key, update, mesh)
    return dataclasses.replace(state, credit=credit - updates * price), metrics


def replayed_updates(
    config: DreamerConfig, state: TrainState, updates: jax.Array, key: jax.Array, update: Update, mesh: Mesh | None
) -> tuple[TrainState, Metrics]:
    """`updates` times () a batch, an `update` on it, and its latents written back; the metrics are sums."""

    def one(i: jax.Array, carry: tuple[AgentState, Replay]) -> tuple[tuple[AgentState, Replay], Metrics]:
        agent, memory = carry
        sample_key, update_key = jax.random.split(jax.random.fold_in(key, i))
        memory, batch, window = replay.sample(config, memory, sample_key)
        agent, latent, metrics = update(config, agent, batch, update_key)
        return (agent, replay.write_back(config, memory, window, latent)), metrics

    columns = jax.tree.map(lambda leaf: 1 if leaf.ndim >= 2 else None, state.replay)
    one = parallel.over_batch(mesh, one, (None, (None, columns)), ((None, columns), None))
    (agent, memory), sums = sum_over(updates, one, (state.agent, state.replay))
    metrics = {**{f"update/{name}": value for name, value in sums.items()}, "updates": updates}
    return dataclasses.replace(state, agent=agent, replay=memory), metrics


def sum_over(
    count: jax.Array, body: Callable[[jax.Array, Any], tuple[Any, Metrics]], carry: Any
) -> tuple[Any, Metrics]:
    """`count` times () `carry, terms = body(i, carry)`: the last carry, and the sums of the terms."""
    body = jax.jit(body, inline=True)  # traced for the shapes of the terms, and not again in the loop

    def add(i: jax.Array, loop: tuple[Any, Metrics]) -> tuple[Any, Metrics]:
        carry, terms = body(i, loop[0])
        return carry, jax.tree.map(jnp.add, loop[1], terms)

    shapes = jax.eval_shape(body, jnp.zeros((), jnp.int32), carry)[1]
    sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.fori_loop(np.int32(0), count, add, (carry, sums))  # of the type that `body` was traced for


def credit_rates(config: DreamerConfig, num_envs: int) -> tuple[int, int]:
    """Credit earned by one step of all instances, and the price of one update, as whole numbers.

    Raises:
        ValueError: 32 bits do not hold them.
    """
    ratio = Fraction(config.train_ratio).limit_denominator(round(1 / LEAST_TRAIN_RATIO))
    gain, price = num_envs * ratio.numerator, config.replayed_per_update * ratio.denominator
    if gain + price > INT32:
        raise ValueError(
            f"DreamerConfig.train_ratio = {config.train_ratio}: with {num_envs} instances and batches of "
            f"{config.replayed_per_update} steps it is counted in parts too small for 32 bits. Round it, to "
            f"{float(ratio):.0f} say, or use fewer instances or smaller batches."
        )
    return gain, price


def compile_iteration(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None = None, step: Any = train_iteration
) -> Any:
    """The compiled iteration, state -> (state, metrics), with the state donated; of `step`, if another one is meant."""
    lowered = lower_iteration(env, config, state, mesh, step)
    return compile_lowered(lowered) if mesh is None else lowered.compile()


def lower_iteration(
    env: FunctionalEnv, config: DreamerConfig, state: TrainState, mesh: Mesh | None = None, step: Any = train_iteration
) -> jax.stages.Lowered:
    """The same before XLA's part; `state` may be its shapes. Further trainings in a process trace nothing again."""
    if mesh is None:
        on_host = isinstance(state.replay.obs, HostFrames)  # memory that must not be held by a kept program
        program = (_iteration.__wrapped__ if on_host else _iteration)(env, config, step)
        return program.lower(state)

    def iterate(state: TrainState) -> tuple[TrainState, Metrics]:
        return step(env, config, state, mesh)

    placement = parallel.state_shardings(mesh, state, env.num_envs)
    out = (placement, parallel.replicated(mesh))
    return jax.jit(iterate, donate_argnums=0, in_shardings=(placement,), out_shardings=out).lower(state)


@lru_cache(maxsize=8)
def _iteration(env: FunctionalEnv, config: DreamerConfig, step: Any) -> Any:
    return jax.jit(lambda state: step(env, config, state, None), donate_argnums=0)


def compile_init(env: FunctionalEnv, config: DreamerConfig, seed: int, mesh: Mesh | None = None) -> Any:
    """The compiled `init_state`, () -> state, each array made where it belongs; one program serves all seeds."""

    given = np.int64(seed).astype(np.int32)  # as JAX itself reads a seed
    if mesh is None:
        on_host = config.replay_memory == "host"  # each state has memory of its own
        return partial((_beginning.__wrapped__ if on_host else _beginning)(env, config), given)

    def begin(seed: jax.Array) -> TrainState:
        return init_state(env, config, seed)

    placement = parallel.state_shardings(mesh, jax.eval_shape(begin, given), env.num_envs)
    return partial(jax.jit(begin, out_shardings=placement), given)


@lru_cache(maxsize=8)
def _beginning(env: FunctionalEnv, config: DreamerConfig) -> Any:
    return jax.jit(lambda seed: init_state(env, config, seed))
