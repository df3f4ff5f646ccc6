"""Proximal policy optimisation from pixels: the model-free baseline, one compiled iteration.

Schulman et al. 2017 (arXiv 1707.06347) with generalised advantages; the network is that of Mnih et al. 2015 on the last
few frames. An environment that resets in the step after the end (see batch.py) ignores one action per episode: that
step is left out of the loss, and a truncated episode bootstraps from its own last frame.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct

from dreamer import spaces
from whill_mjx.io.fields import Field, check_fields

PPO = (
    *(Field(name, kind="whole", low=1, high=10**6) for name in ("width", "rollout", "epochs", "minibatches")),
    *(Field(name, kind="whole", low=1, high=1000) for name in ("stack", "readings")),
    Field("scan", kind="whole", low=0, high=10**6),
    Field("channels", kind="wholes", low=1, high=10**6, count=3),
    Field("lr", low=1e-12, high=1.0),
    *(Field(name, low=1e-9, high=1e6) for name in ("clip", "max_grad_norm")),
    *(Field(name, low=0.0, high=1.0) for name in ("discount", "gae_lambda")),
    *(Field(name, low=0.0, high=1e6) for name in ("value_scale", "entropy_scale")),
    Field("log_std", low=-20.0, high=5.0),
)
"""Fields of PpoConfig."""


@dataclass(frozen=True)
class PpoConfig:
    """All numbers of the learner."""

    stack: int = 3
    """Frames that the network sees, the newest last."""
    readings: int = 1
    """Readings of the vectors that it sees, the newest last. From one scan nobody knows who walks where."""
    scan: int = 0
    """Numbers from which a vector counts as a scan, which the network sees through convolutions over its rays; 0: none
    does. Scans must have one length, since their readings are the channels."""
    width: int = 256
    """Units of the layer after the convolutions."""
    channels: tuple[int, int, int] = (32, 64, 64)
    """Channels of the three convolutions (8x8 by 4, 4x4 by 2, 3x3 by 1)."""
    rollout: int = 64
    """Steps of each instance between two updates."""
    epochs: int = 4
    """Passes over each rollout."""
    minibatches: int = 8
    """Parts of a pass; they must divide rollout times instances."""
    lr: float = 3e-4
    """Learning rate at the start; it falls linearly to zero over the run."""
    discount: float = 0.99
    """Per decision."""
    gae_lambda: float = 0.95
    """Lambda of the advantages."""
    clip: float = 0.2
    """Largest change of an action's probability that still earns."""
    value_scale: float = 0.5
    """Weight of the critic's loss."""
    entropy_scale: float = 1e-3
    """Weight of the entropy."""
    max_grad_norm: float = 0.5
    """Gradients are clipped by their global norm to this."""
    log_std: float = -0.5
    """Logarithm of the actions' standard deviation at the start."""

    def __post_init__(self) -> None:
        check_fields("PpoConfig", PPO, self)


