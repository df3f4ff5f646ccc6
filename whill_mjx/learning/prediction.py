"""What the world model of a training foretells of drives, as a moving picture beside what the camera saw."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from dreamer import video
from dreamer.types import Params
from whill_mjx.learning.setup import Preset, functional_env, make_evaluation_env

SEEN, FORETOLD = 5, 40  # control periods that are shown to the model, and that are not


def write_prediction(
    path: Path, preset: Preset, vehicle: Path, params: Params, drives: int, key: jax.Array
) -> Path:
    """Some drives as the camera sees them, above what the world model foretells from their first half second and later
    actions alone, above the difference.

    Args:
        path: of the GIF.
        preset: task and learner.
        vehicle: its file.
        params: of an agent with a decoder.
        drives: how many, side by side.
        key: consumed.
    """
    periods = preset.task.action_repeat
    context, steps = max(2, SEEN // periods), max(8, (SEEN + FORETOLD) // periods)
    seen_in = make_evaluation_env(preset.task, vehicle, drives, preset.looks)
    env = functional_env(seen_in, preset.safety, shaped=False)

    @jax.jit
    def foretell(params: Params, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = video.play(env, preset.learner, params, key, steps)
        return seen["obs"], video.predict(preset.learner, params, seen, context, key)

    truth, foretold = foretell(params, key)
    pictures = video.frames(np.asarray(truth), np.asarray(foretold), context)
    return video.write(path, pictures, rate_hz=10.0 / periods)
