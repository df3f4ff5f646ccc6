"""Open-loop predictions of the world model beside the truth: what it has understood, as a moving picture."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer import spaces
from dreamer.config import DreamerConfig
from dreamer.layers import distributions as dist
from dreamer.layers import image, sensors
from dreamer.model import agent, rssm
from dreamer.model.rssm import Latent
from dreamer.types import FunctionalEnv, Params


def play(env: FunctionalEnv, config: DreamerConfig, params: Params, key: jax.Array, steps: int) -> dict[str, Any]:
    """What the instances see and do: obs (T, N, ...), prev_action (T, N, A), is_first (T, N), from the first frame."""
    reset_key, run_key = jax.random.split(key)
    state, transition = env.begin(reset_key)
    carry, actions = agent.init_carry(config, env.num_envs, env.action_dim), spaces.actions(env.action_dim)

    def one(loop: tuple, step_key: jax.Array) -> tuple[tuple, dict[str, Any]]:
        state, transition, carry = loop
        seen = {"obs": transition.obs, "prev_action": carry["action"], "is_first": transition.is_first}
        choice = agent.Choice(step_key)
        carry, action = agent.act(config, params, carry, transition.obs, transition.is_first, choice)
        state, transition = env.advance(state, actions.to_env(action))
        return (state, transition, carry), seen

    return jax.lax.scan(one, (state, transition, carry), jax.random.split(run_key, steps))[1]


def predict(config: DreamerConfig, params: Params, seen: dict[str, Any], context: int, key: jax.Array) -> jax.Array:
    """Images (T, N, H, W, C) in [0, 1]: decoded from what is seen up to step `context`, and imagined from there on.

    Only the actions of the later steps are given to the model, none of their frames.

    Args:
        config: sizes.
        params: of the agent, with a decoder.
        seen: from `play`; the episodes should not end within it.
        context: steps that are seen.
        key: consumed.

    Raises:
        ValueError: no images, or no decoder for them.
    """
    pixels = spaces.image_of(seen["obs"])
    if pixels is None or config.representation != "reconstruct":
        raise ValueError("nothing to show: the agent has no images, or representation is not 'reconstruct'. Train one.")
    steps, rows = pixels.shape[:2]
    observe_key, imagine_key = jax.random.split(key)
    tokens = sensors.encode(config, params["enc"], jax.tree.map(lambda x: x[:context], seen["obs"]))
    uniform = jax.random.uniform(observe_key, (context, rows, config.stoch))
    steps_seen = rssm.Sequences(seen["prev_action"][:context], tokens, seen["is_first"][:context], uniform)
    known, _ = rssm.observe(config, params["dyn"], rssm.initial(config, rows), steps_seen)

    def one(latent: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, Latent]:
        deter = rssm.core(config, params["dyn"], latent, x[0])
        index = dist.sample_index(rssm.prior_probs(config, params["dyn"], deter), x[1])
        stoch = dist.one_hot(index, config.classes).reshape(rows, -1).astype(deter.dtype)
        return (latent := Latent(deter, stoch)), latent

    draws = jax.random.uniform(imagine_key, (steps - context, rows, config.stoch))
    last = jax.tree.map(lambda x: x[-1], known)
    _, imagined = jax.lax.scan(one, last, (seen["prev_action"][context:], draws))
    latent = jax.tree.map(lambda a, b: jnp.concatenate([a, b]).reshape(steps * rows, -1), known, imagined)
    shape = (pixels.shape[2], pixels.shape[3], pixels.shape[4])
    return image.decode(config, params["dec"], latent.deter, latent.stoch, shape).reshape(pixels.shape)


def frames(truth: np.ndarray, predicted: np.ndarray, context: int) -> np.ndarray:
    """Pictures (T, 3 H, N W, 3) uint8: truth above prediction above their difference; a green edge while it is seen.

    Args:
        truth: (T, N, H, W, C) uint8; the first three channels are shown, or the only one.
        predicted: (T, N, H, W, C) in [0, 1].
        context: steps that were seen.
    """
    true = np.asarray(truth)[..., :3] / 255.0
    guess = np.clip(np.asarray(predicted)[..., :3], 0.0, 1.0)
    edged = guess.copy()
    colour = np.where(np.arange(len(guess)) < context, 1, 0)[:, None, None, None] * np.array([0.0, 1.0, 0.0])
    if edged.shape[-1] == 3:
        edged[..., :1, :, :] = colour[:, :, None]
    rows = np.concatenate([true, edged, np.abs(true - guess)], 2)  # (T, N, 3 H, W, C)
    wide = np.concatenate(list(np.moveaxis(rows, 1, 0)), 2)
    return np.round(255 * np.broadcast_to(wide, (*wide.shape[:-1], 3))).astype(np.uint8)


def write(path: str | Path, pictures: np.ndarray, scale: int = 2, rate_hz: float = 10.0) -> Path:
    """Write pictures (T, H, W, 3) uint8 as a GIF, or every eighth of them side by side as a PNG, by the suffix.

    Raises:
        ValueError: another suffix.
    """
    from PIL import Image

    path = Path(path)
    if path.suffix not in (".gif", ".png"):
        raise ValueError(f"{path}: the suffix must be .gif or .png. Rename it.")
    large = np.repeat(np.repeat(pictures, scale, 1), scale, 2)
    temporary = path.with_name(f".{path.name}.tmp")
    if path.suffix == ".png":
        Image.fromarray(np.concatenate(list(large[::8]), 1)).save(temporary, "PNG")
    else:
        first, *rest = [Image.fromarray(one) for one in large]
        first.save(temporary, "GIF", save_all=True, append_images=rest, duration=int(1000 / rate_hz), loop=0)
    os.replace(temporary, path)
    return path
