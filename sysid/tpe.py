"""Global search with Optuna's tree-structured Parzen estimator, asked and told in batches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sysid.objective import Objective
from sysid.result import FitResult, Progress
from sysid.space import Space

BATCH = 16
"""Parameter sets simulated together."""


def fit(
    objective: Objective, space: Space, *, evaluations: int = 500, seed: int = 0, cost: str = "weighted",
    best: int = 4, progress: Progress | None = None, storage: Any = None,
) -> FitResult:
    """Minimise over `space` by TPE; the initial values are the first candidate.

    Args:
        objective: errors in unit coordinates of `space`.
        evaluations: parameter sets to try.
        cost: "weighted" (least squares over all channels) or "paper" (sum of position RMSE).
        best: how many of the best candidates to return in `starts`.
        storage: Optuna storage for a study that several processes share.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    costs: Callable[[np.ndarray], np.ndarray] = {
        "weighted": objective.weighted_cost, "paper": objective.paper_cost}[cost]
    sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True, n_startup_trials=2 * BATCH)
    study = optuna.create_study(sampler=sampler, direction="minimize", storage=storage)
    study.enqueue_trial(dict(zip(space.names, space.to_unit(space.initial).tolist(), strict=True)))
    distributions: Any = {name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in space.names}
    tried: list[np.ndarray] = []
    values: list[float] = []
    while len(tried) < evaluations:
        asked = [study.ask(distributions) for _ in range(BATCH)]
        u = np.array([[trial.params[name] for name in space.names] for trial in asked])
        found = costs(u)
        for trial, value in zip(asked, found, strict=True):
            # The logarithm keeps diverged candidates from flattening the rest.
            study.tell(trial, float(np.log(max(value, 1e-12))))
        tried += list(u)
        values += found.tolist()
        if progress is not None:
            progress(BATCH, f"J {min(values):.4g}")
    order = np.argsort(values)
    return FitResult(u=tried[order[0]], cost=values[order[0]], initial_cost=values[0], evaluations=len(tried),
                     starts=np.array([tried[i] for i in order[:best]]), history=np.minimum.accumulate(values))
