"""Evaluations inside a training: their figures, the best one kept, and an early end."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dreamer.training import checkpoint, parallel
from whill_mjx.io.heartbeat import say
from whill_mjx.io.reading import read_lines
from whill_mjx.learning.setup import Preset
from whill_mjx.logs.dataset import write_json

Evaluate = Callable[[Any, int], dict[str, float]]
"""(parameters, environment steps) -> figures."""


def mean_figures(episodes: dict[str, np.ndarray]) -> dict[str, float]:
    """Means of an evaluation inside the run."""
    success = np.asarray(episodes["success"]) > 0.5
    figures = {name: float(np.mean(episodes[name])) for name in ("return", "success", "collision", "timeout")}
    if success.any():
        figures["arrival_s"] = float(np.mean(np.asarray(episodes["time_s"])[success]))
    return figures


def keep_best(out: Path, preset: Preset, evaluate: Evaluate) -> Evaluate:
    """The evaluation, which now also saves the parameters in RUN/best when they are the best so far.

    The best has the highest share of successes, and among equals the highest return. These episodes are not those of
    the final evaluation, so choosing by them does not flatter it.
    """

    def run(params: Any, env_steps: int) -> dict[str, float]:
        figures = evaluate(params, env_steps)
        before = read_best(out)
        # A run that goes on from an older checkpoint comes by the same steps again.
        if before is None or _rank(figures) > _rank(before) or before["env_steps"] == env_steps:
            checkpoint.save(out / "best", {"params": params}, preset.learner, checkpoint.Moment(env_steps))
            if parallel.is_first_process():
                write_json(out / "best.json", {"env_steps": env_steps, **figures})
        return figures

    return run


def _rank(figures: dict[str, float]) -> tuple[float, float]:
    return figures["success"], figures["return"]


def read_best(out: Path) -> dict[str, float] | None:
    """RUN/best.json, if there is one that can be read."""
    path = out / "best.json"
    if not path.is_file():
        return None
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))
        return {**saved, **{name: float(saved[name]) for name in ("success", "return")},
                "env_steps": int(saved["env_steps"])}  # fmt: skip
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        say(f"{path}: is damaged and left aside; the best evaluation before it is not known.")
        return None


class Stopper:
    """Ends a run after two good evaluations in a row, or when there is a file RUN/stop."""

    def __init__(self, out: Path, success: float | None):
        self._out, self._success = out, success
        self._good: int | None = None  # good evaluations in a row; None: those of an earlier start are not counted yet

    def total_steps(self, planned: int) -> int:
        """Steps to train: those at which an earlier start has ended for its success, if it asked the same."""
        path = self._out / "stopped.json"
        if self._success is None or not path.is_file():
            return planned
        try:
            saved = json.loads(path.read_text(encoding="utf-8"))
            return min(planned, int(saved["env_steps"])) if saved["success"] == self._success else planned
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            say(f"{path}: is damaged and left aside; the training goes on to its last step.")
            return planned

    def __call__(self, line: dict[str, float]) -> bool:
        """Whether the run ends after this line."""
        if parallel.agree((self._out / "stop").exists()):
            say(f"stopped, since {self._out / 'stop'} exists; remove it to go on.")
            return True
        if self._good is None:
            self._good = self._good_before(line["env_steps"])
        reached = self._success is not None and line.get("eval/success", 0.0) >= self._success
        self._good = self._good + 1 if reached else 0
        if self._good < 2:
            return False
        if parallel.is_first_process():
            write_json(self._out / "stopped.json", {"env_steps": line["env_steps"], "success": self._success})
        say(f"stopped after {line['env_steps']} steps: two evaluations in a row reached {self._success:.0%}.")
        return True

    def _good_before(self, env_steps: float) -> int:
        """Good evaluations in a row at the end of what an earlier start has logged: a resumed run ends alike."""
        path, good = self._out / "metrics.jsonl", 0
        if self._success is None:
            return 0
        for _, line in read_lines(path):
            if "eval/success" in line and line["env_steps"] < env_steps:
                good = good + 1 if line["eval/success"] >= self._success else 0
        return good
