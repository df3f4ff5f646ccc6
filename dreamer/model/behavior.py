"""Actor and critic: imagined rollouts, lambda-returns and their losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.layers import distributions as dist
from dreamer.model import rssm, world_model
from dreamer.model.rssm import Latent
from dreamer.training import parallel
from dreamer.types import Params


@struct.dataclass
class ReturnNorm:
    """Running 5th and 95th percentile of the imagined returns."""

    low: jax.Array
    """() running low percentile, from 0 and without bias correction, as in the source."""
    high: jax.Array
    """() running high percentile."""

    def scale(self) -> jax.Array:
        """() divisor of the advantage, at least 1: small returns are not blown up to noise."""
        return jnp.maximum(1.0, self.high - self.low)


@dataclass(frozen=True)
class Imagined:
    """A rollout of H actions from M starts; index t is the state in which action t is taken."""

    features: jax.Array
    """(H + 1, M, F), the start included."""
    actions: jax.Array
    """(H + 1, M, A) raw samples or one-hot classes; the last one has no outcome."""


def init_actor(config: DreamerConfig, outputs: int, key: jax.Array) -> Params:
    """Parameters of the policy: an MLP with this many outputs, which `spaces` turns into actions."""
    features = config.deter + config.stoch_size
    return world_model.init_head(config, key, features, config.policy_layers, outputs, config.policy_outscale)


def init_critic(config: DreamerConfig, key: jax.Array) -> Params:
    """Parameters of the critic; its output is exactly 0 at the start."""
    features = config.deter + config.stoch_size
    return world_model.init_head(config, key, features, config.value_layers, config.bins, outscale=0.0)


def lambda_return(
    reward: jax.Array,
    live: jax.Array,
    mix: jax.Array,
    bootstrap: jax.Array,
    unroll: int = 1,
) -> jax.Array:
    """Returns R_t = r_{t+1} + live_{t+1} * ((1 - mix_{t+1}) * V_{t+1} + mix_{t+1} * R_{t+1}), with R_T = V_T.

    Args:
        reward: (T + 1, ...) earned on the way into each state.
        live: (T + 1, ...) discount times the probability that the task goes on in each state.
        mix: (T + 1, ...) lambda, or 0 where a sequence is cut.
        bootstrap: (T + 1, ...) values V.
        unroll: steps per loop body.

    Returns:
        (T, ...): the return of states 0 to T - 1.
    """
    intermediate = reward[1:] + live[1:] * (1.0 - mix[1:]) * bootstrap[1:]

    def back(future: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        value = x[0] + x[1] * future
        return value, value

    _, returns = jax.lax.scan(back, bootstrap[-1], (intermediate, live[1:] * mix[1:]), reverse=True, unroll=unroll)
    return returns


def imagine(config: DreamerConfig, params: Params, start: Latent, key: jax.Array) -> Imagined:
    """Roll the policy out in the model for `imag_horizon` steps. No gradient is wanted through it.

    Args:
        config: sizes.
        params: of the whole agent.
        start: states with any leading axes, which become the M rows; the last of them may be split over devices.
        key: consumed.
    """
    lead, steps = start.deter.shape[:-1], config.imag_horizon
    start = Latent(start.deter.reshape(-1, config.deter), start.stoch.reshape(-1, config.stoch_size))
    rows = start.deter.shape[0]
    actions = spaces.actions_of(params)
    latent_key, action_key = jax.random.split(key)
    uniform = parallel.own_rows(lambda rows: jax.random.uniform(latent_key, (steps, rows, config.stoch)), lead)
    draws = parallel.own_rows(lambda rows: actions.noise(action_key, (steps + 1, rows)), lead)
    params = jax.tree.map(lambda p: p.astype(config.dtype) if p.ndim >= 2 else p, params)  # once, not in every step

    def act(latent: Latent, noise: jax.Array) -> jax.Array:
        return actions.sample(config, world_model.head(params["policy"], latent.features()), noise)

    def advance(latent: Latent, noise: tuple[jax.Array, jax.Array]) -> tuple[Latent, tuple[jax.Array, jax.Array]]:
        action = act(latent, noise[1])
        deter = rssm.core(config, params["dyn"], latent, action)
        index = dist.sample_index(rssm.prior_probs(config, params["dyn"], deter), noise[0])
        stoch = dist.one_hot(index, config.classes).reshape(rows, -1).astype(deter.dtype)
        return Latent(deter, stoch), (latent.features(), action)

    unroll = min(config.scan_unroll, steps)
    last, (features, taken) = jax.lax.scan(advance, start, (uniform, draws[:-1]), unroll=unroll)
    return Imagined(
        jnp.concatenate([features, last.features()[None]]), jnp.concatenate([taken, act(last, draws[-1])[None]])
    )


def update_return_norm(config: DreamerConfig, norm: ReturnNorm, returns: jax.Array) -> ReturnNorm:
    """Move the running percentiles towards those of returns (H, M)."""
    low, high = jnp.quantile(parallel.gather(returns, 1), jnp.array(config.return_percentiles))
    rate = config.return_norm_rate
    return ReturnNorm(norm.low + rate * (low - norm.low), norm.high + rate * (high - norm.high))


def actor_loss(
    config: DreamerConfig, log_prob: jax.Array, entropy: jax.Array, advantage: jax.Array, weight: jax.Array
) -> jax.Array:
    """REINFORCE loss (H, M): -weight * (log pi(a_t | s_t) * advantage_t + entropy_scale * entropy).

    Args:
        config: entropy scale.
        log_prob: (H, M) of the action taken in state t.
        entropy: (H, M) of the policy there.
        advantage: (H, M) of the action taken in state t.
        weight: (H, M) probability that state t is reached alive.
    """
    stop = jax.lax.stop_gradient
    gain = log_prob * stop(advantage) + config.entropy_scale * entropy
    return -stop(weight) * gain


def critic_loss(
    config: DreamerConfig, logits: jax.Array, slow_logits: jax.Array, returns: jax.Array, weight: jax.Array
) -> jax.Array:
    """Cross-entropy (T, ...) to the returns (T, ...) and, as a brake, to the slow critic's prediction, times weight."""
    target = dist.twohot(returns, config.bins)
    target += config.slow_reg * dist.twohot(dist.twohot_mean(slow_logits), config.bins)
    return jax.lax.stop_gradient(weight) * dist.cross_entropy(logits, jax.lax.stop_gradient(target))


