"""Symexp two-hot scalars, categoricals with a uniform share, and the bounded normal policy. All in float32."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from dreamer.layers.recurrence import keep


def symlog(x: jax.Array) -> jax.Array:
    """sign(x) * log(1 + |x|)."""
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: jax.Array) -> jax.Array:
    """sign(x) * (exp(|x|) - 1), the inverse of `symlog`."""
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def twohot_bins(bins: int) -> np.ndarray:
    """(bins,) values, symexp-spaced from -symexp(20) to symexp(20), mirrored so that the middle is exactly 0."""
    grid = np.linspace(-20.0, 0.0, bins // 2 + 1, dtype=np.float32)
    half = -np.expm1(-grid)
    half[-1] = 0.0
    return np.concatenate([half, -half[:-1][::-1]]).astype(np.float32)


def twohot_mean(logits: jax.Array) -> jax.Array:
    """Expected value (...) of two-hot logits (..., bins).

    The two sides are added pairwise: equal probabilities cancel exactly, although the outer bins are near 5e8.
    """
    probs = jax.nn.softmax(logits.astype(jnp.float32), -1)
    middle = logits.shape[-1] // 2
    positive = twohot_bins(logits.shape[-1])[middle + 1 :]
    return jnp.sum((probs[..., middle + 1 :] - probs[..., :middle][..., ::-1]) * positive, -1)


def twohot(value: jax.Array, bins: int) -> jax.Array:
    """Weights (..., bins) of the two bins around value (...), linear in the raw value."""
    grid = jnp.asarray(twohot_bins(bins))
    value = jnp.clip(value.astype(jnp.float32), grid[0], grid[-1])[..., None]
    # The upper bin of interval i gets weight (v - g_i) / (g_{i+1} - g_i), the lower one the rest.
    width = jnp.diff(grid)
    rise = jnp.clip((value - grid[:-1]) / width, 0.0, 1.0)  # (..., bins - 1), 1 for all intervals below value
    one, zero = jnp.ones_like(rise[..., :1]), jnp.zeros_like(rise[..., :1])
    return jnp.concatenate([one, rise], -1) - jnp.concatenate([rise, zero], -1)


def cross_entropy(logits: jax.Array, target: jax.Array) -> jax.Array:
    """-sum target * log softmax(logits) over the last axis: (..., bins) x2 -> (...)."""
    return -jnp.sum(target * jax.nn.log_softmax(logits.astype(jnp.float32), -1), -1)


def bernoulli_loss(logit: jax.Array, target: jax.Array) -> jax.Array:
    """Cross-entropy (...) of logit (...) to a soft target in [0, 1]."""
    logit = logit.astype(jnp.float32)
    return -(target * jax.nn.log_sigmoid(logit) + (1.0 - target) * jax.nn.log_sigmoid(-logit))


def unimix_probs(logits: jax.Array, unimix: float) -> jax.Array:
    """Probabilities (..., S, C) of logits (..., S, C) with a uniform share mixed in."""
    probs = keep(jax.nn.softmax(logits.astype(jnp.float32), -1))
    return (1.0 - unimix) * probs + unimix / logits.shape[-1]


def sample_index(probs: jax.Array, uniform: jax.Array) -> jax.Array:
    """Draw class indices (..., S) int32 by inverting the cumulative sum.

    One uniform number per latent instead of one Gumbel number per class: random numbers are dear on a CPU.

    Args:
        probs: (..., S, C).
        uniform: (..., S) in [0, 1).
    """
    cumulative = jnp.cumsum(probs[..., :-1], -1)
    return jnp.sum((uniform[..., None] >= cumulative).astype(jnp.int32), -1)


def one_hot(index: jax.Array, classes: int) -> jax.Array:
    """(...) int -> (..., classes) float32."""
    return (index[..., None] == jnp.arange(classes)).astype(jnp.float32)


def straight_through(probs: jax.Array, index: jax.Array) -> jax.Array:
    """One-hot (..., S, C) in the forward pass, gradient of probs (..., S, C) in the backward pass."""
    return one_hot(index, probs.shape[-1]) + (probs - jax.lax.stop_gradient(probs))


def categorical_kl(p: jax.Array, q: jax.Array) -> jax.Array:
    """KL(p || q) [nat], summed over the S latents: (..., S, C) probabilities -> (...)."""
    return jnp.sum(p * (jnp.log(p) - jnp.log(q)), (-2, -1))


def bounded_normal(mean: jax.Array, std: jax.Array, low: float, high: float) -> tuple[jax.Array, jax.Array]:
    """Mean tanh(.) and standard deviation in [low, high] from raw outputs (..., A)."""
    mean, std = mean.astype(jnp.float32), std.astype(jnp.float32)
    return jnp.tanh(mean), (high - low) * jax.nn.sigmoid(std + 2.0) + low


def normal_log_prob(mean: jax.Array, std: jax.Array, sample: jax.Array) -> jax.Array:
    """Log density (...) of a sample (..., A) of independent normals; the sample is neither squashed nor clipped."""
    return jnp.sum(-0.5 * jnp.square((sample - mean) / std) - jnp.log(std) - 0.5 * np.log(2.0 * np.pi), -1)


def normal_entropy(std: jax.Array) -> jax.Array:
    """Entropy (...) [nat] of independent normals (..., A)."""
    return jnp.sum(jnp.log(std) + 0.5 * np.log(2.0 * np.pi * np.e), -1)
