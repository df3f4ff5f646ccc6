"""Costs and normal equations of many parameter sets at once, computed where the replay runs.

On an accelerator residuals are whitened, differenced and summed in one compiled function with the replay, so that only
a cost, a gradient and a Hessian of each set come back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.errors.space import STEP, huber_weight, robust_cost
from sysid.replay.arrays import Quotients
from sysid.replay.cores import COMPILERS, Compiled, on_processor

DRIVES = 32768  # replayed by one call, as near as sets allow: an accelerator takes as long for a few
STATES = 2**27  # states recorded by one call at most: 5 GB, several times as much with what is made of them
SEARCHES, FEW = 32, 8
"""Sets whose gradients and Hessians are made together: as many at least as a search has starts, or few go on."""


def sums_over(objective: Any) -> dict[str, Compiled]:
    """Sums over the residuals of many sets, "cost" and "quadratic", which all objectives of a class and replay share.

    `objective`: `Objective` or `FeatureObjective`; its `arrays` are what those of the same replay differ in.
    """
    def residual(u: jax.Array, arrays: Any) -> tuple[jax.Array, jax.Array]:
        """White residuals (B, K) of one set (P,), and the replays (B,) that diverged."""
        one = objective.with_arrays(arrays)
        with jax.default_matmul_precision("highest"):
            simulated = one.replay.traced(one.space.to_values(u[None]))
            return one.residuals(u[None], simulated)[0], one.bad(simulated)[0]

    def cost(u: jax.Array, arrays: Any, robust: jax.Array) -> jax.Array:
        return robust_cost(residual(u, arrays)[0], robust)

    def quadratic(u: jax.Array, arrays: Any, robust: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        size = u.shape[0]
        pairs = Quotients.central(u, STEP)
        white, bad = jax.vmap(residual, (0, None))(jnp.concatenate([u[None], pairs.points]), arrays)
        slope = pairs.slopes(white[1 : 1 + size], white[1 + size :])  # (B, K, P)
        lost = bad[:1] | bad[1 : 1 + size] | bad[1 + size :]
        slope = jnp.where(lost.T[:, None] | ~jnp.isfinite(slope), 0.0, slope)
        weight = jnp.where(robust, huber_weight(white[0]), 1.0)
        with jax.default_matmul_precision("highest"):
            gradient = jnp.einsum("bkp,bk->p", slope, white[0] * weight)
            hessian = jnp.einsum("bkp,bkq->pq", slope, slope * weight[..., None])
        return robust_cost(white[0], robust), gradient, hessian

    return {one.__name__: Compiled(jax.vmap(one, in_axes=(0, None, None))) for one in (cost, quadratic)}


class NormalEquations:
    """Sums over the residuals of one objective."""

    def __init__(self, objective: Any, at_once: int):
        """`at_once` is the number of sets that are replayed together."""
        compiled = objective.replay.compiled
        if type(objective) not in compiled:
            compiled[type(objective)] = sums_over(objective)
        self.sums: dict[str, Compiled] = compiled[type(objective)]
        self._arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), objective.arrays)
        parameters = objective.space.size
        many = max(at_once // (2 * parameters + 1), min(at_once, SEARCHES))
        self.sizes = {"cost": (at_once,), "quadratic": (min(FEW, many), many)}
        for name, sizes in self.sizes.items():  # a search needs all of them: they are compiled side by side
            for size in sizes:
                u = jax.ShapeDtypeStruct((size, parameters), jnp.result_type(float))
                self.sums[name].compile(u, self._arrays, np.bool_(False))

    def costs(self, u: np.ndarray, robust: bool = False) -> np.ndarray:
        """Sum (N,) of squares, or of the Huber loss, at unit coordinates (N, P)."""
        return self._call("cost", u, robust)

    def quadratic(self, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cost (N,), half its gradient (N, P) and half its Hessian (N, P, P) by Gauss and Newton, at u (N, P)."""
        return self._call("quadratic", u, robust)

    def _call(self, name: str, u: np.ndarray, robust: bool) -> Any:
        """What a function gives for each of u (N, P), so many of them at a time; the last call is filled up."""
        sizes = self.sizes[name]
        size = next((size for size in sizes if size >= len(u)), sizes[-1])
        padded = np.concatenate([u, np.repeat(u[-1:], -len(u) % size, axis=0)])
        sets = [jnp.asarray(padded[i : i + size], jnp.result_type(float)) for i in range(0, len(padded), size)]
        parts = [self.sums[name](one, self._arrays, np.bool_(robust)) for one in sets]
        return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf, float) for leaf in leaves])[: len(u)],
                            *parts)


def summed_there(replay: Any) -> bool:
    """Whether an accelerator computes this replay and can sum what it gives, so that drives need not be fetched."""
    return not on_processor() and hasattr(replay, "traced")


def compile_ahead(objectives: Sequence[Any], replay: Any, values: np.ndarray) -> None:
    """Compile side by side what a search by these objectives needs of a replay with values (P,), on an accelerator."""
    if summed_there(replay):
        COMPILERS.submit(replay.simulate, values[None])
        for objective in objectives:
            _ = objective.equations


def make_equations(objective: Any) -> NormalEquations | None:
    """Those of an objective whose replay an accelerator computes; None on a processor, where residuals are at hand."""
    replay = objective.replay
    if not summed_there(replay):
        return None
    return NormalEquations(objective, max(min(DRIVES // replay.drives, STATES // replay.states), 1))
