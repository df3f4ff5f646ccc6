"""Drives whose motion is linear in everything: evidence of them, and refits in the place of a simulator's."""

from types import SimpleNamespace

import numpy as np

from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.evidence import Evidence, column_layout
from sysid.missing.joint_fit import Refit

EFFECTS = tuple(Hypothesis(name, (Axis(parameter, 0.01, signed=True, limit=50.0),)) for name, parameter in (
    ("slope", "slope.along_x"), ("track_width", "track_width.error"), ("side_force", "side_force.sideways"),
    ("command_scale", "command_scale.linear")))
SPREAD = 0.01 * np.eye(1)
POOL = 60


def drives(sizes, close=0.8, seed=0, trials=6, samples=120):
    """Evidence of drives with these sizes (4,) of the effects, or with their own (trials, 1, 4); the first two change
    the motion nearly alike."""
    rng = np.random.default_rng(seed)
    free = rng.standard_normal((trials, samples, 5))
    shared = free[..., 1]
    free[..., 2] = close * shared + np.sqrt(1 - close**2) * free[..., 2]
    noise = rng.standard_normal((trials, samples))
    residual = (free[..., 1:] * np.asarray(sizes)).sum(-1) + noise
    pool = tuple(rng.standard_normal((POOL, samples)) @ one for one in free)
    return Evidence(residual, free, 1, column_layout(EFFECTS, 1), np.linalg.inv(SPREAD),
                    np.einsum("bni,bnj->bij", free, free), np.einsum("bni,bn->bi", free, residual), pool,
                    tuple((k,) for k in range(trials)))


class Linear:
    """Refits of drives whose motion is linear in everything, in the place of `sysid.missing.refit.Refitter`."""

    def __init__(self, evidence):
        self.evidence, self.precision = evidence, evidence.precision
        self.reference = SimpleNamespace(u=np.zeros(1), spread=SPREAD)
        self.drives = SimpleNamespace(mask=np.ones(evidence.residual.shape), repeats=np.arange(len(evidence.residual)),
                                      features=SimpleNamespace(width=0.25), simulate=self.simulate)

    def simulate(self, sets):
        """(N, B, K, 5) features with values (N, 5) of the base parameter and the four effects."""
        series = np.einsum("bnj,sj->sbn", self.evidence.design, sets)
        return series.reshape(*series.shape[:2], -1, 5)

    def white(self, series):
        return series.reshape(len(series), -1, *series.shape[3:])

    def values_at(self, chosen, u, q):
        values = np.concatenate([u, np.zeros(len(EFFECTS))])
        values[[1 + EFFECTS.index(one) for one in chosen]] = q
        return values

    def fit(self, chosen, *_):
        columns = self.evidence.design[..., [0, *(1 + EFFECTS.index(one) for one in chosen)]]
        flat = columns.reshape(-1, columns.shape[-1])
        matrix = flat.T @ flat
        matrix[:1, :1] += self.precision
        solution = np.linalg.solve(matrix, flat.T @ self.evidence.residual.reshape(-1))
        residual = self.evidence.residual - columns @ solution
        cost = float(np.square(residual).sum() + solution[:1] @ self.precision @ solution[:1])
        values = self.values_at(chosen, solution[:1], solution[1:])
        return Refit(tuple(chosen), solution[:1], solution[1:], cost, residual, columns, values)

    def stuck(self, _):
        return False

    def costs(self, starts):
        left = [self.evidence.residual - self.evidence.design @ self.values_at(one.hypotheses, one.u, one.q)
                for one in starts]
        return np.array([np.square(one).sum() for one in left])

    def fit_all(self, starts, _):
        return [self.fit(start.hypotheses, None) for start in starts]
