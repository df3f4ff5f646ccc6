"""Days with nothing missing, drawn from what the reference days left: the log's own null scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid.weighing.linear_model import wander_columns
from sysid.weighing.posterior import posterior
from sysid.weighing.priors import DEFAULT, Priors
from sysid.weighing.saved_evidence import Evidence


def simulated_day(evidence: Evidence, random: np.random.Generator, priors: Priors = DEFAULT) -> Evidence:
    """The same drives on a day with nothing missing: noise of reference drives, a day's base and its wander."""
    residual = np.zeros_like(evidence.residual)
    for manoeuvre in np.unique(evidence.manoeuvre):
        drives = np.flatnonzero(evidence.manoeuvre == manoeuvre)
        pool = np.flatnonzero(evidence.pool_manoeuvre == manoeuvre)
        pool = pool if len(pool) >= 3 else np.arange(len(evidence.pool))
        picked = random.permutation(pool)
        sign = random.choice((-1.0, 1.0))
        for place, drive in enumerate(drives):
            residual[drive] = sign * evidence.pool[picked[place % len(picked)]]
    factor = np.linalg.cholesky(evidence.spread + 1e-9 * np.eye(len(evidence.spread)))
    residual += evidence.base @ (factor @ random.standard_normal(len(factor)))
    columns = wander_columns(evidence, priors)
    share = random.standard_normal(columns.shape[-1]) / np.sqrt(max(len(evidence.effects), 1))
    residual += columns @ share  # the covariance gives every effect the whole of what a day adds
    return replace(evidence, residual=residual * evidence.mask, points=())


def null_scores(evidence: Evidence, count: int, seed: int = 0, priors: Priors = DEFAULT) -> list[float]:
    """Scores of such days."""
    random = np.random.default_rng(seed)
    return [posterior(simulated_day(evidence, random, priors), priors).score for _ in range(count)]
