"""Errors of a loop's trials: replayed before, refitted, and with what was found."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from sysid.logs.metrics import METRICS, own_floor
from sysid.logs.records import Prediction, Trial
from sysid.replay.rollout import predictions
from sysid.verdict.result import Result
from sysid.verdict.vehicles import drives_of

RESAMPLES = 2000


def replay(result: Result, vehicle: Any, trials: tuple[Trial, ...]) -> list[Prediction]:
    """Replays of trials by a vehicle."""

    drives, values = drives_of(result, trials, vehicle)
    simulated = drives.replay(values[None])
    return predictions(trials, jax.tree.map(lambda leaf: leaf[0], simulated))


def table(rows: list[dict[str, Any]], trials: tuple[Trial, ...], which: str) -> dict[str, Any]:
    """part -> channel -> metric -> mean RMSE, with the noise floor of the same trials."""
    out: dict[str, Any] = {}
    for part, held in (("training", False), ("held_out", True)):
        floor = own_floor(trials, held)
        out[part] = {}
        for channel in dict.fromkeys(row["channel"] for row in rows):
            mine = [row for row in rows if row["channel"] == channel and row["held_out"] is held]
            means = {metric: [row["metrics"][metric][which] for row in mine if metric in row["metrics"]]
                     for metric in METRICS}
            out[part][channel] = {metric: float(np.mean(values)) for metric, values in means.items() if values}
            if floor and mine:
                out[part][channel]["noise_floor"] = floor.get(channel)
    return out


def change(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Mean change of each RMSE, its interval from trials drawn anew, and the share of trials that got worse."""
    rng = np.random.default_rng(0)
    out: dict[str, Any] = {}
    for part, held in (("training", False), ("held_out", True)):
        out[part] = {}
        for channel in dict.fromkeys(row["channel"] for row in rows):
            mine = [row for row in rows if row["channel"] == channel and row["held_out"] is held]
            for metric in METRICS:
                pairs = np.array([[row["metrics"][metric]["initial"], row["metrics"][metric]["fitted"]]
                                  for row in mine if metric in row["metrics"]])
                if len(pairs) == 0:
                    continue
                difference = pairs[:, 1] - pairs[:, 0]
                draws = difference[rng.integers(0, len(pairs), (RESAMPLES, len(pairs)))].mean(1)
                out[part].setdefault(channel, {})[metric] = {
                    "mean": float(difference.mean()), "interval": np.quantile(draws, [0.025, 0.975]).tolist(),
                    "relative": float(difference.mean() / max(pairs[:, 0].mean(), 1e-12)),
                    "worse": int((difference > 0).sum()), "trials": len(pairs)}
    return out