def imagination_loss(
    config: DreamerConfig,
    params: Params,
    slow: Params,
    norm: ReturnNorm,
    start: Latent,
    key: jax.Array,
) -> tuple[dict[str, jax.Array], jax.Array, ReturnNorm, dict[str, jax.Array]]:
    """Losses of actor and critic on imagined rollouts.

    Starts and rollouts carry no gradient, so the losses reach policy and critic only.

    Args:
        config: all numbers.
        params: of the whole agent.
        slow: slow critic.
        norm: running percentiles of the returns.
        start: states with any leading axes, M altogether, as `imagine` takes them.
        key: consumed.

    Returns:
        Losses (H, M) by name, returns (M,) of the starts, new percentiles, metrics.
    """
    stop = jax.lax.stop_gradient
    rollout = stop_rollout(imagine(config, stop(params), stop(start), key))
    features = rollout.features
    reward = world_model.predict_reward(stop(params), features)
    alive = world_model.predict_continue(stop(params), features)  # holds the discount already
    logits = world_model.head(params["value"], features)
    value = stop(dist.twohot_mean(logits))
    returns = lambda_return(
        reward, alive, jnp.full_like(alive, config.return_lambda), value, min(config.scan_unroll, config.imag_horizon)
    )
    # The source divides the product by the first factor's discount (1 here): the root's own continue is included.
    weight = jnp.cumprod(alive, 0)
    norm = update_return_norm(config, norm, returns)
    advantage = (returns - value[:-1]) / norm.scale()
    actions, raw = spaces.actions_of(params), world_model.head(params["policy"], features[:-1])
    log_prob, entropy = actions.score(config, raw, rollout.actions[:-1])
    slow_logits = world_model.head(slow, features[:-1])
    pull = config.mean_pull * stop(weight[:-1]) * actions.saturation(raw) if config.mean_pull else 0.0
    losses = {
        "policy": actor_loss(config, log_prob, entropy, advantage, weight[:-1]) + pull,
        "value": critic_loss(config, logits[:-1], slow_logits, returns, weight[:-1]),
    }
    metrics = {
        **actions.watch(config, raw),
        "policy_entropy": jnp.mean(entropy),
        "imagined_return": jnp.mean(returns),
        "imagined_reward": jnp.mean(reward[1:]),
        "imagined_value": jnp.mean(value),
        "return_scale": norm.scale(),
        "advantage_abs": jnp.mean(jnp.abs(advantage)),
    }
    return losses, returns[0], norm, metrics


def stop_rollout(rollout: Imagined) -> Imagined:
    """The rollout without gradients."""
    return Imagined(jax.lax.stop_gradient(rollout.features), jax.lax.stop_gradient(rollout.actions))


class Outcome(NamedTuple):
    """What replayed steps came to, (T, B) each."""

    reward: jax.Array
    is_last: jax.Array
    """Cuts the mixing of returns: what follows belongs to another episode."""
    is_terminal: jax.Array
    """Ends the value."""


def replay_loss(
    config: DreamerConfig, params: Params, slow: Params, latent: Latent, outcome: Outcome, start_return: jax.Array
) -> jax.Array:
    """Critic loss (T - 1, B) along the replayed sequence; its gradient reaches the world model.

    Real rewards and terminals, bootstrapped in every state with the return imagined from there.

    Args:
        config: all numbers.
        params: of the whole agent.
        slow: slow critic.
        latent: posterior states (T, B, ...).
        outcome: of the same steps.
        start_return: (T, B) imagined returns.
    """
    features = latent.features()
    last = outcome.is_last.astype(jnp.float32)
    live = config.discount * (1.0 - outcome.is_terminal.astype(jnp.float32))
    returns = lambda_return(
        outcome.reward, live, config.return_lambda * (1.0 - last), start_return, min(config.scan_unroll, last.shape[0])
    )
    logits = world_model.head(params["value"], features)[:-1]
    slow_logits = world_model.head(slow, jax.lax.stop_gradient(features))[:-1]
    return critic_loss(config, logits, slow_logits, returns, 1.0 - last[:-1])
