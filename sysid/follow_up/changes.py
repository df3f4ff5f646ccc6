"""What an added effect changed in each manoeuvre: paired errors before and after, with block-bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.logs.metrics import METRICS, UNITS, errors_of
from sysid.logs.records import Prediction, Trial

BLOCK = 2.0  # length of the blocks that are drawn within a trial [s]: longer than what errors of speed remember
RESAMPLES = 1000

Squares = dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]  # channel -> metric -> times (T,) and squared errors (T,)


def squared_errors(trial: Trial, prediction: Prediction) -> Squares:
    """The squares whose mean over a trial is the square of `sysid.logs.metrics.score`."""
    return {channel: {metric: (t, np.square(error)) for metric, (t, error) in mine.items()}
            for channel, mine in errors_of(trial, prediction).items()}


def by_manoeuvre(
    trials: Sequence[Trial], before: Sequence[Prediction], after: Sequence[Prediction], seed: int = 0
) -> list[dict[str, Any]]:
    """Mean RMSE of each manoeuvre, channel and metric before and after, training and held-out trials apart.

    Rows of `part`, `manoeuvre`, `channel`, `metric`, `unit`, `before`, `after`, `change`, its 95 % `interval` and
    `trials`. Intervals are those of trials drawn anew and of blocks of `BLOCK` within each.
    """
    rng = np.random.default_rng(seed)
    pairs = [(trial, squared_errors(trial, one), squared_errors(trial, other))
             for trial, one, other in zip(trials, before, after, strict=True)]
    out = []
    for part, manoeuvre in dict.fromkeys((_part(trial), trial.manoeuvre) for trial in trials):
        mine = [(one, other) for trial, one, other in pairs if (_part(trial), trial.manoeuvre) == (part, manoeuvre)]
        for channel in dict.fromkeys(channel for one, _ in mine for channel in one):
            for metric in METRICS:
                both = [(*one[channel][metric], other[channel][metric][1]) for one, other in mine
                        if metric in one.get(channel, {})]
                if both:
                    out.append({"part": part, "manoeuvre": manoeuvre, "channel": channel, "metric": metric,
                                "unit": UNITS[metric], **paired(both, rng), "trials": len(both)})
    return out


def worse(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows whose error surely grew, by their share of it, most first."""
    grown = [row for row in rows if row["interval"][0] > 0]
    return sorted(grown, key=lambda row: -row["change"] / max(row["before"], 1e-12))


def paired(trials: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], rng: np.random.Generator) -> dict[str, Any]:
    """Mean RMSE before and after, and the interval of its change, from times (T,) and squared errors (T,) of trials."""
    ends = np.array([[np.sqrt(one[1].mean()), np.sqrt(one[2].mean())] for one in trials]).mean(0)
    drawn = np.stack([_drawn(*one, rng) for one in trials])  # (trials, RESAMPLES)
    picked = rng.integers(0, len(trials), (len(trials), RESAMPLES))
    low, high = np.quantile(drawn[picked, np.arange(RESAMPLES)].mean(0), [0.025, 0.975])
    return {"before": float(ends[0]), "after": float(ends[1]), "change": float(ends[1] - ends[0]),
            "interval": [float(low), float(high)]}


def _drawn(t: np.ndarray, before: np.ndarray, after: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(RESAMPLES,) change of the RMSE of a trial, blocks drawn anew."""
    block = ((t - t[0]) / BLOCK).astype(int)
    count = np.bincount(block).astype(float)
    sums = np.stack([np.bincount(block, each) for each in (before, after)])
    kept = count > 0
    count, sums = count[kept], sums[:, kept]
    chosen = rng.integers(0, len(count), (RESAMPLES, len(count)))
    rmse = np.sqrt(sums[:, chosen].sum(-1) / count[chosen].sum(-1))
    return np.asarray(rmse[1] - rmse[0])


def _part(trial: Trial) -> str:
    return "held_out" if trial.held_out else "training"
