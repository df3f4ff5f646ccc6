"""The agent: all parameters, acting, and one update."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct

from dreamer import behavior, image, optim, rssm, world_model
from dreamer.behavior import ReturnNorm
from dreamer.config import DreamerConfig
from dreamer.replay import Batch
from dreamer.rssm import Latent
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

    @property
    def updates(self) -> jax.Array:
        """() int32 updates done."""
        return self.opt.count


def init_params(config: DreamerConfig, obs_shape: tuple[int, int, int], action_dim: int, key: jax.Array) -> Params:
    """Parameters of world model, policy and critic."""
    world_key, policy_key, value_key = jax.random.split(key, 3)
    return {
        **world_model.init(config, obs_shape, action_dim, world_key),
        "policy": behavior.init_actor(config, action_dim, policy_key),
        "value": behavior.init_critic(config, value_key),
    }


def init_agent(config: DreamerConfig, obs_shape: tuple[int, int, int], action_dim: int, key: jax.Array) -> AgentState:
    """A new agent.

    Args:
        config: hyperparameters.
        obs_shape: (H, W, C).
        action_dim: A.
        key: consumed.
    """
    params = init_params(config, obs_shape, action_dim, key)
    zero = jnp.zeros((), jnp.float32)
    slow_value = jax.tree.map(jnp.copy, params["value"])  # its own memory: both are donated
    return AgentState(params, slow_value, optim.init(params), ReturnNorm(zero, jnp.copy(zero)))


def init_carry(config: DreamerConfig, batch: int, action_dim: int) -> Carry:
    """Recurrent state of `batch` instances: all zeros mean the start of an episode."""
    latent = rssm.initial(config, batch)
    return {"deter": latent.deter, "stoch": latent.stoch, "action": jnp.zeros((batch, action_dim), jnp.float32)}


def act(
    config: DreamerConfig,
    params: Params,
    carry: Carry,
    obs: jax.Array,
    is_first: jax.Array,
    key: jax.Array | None,
    mode: bool = False,
) -> tuple[Carry, jax.Array]:
    """Infer the state of N instances from their frames and choose actions.

    Args:
        config: sizes.
        params: of the agent.
        carry: from `init_carry` or the previous call.
        obs: (N, H, W, C) uint8.
        is_first: (N,) bool, resets the carry.
        key: consumed; may be None in mode.
        mode: take the most probable latent and the mean action, as on the vehicle.

    Returns:
        The carry, whose latent is the state after this frame, and actions (N, A), not clipped.
    """
    keep = {name: jnp.where(is_first[:, None], jnp.zeros_like(value), value) for name, value in carry.items()}
    tokens = image.encode(config, params["enc"], obs)
    uniform = None
    if not mode:
        assert key is not None
        latent_key, action_key = jax.random.split(key)
        uniform = jax.random.uniform(latent_key, (obs.shape[0], config.stoch))
    previous = Latent(keep["deter"], keep["stoch"])
    latent = rssm.observe_step(config, params["dyn"], previous, keep["action"], tokens, uniform)
    action, std = behavior.policy(config, params["policy"], latent.features())
    if not mode:
        action = action + std * jax.random.normal(action_key, action.shape)
    return {"deter": latent.deter, "stoch": latent.stoch, "action": action}, action


def policy_step(config: DreamerConfig, params: Params, carry: Carry, image: jax.Array) -> tuple[Carry, jax.Array]:
    """One control step of ONE instance in float32, deterministic: the function that runs on the vehicle.

    Args:
        config: sizes; the compute type is ignored.
        params: of the agent.
        carry: deter (D,), stoch (S * C,), action (A,) float32; zeros start an episode.
        image: (H, W, C) uint8.

    Returns:
        The new carry and the action (A,) in [-1, 1].
    """
    config = dataclasses.replace(config, compute_dtype="float32")
    batched = {name: value[None].astype(jnp.float32) for name, value in carry.items()}
    new_carry, action = act(config, params, batched, image[None], jnp.zeros((1,), bool), None, mode=True)
    return {name: value[0] for name, value in new_carry.items()}, action[0]


def policy_carry(config: DreamerConfig, action_dim: int) -> Carry:
    """Zero carry of `policy_step`."""
    sizes = {"deter": config.deter, "stoch": config.stoch_size, "action": action_dim}
    return {name: jnp.zeros((width,), jnp.float32) for name, width in sizes.items()}


def loss(
    config: DreamerConfig, params: Params, agent: AgentState, batch: Batch, key: jax.Array
) -> tuple[jax.Array, tuple[Latent, ReturnNorm, dict[str, jax.Array]]]:
    """Joint loss () of world model, policy and critic; with posterior states, percentiles and metrics."""
    model_key, imagine_key = jax.random.split(key)
    losses, latent, model_metrics = world_model.loss(config, params, batch, model_key)
    outcome = (batch.reward, batch.is_last, batch.is_terminal)
    latest, tail = jax.tree.map(lambda x: x[-config.start_steps :], (latent, outcome))
    start = Latent(latest.deter.reshape(-1, config.deter), latest.stoch.reshape(-1, config.stoch_size))
    behavior_losses, returns, norm, metrics = behavior.imagination_loss(
        config, params, agent.slow_value, agent.return_norm, start, imagine_key
    )
    losses.update(behavior_losses)
    start_return = returns.reshape(tail[0].shape)
    losses["replay_value"] = config.replay_value_scale * behavior.replay_loss(
        config, params, agent.slow_value, latest, tail[0], tail[1], tail[2], start_return
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
    params, opt = optim.update(config, agent.params, gradients, agent.opt)
    slow_value = jax.tree.map(
        lambda slow, fast: slow + config.slow_rate * (fast - slow), agent.slow_value, params["value"]
    )
    metrics["gradient_norm"] = optim.global_norm(gradients)
    return AgentState(params, slow_value, opt, norm), jax.lax.stop_gradient(latent), metrics