class Network(nn.Module):
    """Mean of the action, and value, of stacked frames (..., H, W, C * stack) uint8.

    Where an environment shows vectors too, or only them, the input is a dict of "frames", "scan" (..., R, readings) and
    "vector" (..., D * readings), each of which may be absent; scans and vectors are squeezed by symlog.
    """

    config: PpoConfig
    actions: int

    @nn.compact
    def __call__(self, frames: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        orthogonal = nn.initializers.orthogonal
        if not isinstance(frames, Mapping):
            return self._heads(self._see(frames))
        parts = [self._see(frames["frames"])] if "frames" in frames else []
        if "scan" in frames:
            parts.append(self._feel(frames["scan"]))
        if "vector" in frames:
            vector = symlog(frames["vector"])
            parts.append(nn.tanh(nn.Dense(self.config.width, kernel_init=orthogonal(2**0.5))(vector)))
        return self._heads(jnp.concatenate(parts, -1))

    def _see(self, frames: jax.Array) -> jax.Array:
        orthogonal = nn.initializers.orthogonal
        x = frames.astype(jnp.float32) / 255.0 - 0.5
        for channels, kernel, stride in zip(self.config.channels, (8, 4, 3), (4, 2, 1), strict=True):
            convolution = nn.Conv(channels, (kernel, kernel), (stride, stride), kernel_init=orthogonal(2**0.5))
            x = nn.relu(convolution(x))
        return x.reshape((*x.shape[:-3], -1))

    def _feel(self, scan: jax.Array) -> jax.Array:
        """(..., D) features of scans (..., R, readings), by convolutions that see a row of an image one pixel high."""
        x = symlog(scan)[..., None, :, :]
        for channels, kernel in zip(self.config.channels, (7, 5, 3), strict=True):
            x = nn.relu(nn.Conv(channels, (1, kernel), (1, 2), kernel_init=nn.initializers.orthogonal(2**0.5))(x))
        return x.reshape((*x.shape[:-3], -1))

    def _heads(self, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        orthogonal = nn.initializers.orthogonal
        x = nn.relu(nn.Dense(self.config.width, kernel_init=orthogonal(2**0.5))(x))
        mean = nn.Dense(self.actions, kernel_init=orthogonal(0.01))(x)
        value = nn.Dense(1, kernel_init=orthogonal(1.0))(x)[..., 0]
        log_std = self.param("log_std", nn.initializers.constant(self.config.log_std), (self.actions,))
        return mean, log_std, value


def symlog(x: jax.Array) -> jax.Array:
    """sign(x) log(1 + |x|): small numbers as they are, large ones squeezed."""
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def forward(config: PpoConfig, params: Any, frames: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean (..., A), log standard deviation (A,) and value (...,) for stacked frames (..., H, W, 3 * stack) uint8."""
    result: Any = Network(config, params["params"]["log_std"].shape[0]).apply(params, frames)
    return result


PRIOR = 1e-4
"""Weight of a variance of 1 beside the returns of an instance, as in Gymnasium's NormalizeReward. Without it the first
rewards, which may be the same in all instances, would be divided by nothing."""


@struct.dataclass
class ReturnScale:
    """Running variance of the discounted return, by which rewards are divided."""

    running: jax.Array  # (N,) discounted sum of the running episodes
    count: jax.Array  # ()
    mean: jax.Array  # ()
    squares: jax.Array  # () sum of squared deviations

    def std(self) -> jax.Array:
        """() standard deviation, 1 at the beginning."""
        return jnp.sqrt(self.squares / self.count + 1e-8)


@struct.dataclass
class PpoState:
    """Everything a run needs to go on."""

    params: Any
    opt: Any
    env_state: Any
    step: Any  # frames waiting for an action, as the environment gave them
    frames: Any  # (N, H, W, C * stack) uint8, or a dict of these and vectors
    scale: ReturnScale
    key: jax.Array
    updates: jax.Array  # () iterations done


@struct.dataclass
class Rollout:
    """T steps of N instances."""

    frames: Any  # (T, N, H, W, C * stack) uint8, or a dict of these and vectors
    action: jax.Array  # (T, N, A)
    log_prob: jax.Array  # (T, N)
    value: jax.Array  # (T, N)
    reward: jax.Array  # (T, N) earned by the action
    terminal: jax.Array  # (T, N) bool, of the step after it
    last: jax.Array  # (T, N) bool, alike
    used: jax.Array  # (T, N) bool: the action was not ignored by a reset


def rays_of(config: PpoConfig, obs_shape: Mapping[str, Any]) -> int:
    """Length of the vectors that count as scans; 0 where none does.

    Raises:
        ValueError: their lengths differ.
    """
    long = {name: shape[0] for name, shape in obs_shape.items() if len(shape) == 1 and 0 < config.scan <= shape[0]}
    if len(set(long.values())) > 1:
        raise ValueError(f"scan = {config.scan}: scans need one length, and {long} have several. Change the sensors.")
    return next(iter(long.values()), 0)


def parted(obs: Mapping[str, Any], rays: int) -> dict[str, jax.Array]:
    """What is there of "frames" (..., H, W, C), "scan" (..., R, K) and "vector" (..., D): all of a kind joined."""
    scans = {name: value for name, value in obs.items() if value.shape[-1] == rays and value.dtype != jnp.uint8}
    rest = {name: value for name, value in obs.items() if name not in scans}
    parts = {"frames": spaces.image_of(rest), "vector": spaces.vector_of(rest)}
    if scans:
        parts["scan"] = jnp.stack([scans[name] for name in sorted(scans)], -1)
    return {name: value for name, value in parts.items() if value is not None}


def push(frames: Any, obs: Any, first: jax.Array) -> Any:
    """Stacked frames (N, H, W, C * stack) with `obs` (N, H, W, C) as the newest; before a first frame all is black.

    Of a dict of observations each kind is stacked along its last axis. Before a first scan or vector, all are like it.
    """
    if isinstance(obs, Mapping):
        parts = parted(obs, frames["scan"].shape[-2] if "scan" in frames else 0)
        return {kind: push(frames[kind], new, first) if kind == "frames" else remember(frames[kind], new, first)
                for kind, new in parts.items()}  # fmt: skip
    kept = jnp.where(first[:, None, None, None], jnp.uint8(0), frames[..., obs.shape[-1] :])
    return jnp.concatenate([kept, obs], axis=-1)


def remember(readings: jax.Array, new: jax.Array, first: jax.Array) -> jax.Array:
    """Readings (N, ..., D * readings) with `new` (N, ..., D) as the newest; a first one stands for those before too."""
    size = new.shape[-1]
    begun = jnp.concatenate([new] * (readings.shape[-1] // size), -1)
    first = first.reshape(-1, *[1] * (new.ndim - 1))
    return jnp.where(first, begun, jnp.concatenate([readings[..., size:], new], -1))


def empty_frames(config: PpoConfig, obs_shape: Any, batch: tuple[int, ...]) -> Any:
    """What `push` begins with: black images, and scans and vectors of zeros."""
    if not isinstance(obs_shape, Mapping):
        height, width, channels = obs_shape
        return jnp.zeros((*batch, height, width, channels * config.stack), jnp.uint8)
    seen = jax.eval_shape(lambda: parted(spaces.zeros(obs_shape, batch), rays_of(config, obs_shape)))
    depth = {"frames": config.stack}
    return {kind: jnp.zeros((*one.shape[:-1], one.shape[-1] * depth.get(kind, config.readings)), one.dtype)
            for kind, one in seen.items()}  # fmt: skip


def init_state(env: Any, config: PpoConfig, seed: int | jax.Array) -> PpoState:
    """State before the first step; `env` is a vector environment (`num_envs`, `obs_shape`, `action_dim`, reset, step).

    Raises:
        ValueError: the minibatches do not divide a rollout, or scans have several lengths.
    """
    check_fit(env, config)
    env_key, net_key, key = jax.random.split(jax.random.key(seed), 3)
    env_state, step = env.reset(env_key)
    empty = empty_frames(config, env.obs_shape, (env.num_envs,))
    params = Network(config, env.action_dim).init(net_key, empty)
    return PpoState(
        params, optimiser(config, 1).init(params), env_state, step, push(empty, step.obs, step.is_first),
        first_scale(env.num_envs), key, jnp.zeros((), jnp.int32),
    )  # fmt: skip


def check_fit(env: Any, config: PpoConfig) -> None:
    """Raise ValueError where the minibatches do not divide a rollout, or scans or images have several sizes."""
    instances = env.num_envs
    spaces.image_shape(env.obs_shape)
    if isinstance(env.obs_shape, Mapping):
        rays_of(config, env.obs_shape)
    if instances * config.rollout % config.minibatches:
        raise ValueError(
            f"{instances} instances x {config.rollout} steps do not split into {config.minibatches} minibatches; "
            "choose others with --change rollout=N or --change minibatches=N."
        )


def optimiser(config: PpoConfig, total_iterations: int | jax.Array) -> optax.GradientTransformation:
    """Adam with a clipped gradient and a rate that falls to zero over the run, of any length in one program."""
    steps = jnp.maximum(total_iterations, 1) * config.epochs * config.minibatches

    def rate(count: jax.Array) -> jax.Array:
        return config.lr * (1.0 - jnp.clip(count, 0, steps) * (1.0 / steps))

    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))


def iterate(
    env: Any, config: PpoConfig, total_iterations: int | jax.Array, state: PpoState
) -> tuple[PpoState, dict[str, jax.Array]]:
    """One rollout and its updates. Compile it once with the state donated.

    Returns:
        New state; sums over the rollout (`episodes`, `episode/...` to be divided by it) and means of the losses.
    """
    state, rollout, last_value, metrics = collect(env, config, state)
    advantage, target = advantages(config, rollout, last_value)
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (rollout, advantage, target))
    transform = optimiser(config, total_iterations)
    size = advantage.size

    def minibatch(carry: tuple, index: jax.Array) -> tuple[tuple, dict[str, jax.Array]]:
        params, opt = carry
        chosen = jax.tree.map(lambda leaf: leaf[index], flat)
        gradients, figures = jax.grad(lambda p: loss(config, p, *chosen), has_aux=True)(params)
        updates, opt = transform.update(gradients, opt, params)
        return (optax.apply_updates(params, updates), opt), figures

    def epoch(carry: tuple, key: jax.Array) -> tuple[tuple, dict[str, jax.Array]]:
        order = jax.random.permutation(key, size).reshape(config.minibatches, -1)
        return jax.lax.scan(minibatch, carry, order)

    key, update_key = jax.random.split(state.key)
    epochs = jax.random.split(update_key, config.epochs)
    (params, opt), figures = jax.lax.scan(epoch, (state.params, state.opt), epochs)
    metrics |= {name: value.mean() for name, value in figures.items()}
    return dataclasses.replace(state, params=params, opt=opt, key=key, updates=state.updates + 1), metrics


def collect(
    env: Any, config: PpoConfig, state: PpoState
) -> tuple[PpoState, Rollout, jax.Array, dict[str, jax.Array]]:
    """T steps of all instances with sampled actions, the value (N,) after them, and sums over ended episodes."""
    def one(carry: tuple, key: jax.Array) -> tuple[tuple, tuple[Rollout, dict[str, jax.Array]]]:
        env_state, step, frames, scale = carry
        mean, log_std, value = forward(config, state.params, frames)
        action = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
        env_state, after = env.step(env_state, jnp.clip(action, -1.0, 1.0))
        scale = track(config, scale, after.reward, step.is_last)
        row = Rollout(
            frames, action, log_probability(action, mean, log_std), value, after.reward / scale.std(),
            after.is_terminal, after.is_last, ~step.is_last,
        )  # fmt: skip
        done = after.is_last.astype(jnp.float32)
        watched = {f"episode/{name}": jnp.sum(done * value) for name, value in after.metrics.items()}
        watched |= {"episodes": done.sum(), "reward": after.reward.mean() / config.rollout}
        return (env_state, after, push(frames, after.obs, after.is_first), scale), (row, watched)

    key, *step_keys = jax.random.split(state.key, config.rollout + 1)
    carry = (state.env_state, state.step, state.frames, state.scale)
    carry, (rollout, watched) = jax.lax.scan(one, carry, jnp.stack(step_keys))
    env_state, step, frames, scale = carry
    _, _, last_value = forward(config, state.params, frames)
    state = dataclasses.replace(state, env_state=env_state, step=step, frames=frames, scale=scale, key=key)
    return state, rollout, last_value, {name: value.sum(0) for name, value in watched.items()}


def first_scale(instances: int) -> ReturnScale:
    """The return scale before the first step."""
    weight = PRIOR * instances * jnp.ones(())
    return ReturnScale(jnp.zeros(instances), weight, jnp.zeros(()), weight)


def track(config: PpoConfig, scale: ReturnScale, reward: jax.Array, begins: jax.Array) -> ReturnScale:
    """The return scale after one step of rewards (N,); `begins` (N,) marks instances that were just reset."""
    running = jnp.where(begins, 0.0, config.discount * scale.running) + reward
    count = scale.count + running.size
    delta = running.mean() - scale.mean
    mean = scale.mean + delta * running.size / count
    within = jnp.sum((running - running.mean()) ** 2)
    squares = scale.squares + within + delta**2 * scale.count * running.size / count
    return ReturnScale(running, count, mean, squares)


def advantages(config: PpoConfig, rollout: Rollout, last_value: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Generalised advantages (T, N) and value targets (T, N).

    delta_t = r_t + discount V_{t+1} (1 - terminal_t) - V_t;  A_t = delta_t + discount lambda (1 - last_t) A_{t+1}
    """
    following = jnp.concatenate([rollout.value[1:], last_value[None]])
    delta = rollout.reward + config.discount * following * (1.0 - rollout.terminal) - rollout.value

    def back(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        here = now[0] + config.discount * config.gae_lambda * (1.0 - now[1]) * later
        return here, here

    _, advantage = jax.lax.scan(back, jnp.zeros_like(last_value), (delta, rollout.last), reverse=True)
    return advantage, advantage + rollout.value


def loss(
    config: PpoConfig, params: Any, rollout: Rollout, advantage: jax.Array, target: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped policy loss, value loss and entropy of a minibatch (M, ...); ignored actions do not count."""
    used = rollout.used.astype(jnp.float32)

    def mean_used(values: jax.Array) -> jax.Array:
        return jnp.sum(used * values) / jnp.maximum(used.sum(), 1.0)

    mean, log_std, value = forward(config, params, rollout.frames)
    centred = advantage - mean_used(advantage)
    normalised = centred / (jnp.sqrt(mean_used(centred**2)) + 1e-8)
    ratio = jnp.exp(log_probability(rollout.action, mean, log_std) - rollout.log_prob)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy = -mean_used(jnp.minimum(ratio * normalised, clipped * normalised))
    critic = 0.5 * mean_used((value - target) ** 2)
    entropy = jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
    total = policy + config.value_scale * critic - config.entropy_scale * entropy
    figures = {"loss_policy": policy, "loss_value": critic, "entropy": entropy,
               "clipped": mean_used(jnp.abs(ratio - 1.0) > config.clip)}
    return total, figures


def log_probability(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """(...,) log density of actions (..., A) under independent normal distributions."""
    return jnp.sum(-0.5 * ((action - mean) / jnp.exp(log_std)) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def policy_step(
    config: PpoConfig, params: Any, carry: dict[str, jax.Array], image: Any
) -> tuple[dict[str, jax.Array], jax.Array]:
    """One control step of ONE instance, deterministic: the function that is exported.

    Args:
        config: sizes.
        params: of the network.
        carry: frames (H, W, C * (stack - 1)) uint8, and all readings of scans and vectors, the newest last; zeros start
            an episode.
        image: (H, W, C) uint8, or a dict of images and vectors.

    Returns:
        The new carry and the action (A,) in [-1, 1].
    """
    several = isinstance(image, Mapping)
    parts = parted(image, rays_of(config, {name: one.shape for name, one in image.items()})) if several else {
        "frames": image}  # fmt: skip
    seen, after = {}, {}
    for kind, new in parts.items():
        if kind == "frames":
            seen[kind] = jnp.concatenate([carry[kind], new], axis=-1)
            after[kind] = seen[kind][..., new.shape[-1] :]
        elif config.readings == 1:
            seen[kind] = new
        else:
            seen[kind] = after[kind] = remember(carry[kind][None], new[None], carry["begun"][None] < 0.5)[0]
            after["begun"] = jnp.ones(())
    batched = {kind: value[None] for kind, value in seen.items()}
    mean, _, _ = forward(config, params, batched if several else batched["frames"])
    return after, jnp.clip(mean[0], -1.0, 1.0)


def policy_carry(config: PpoConfig, obs_shape: Any) -> dict[str, jax.Array]:
    """Zero carry of `policy_step` for what an environment shows; of single readings nothing is kept."""
    shape = obs_shape if isinstance(obs_shape, Mapping) else {"camera": obs_shape}
    kept = empty_frames(config, shape, ())
    image = spaces.image_shape(shape)
    images = {"frames": kept.pop("frames")[..., : -image[2]]} if image is not None else {}
    return {**images, **kept, "begun": jnp.zeros(())} if kept and config.readings > 1 else images
