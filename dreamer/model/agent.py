"""The agent: all parameters, acting, and one update."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.experience.replay import Batch
from dreamer.layers import distributions as dist
from dreamer.layers import sensors
from dreamer.model import behavior, optim, rssm, world_model
from dreamer.model.behavior import ReturnNorm
from dreamer.model.rssm import Latent
from dreamer.spaces import ActionSpec, ObsShape
from dreamer.training import parallel
from dreamer.types import Carry, Params


@struct.dataclass
class AgentState:
    """Everything an update changes."""

    params: Params
    """Named enc, dyn, dec, reward, continue, policy and value; float32."""
    slow_value: Params
    """Slowly following copy of the critic."""
    opt: optim.OptState
    return_norm: ReturnNorm
    average: Params | None = None
    """Slowly following copy of `params`, if the configuration asks for one."""

    @property
    def acting(self) -> Params:
        """Parameters to evaluate and export: the average, where there is one."""
        return self.params if self.average is None else self.average

    @property
    def updates(self) -> jax.Array:
        """() int32 updates done."""
        return self.opt.count


def init_params(config: DreamerConfig, obs_shape: ObsShape, action_dim: ActionSpec, key: jax.Array) -> Params:
    """Parameters of world model, policy and critic."""
    world_key, policy_key, value_key = jax.random.split(key, 3)
    actions = spaces.actions(action_dim)
    return {
        **world_model.init(config, obs_shape, actions.width, world_key),
        "policy": behavior.init_actor(config, actions.outputs, policy_key),
        "value": behavior.init_critic(config, value_key),
    }


def init_agent(config: DreamerConfig, obs_shape: ObsShape, action_dim: ActionSpec, key: jax.Array) -> AgentState:
    """A new agent.

    Args:
        config: hyperparameters.
        obs_shape: (H, W, C), (D,) or a dict of them.
        action_dim: A or Discrete(n).
        key: consumed.
    """
    params = init_params(config, obs_shape, action_dim, key)
    zero = jnp.zeros((), jnp.float32)
    slow_value = jax.tree.map(jnp.copy, params["value"])  # its own memory: both are donated
    average = jax.tree.map(jnp.copy, params) if config.average_rate else None
    return AgentState(params, slow_value, optim.init(params), ReturnNorm(zero, jnp.copy(zero)), average)


def init_carry(config: DreamerConfig, batch: int, action_dim: ActionSpec) -> Carry:
    """Recurrent state of `batch` instances: all zeros mean the start of an episode."""
    latent = rssm.initial(config, batch)
    action = jnp.zeros((batch, spaces.actions(action_dim).width), jnp.float32)
    return {"deter": latent.deter, "stoch": latent.stoch, "action": action}


class Choice(NamedTuple):
    """How N instances choose their actions."""

    key: jax.Array | None = None
    """Consumed; None takes the most probable latent and action, as on the vehicle."""
    noise: jax.Array | None = None
    """(N, ...) random numbers that choose the actions (`spaces`); drawn by the key unless given."""
    greedy: jax.Array | None = None
    """(N,) bool, those which take the most probable action all the same; none unless given."""


def act(
    config: DreamerConfig, params: Params, carry: Carry, obs: Any, is_first: jax.Array | None, choice: Choice
) -> tuple[Carry, jax.Array]:
    """Infer the state of N instances from their frames and choose actions.

    Args:
        config: sizes.
        params: of the agent.
        carry: from `init_carry` or the previous call.
        obs: (N, ...) as the environment shows it.
        is_first: (N,) bool, resets the carry; None: none of them.
        choice: how actions are chosen.

    Returns:
        The carry, whose latent is the state after this frame, and actions (N, A), not clipped; one-hot classes.
    """
    keep = carry if is_first is None else {
        name: jnp.where(is_first[:, None], jnp.zeros_like(value), value) for name, value in carry.items()
    }
    tokens = sensors.encode(config, params["enc"], obs)
    uniform = None
    if choice.key is not None:
        latent_key, action_key = jax.random.split(choice.key)
        uniform = jax.random.uniform(latent_key, (tokens.shape[0], config.stoch))
    previous = Latent(keep["deter"], keep["stoch"])
    latent = rssm.observe_step(config, params["dyn"], previous, keep["action"], tokens, uniform)
    actions, raw = spaces.actions_of(params), world_model.head(params["policy"], latent.features())
    if choice.key is None:
        action = actions.mode(config, raw)
    else:
        noise = actions.noise(action_key, raw.shape[:1]) if choice.noise is None else choice.noise
        action = actions.sample(config, raw, noise)
        if choice.greedy is not None:
            action = jnp.where(choice.greedy[:, None], actions.mode(config, raw), action)
    after = {"deter": latent.deter, "stoch": latent.stoch, "action": action}
    return after, action


def policy_step(config: DreamerConfig, params: Params, carry: Carry, obs: Any) -> tuple[Carry, jax.Array]:
    """One control step of ONE instance in float32, deterministic: the function that runs on the vehicle.

    Args:
        config: sizes; the compute type is ignored.
        params: of the agent.
        carry: deter (D,), stoch (S * C,), action (A,) float32; zeros start an episode.
        obs: (H, W, C) uint8, or what else the environment shows.

    Returns:
        The new carry and the action (A,) in [-1, 1], or a one-hot class (n,).
    """
    config = dataclasses.replace(config, compute_dtype="float32")
    batched = {name: value[None].astype(jnp.float32) for name, value in carry.items()}
    obs = jax.tree.map(lambda x: x[None], obs)
    new_carry, action = act(config, params, batched, obs, None, Choice())
    return {name: value[0] for name, value in new_carry.items()}, action[0]


def believed(params: Params, carry: Carry, obs_shape: Mapping[str, spaces.Shape], name: str) -> jax.Array:
    """Vector (..., D) of a name, as it is predicted from the carry of one instance or of several.

    Args:
        params: of the agent.
        carry: of `policy_step`.
        obs_shape: shapes of all that is observed in training, targets of the decoder among them.
        name: of the vector.
    """
    parts = [jnp.atleast_2d(carry[part]) for part in ("deter", "stoch")]  # of rows: a runtime's fastest product
    found = sensors.decode_vector(params["dec"], jnp.concatenate(parts, -1))[..., spaces.place_of(obs_shape, name)]
    return dist.symexp(found).reshape(*carry["deter"].shape[:-1], -1)


def policy_carry(config: DreamerConfig, action_dim: ActionSpec) -> Carry:
    """Zero carry of `policy_step`."""
    sizes = {"deter": config.deter, "stoch": config.stoch_size, "action": spaces.actions(action_dim).width}
    return {name: jnp.zeros((width,), jnp.float32) for name, width in sizes.items()}


def loss(
    config: DreamerConfig, params: Params, agent: AgentState, batch: Batch, key: jax.Array
) -> tuple[jax.Array, tuple[Latent, ReturnNorm, dict[str, jax.Array]]]:
    """Joint loss () of world model, policy and critic; with posterior states, percentiles and metrics."""
    model_key, imagine_key = jax.random.split(key)
    losses, latent, model_metrics = world_model.loss(config, params, batch, model_key)
    outcome = behavior.Outcome(batch.reward, batch.is_last, batch.is_terminal)
    latest, tail = jax.tree.map(lambda x: x[-config.start_steps :], (latent, outcome))
    behavior_losses, returns, norm, metrics = behavior.imagination_loss(
        config, params, agent.slow_value, agent.return_norm, latest, imagine_key
    )
    losses.update(behavior_losses)
    start_return = returns.reshape(tail.reward.shape)
    losses["replay_value"] = config.replay_value_scale * behavior.replay_loss(
        config, params, agent.slow_value, latest, tail, start_return
    )
    means = {name: jnp.mean(value) for name, value in losses.items()}
    total = sum(means.values(), jnp.zeros(()))
    metrics = {**metrics, **model_metrics, "loss": total, **{f"loss_{name}": value for name, value in means.items()}}
    return total, (latent, norm, metrics)


def update(
    config: DreamerConfig, agent: AgentState, batch: Batch, key: jax.Array
) -> tuple[AgentState, Latent, dict[str, jax.Array]]:
    """One gradient step.

    Returns:
        The agent, the refreshed posterior states (T, B, ...) for the replay, and metrics of scalars.
    """
    objective = partial(loss, config, agent=agent, batch=batch, key=key)
    gradients, (latent, norm, metrics) = jax.grad(lambda params: objective(params=params), has_aux=True)(agent.params)
    gradients, metrics = parallel.mean((gradients, metrics))
    params, opt = optim.update(config, agent.params, gradients, agent.opt)
    slow_value = _follow(agent.slow_value, params["value"], config.slow_rate)
    average = None if agent.average is None else _follow(agent.average, params, config.average_rate)
    metrics["gradient_norm"] = optim.global_norm(gradients)
    return AgentState(params, slow_value, opt, norm, average), jax.lax.stop_gradient(latent), metrics


def update_model(
    config: DreamerConfig, agent: AgentState, batch: Batch, key: jax.Array
) -> tuple[AgentState, Latent, dict[str, jax.Array]]:
    """One gradient step of the world model alone: policy, critic and return percentiles stay as they are.

    Returns:
        As `update`.
    """
    model = _model_of(agent.params)

    def objective(params: Params) -> tuple[jax.Array, tuple[Latent, dict[str, jax.Array]]]:
        losses, latent, metrics = world_model.loss(config, params, batch, key)
        means = {name: jnp.mean(value) for name, value in losses.items()}
        total = sum(means.values(), jnp.zeros(()))
        return total, (latent, {**metrics, "loss": total, **{f"loss_{name}": x for name, x in means.items()}})

    gradients, (latent, metrics) = jax.grad(objective, has_aux=True)(model)
    gradients, metrics = parallel.mean((gradients, metrics))
    mine = optim.OptState(_model_of(agent.opt.mu), _model_of(agent.opt.nu), agent.opt.count)
    model, mine = optim.update(config, model, gradients, mine)
    opt = optim.OptState({**agent.opt.mu, **mine.mu}, {**agent.opt.nu, **mine.nu}, mine.count)
    metrics["gradient_norm"] = optim.global_norm(gradients)
    agent = dataclasses.replace(agent, params={**agent.params, **model}, opt=opt)
    return agent, jax.lax.stop_gradient(latent), metrics


def restart(agent: AgentState) -> AgentState:
    """The agent with a new optimiser and average.

    Bias corrections and warm-up hang on the count of updates. Policy and critic have had none in pretraining, so that a
    count which goes on would make their first steps many times too large.
    """
    average = None if agent.average is None else agent.params
    return dataclasses.replace(agent, opt=optim.init(agent.params), average=average)


def _model_of(params: Params) -> Params:
    return {name: params[name] for name in world_model.PARTS}


def _follow(slow: Params, fast: Params, rate: float) -> Params:
    return jax.tree.map(lambda a, b: a + rate * (b - a), slow, fast)
