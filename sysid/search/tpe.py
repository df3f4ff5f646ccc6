"""Global search with Optuna, in batches: tree-structured Parzen estimator, or CMA-ES."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sysid.errors.pose_objective import Objective
from sysid.errors.space import Space
from sysid.search.result import FitResult, Progress
from sysid.search.studies import SharedStudy, open_storage
from whill_mjx.io.steps import step

__all__ = ["fit"]


def fit(
    objective: Objective, space: Space, *, evaluations: int = 500, seed: int = 0, cost: str = "weighted",
    best: int = 4, progress: Progress | None = None, storage: Any = None, method: str = "tpe", study: str = "fit",
    problem: Mapping[str, str] | None = None,
) -> FitResult:
    """Minimise over `space`; the initial values are the first candidate.

    Args:
        objective: errors in unit coordinates of `space`.
        evaluations: parameter sets to try; in a shared study, by all its processes together.
        cost: "weighted" (least squares over all channels) or "paper" (sum of position RMSE).
        best: how many of the best candidates to return in `starts`.
        storage: of a study that several processes share: journal:FILE, a database URL, or an Optuna storage.
        method: "tpe" or "cmaes".
        study: its name there.
        problem: what the study is about (`sysid.search.studies.SharedStudy`).
    """
    costs: Callable[[np.ndarray], np.ndarray] = {
        "weighted": objective.weighted_cost, "paper": objective.paper_cost}[cost]
    about = {"cost": cost, "initial values": ", ".join(f"{value:.6g}" for value in space.initial),
             "bounds": ", ".join(f"{low:.6g} to {high:.6g}" for low, high in zip(space.low, space.high, strict=True)),
             **(problem or {})}
    shared = SharedStudy(space.names, space.to_unit(space.initial), method=method, seed=seed,
                         storage=open_storage(storage), study=study, problem=about)


    def kept(u: np.ndarray) -> np.ndarray:
        """Costs as a step, unless a storage keeps them: others may have added to it since."""
        return costs(u) if storage else step("candidates", lambda: [costs(u)], u)[0]

    shared.run(kept, evaluations, progress)
    u, values, initial = shared.table()
    order = np.argsort(values)
    return FitResult(u=u[order[0]], cost=float(values[order[0]]), initial_cost=float(values[initial]),
                     evaluations=len(values), starts=u[order[:best]], history=np.minimum.accumulate(values))
