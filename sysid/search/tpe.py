"""Global search with Optuna, in batches: tree-structured Parzen estimator, or CMA-ES."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sysid.errors.pose_objective import Objective
from sysid.errors.space import Space
from sysid.search.result import FitResult, Progress
from sysid.search.studies import SharedStudy, StudyPlace
from whill_mjx.io.steps import step

__all__ = ["fit"]


@dataclass(frozen=True)
class GlobalSearch:
    """How a global search goes."""

    evaluations: int = 500  # parameter sets to try; in a shared study, by all its processes together
    seed: int = 0
    cost: str = "weighted"  # "weighted" (least squares over all channels) or "paper" (sum of position RMSE)
    method: str = "tpe"  # "tpe" or "cmaes"
    best: int = 4  # how many of the best candidates to return in `starts`


def fit(
    objective: Objective, space: Space, search: GlobalSearch, place: StudyPlace = StudyPlace(),  # noqa: B008
    progress: Progress | None = None,
) -> FitResult:
    """Minimise an objective over `space`, from the initial values on, in a study that processes may share."""
    costs: Callable[[np.ndarray], np.ndarray] = {
        "weighted": objective.weighted_cost, "paper": objective.paper_cost}[search.cost]
    about = {"cost": search.cost, "initial values": ", ".join(f"{value:.6g}" for value in space.initial),
             "bounds": ", ".join(f"{low:.6g} to {high:.6g}" for low, high in zip(space.low, space.high, strict=True)),
             **place.problem}
    shared = SharedStudy(space.names, space.to_unit(space.initial), replace(place, problem=about),
                         method=search.method, seed=search.seed)

    def kept(u: np.ndarray) -> np.ndarray:
        """Costs as a step, unless a storage keeps them: others may have added to it since."""
        return costs(u) if place.storage else step("candidates", lambda: [costs(u)], u)[0]

    shared.run(kept, search.evaluations, progress)
    u, values, initial = shared.table()
    order = np.argsort(values)
    return FitResult(u=u[order[0]], cost=float(values[order[0]]), initial_cost=float(values[initial]),
                     evaluations=len(values), starts=u[order[: search.best]], history=np.minimum.accumulate(values))
