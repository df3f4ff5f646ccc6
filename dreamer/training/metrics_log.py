"""The lines of a training: sums of iterations, metrics.jsonl, and what a watcher wants to see of them."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dreamer.config import DreamerConfig
from dreamer.experience import pretrain
from dreamer.training import parallel
from dreamer.training.board import Board

MetricsFn = Callable[[dict[str, float]], None]


class Meter:
    """Sums the metrics of iterations until they are logged."""

    def __init__(self) -> None:
        self._sums: list[dict[str, jax.Array]] = []
        self._steps = 0
        self._since = time.monotonic()

    def add(self, metrics: dict[str, jax.Array], steps: int) -> None:
        """Queue one iteration's sums and control steps, without waiting for the device."""
        self._sums.append(metrics)
        self._steps += steps

    def wait_for_previous(self) -> None:
        """Let the device be at most one iteration behind the host."""
        if len(self._sums) > 1:
            jax.block_until_ready(self._sums[-2])

    def read(self, config: DreamerConfig) -> dict[str, float]:
        """Means since the last reading, and rates; starts anew."""
        fetched = jax.device_get(self._sums)
        # Several seeds: their mean.
        sums = {name: float(np.sum([np.mean(x[name]) for x in fetched])) for name in fetched[0]} if fetched else {}
        now = time.monotonic()
        seconds, self._since = max(now - self._since, 1e-9), now
        updates, episodes = sums.pop("updates", 0.0), sums.pop("episodes", 0.0)
        steps, self._steps, self._sums = self._steps, 0, []
        line = {
            "env_steps_per_s": steps / seconds,
            "updates_per_s": updates / seconds,
            "replayed_steps_per_s": updates * config.replayed_per_update / seconds,
            "updates_per_env_step": updates / max(steps, 1),
            "episodes": episodes,
        }
        goals = sums.pop("update/goal_frames", 0.0)
        predicted, true = (sums.pop(f"update/goal_reward_{name}sum", 0.0) for name in ("", "true_"))
        if goals:
            line |= {"goal_reward_predicted": predicted / goals, "goal_reward_true": true / goals}
        for name, value in sums.items():
            count = episodes if name.startswith("episode/") else updates
            if count:
                line[name.replace("update/", "")] = value / count
        return line


class Log:
    """metrics.jsonl, without the lines a resumed run is about to write again."""

    def __init__(
        self, path: Path, config: DreamerConfig, place: int, on_metrics: MetricsFn | None, tensorboard: bool
    ) -> None:
        self._path, self._on_metrics, self._config = path, on_metrics, config
        self._board = Board(path.parent, place) if tensorboard and parallel.is_first_process() else None
        self.last: dict[str, float] = {}
        self.evaluated_at = 0
        """Steps at the last evaluation so far."""
        kept: list[str] = []
        if not parallel.is_first_process():
            return
        for text in path.read_text(errors="replace").splitlines() if path.exists() else []:
            try:
                line = json.loads(text)
                pretrain.position(config, line)
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
                continue  # cut off by the kill, or damaged
            if pretrain.position(config, line) <= place and text not in kept[-1:]:
                kept.append(text)
                self.last = line
                if any(name.startswith("eval/") for name in line):
                    self.evaluated_at = line["env_steps"]
        write_atomically(path, "".join(text + "\n" for text in kept))

    def write(self, line: dict[str, float]) -> None:
        """Append one line."""
        self.last = line
        if not parallel.is_first_process():
            return
        with self._path.open("a") as file:
            file.write(text_of(line))
        if self._board is not None:
            self._board.write(line, pretrain.position(self._config, line))
        if self._on_metrics is not None:
            self._on_metrics(line)

    def close(self) -> None:
        """Close the curves."""
        if self._board is not None:
            self._board.close()


def text_of(line: dict[str, float]) -> str:
    """A line of metrics.jsonl. JSON has no sign for NaN and infinities, so a figure that is one is left out."""
    return json.dumps({name: value for name, value in line.items() if math.isfinite(value)}) + "\n"


def named_figures(figures: Any) -> dict[str, float]:
    """What an evaluation function has returned, as numbers of Python.

    Raises:
        ValueError: something else than figures by name.
    """
    try:
        return {str(name): float(value) for name, value in figures.items()}
    except (AttributeError, TypeError, ValueError):
        raise ValueError(f"TrainingOptions.eval_fn returned {figures!r}; it must return a dict of numbers by name, "
                         "{} for none. Correct it.") from None  # fmt: skip


def headline(line: dict[str, Any]) -> dict[str, str]:
    """The figures a watcher wants to see."""
    names = {
        "pretrain/env_steps_per_s": "random step/s",
        "pretrain/updates_per_s": "model upd/s",
        "pretrain_updates": "model updates",
        "replayed_steps_per_s": "replay/s",
        "updates_per_s": "upd/s",
        "updates_per_env_step": "upd/step",
        "episode/return": "return",
    }
    return {short: f"{line[name]:.3g}" for name, short in names.items() if name in line}


def evaluated(figures: dict[str, float]) -> dict[str, str]:
    """The figures of an evaluation that a watcher wants to see."""
    shown = {"success": f"{figures['success']:.0%}"} if "success" in figures else {}
    return shown | ({"eval return": f"{figures['return']:.3g}"} if "return" in figures else {})


def write_atomically(path: Path, text: str) -> None:
    """A file that is there whole or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
