"""Costs and normal equations of many parameter sets at once, computed where the replay runs.

Residuals of thousands of replays are larger than what they are wanted for: a cost, a gradient and a Hessian for each
set. On an accelerator they are whitened, differenced and summed there, in one compiled function with the replay, so
that only those sums come back.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sysid.cores import on_processor
from sysid.differences import STEP
from sysid.gradient import huber_weight, robust_cost
from sysid.rollout import Simulated
from sysid.space import Space

WASTE = 8  # times as many sets as are asked for are computed rather than that compiled
LEAST = 32
"""Sets that are computed at least: on an accelerator a few take as long, and each number is compiled once."""


class Traceable(Protocol):
    """`sysid.objective.Objective` or `sysid.starts.FeatureObjective`."""

    @property
    def space(self) -> Space: ...

    @property
    def replay(self) -> Any: ...

    @property
    def arrays(self) -> Any:
        """What objectives of the same replay differ in; with the same `kind` they share what is compiled."""

    @property
    def kind(self) -> Any: ...

    def with_arrays(self, arrays: Any) -> Traceable: ...

    def residuals(self, u: Any, simulated: Simulated | None = None) -> Any: ...

    def bad(self, simulated: Simulated) -> Any: ...


class Sums:
    """Compiled sums over the residuals of an objective."""

    def __init__(self, objective: Traceable, least: int):
        def residual(u: jax.Array, arrays: Any) -> tuple[jax.Array, jax.Array]:
            """White residuals (B, K) of one set (P,), and the replays (B,) that diverged."""
            one = objective.with_arrays(arrays)
            with jax.default_matmul_precision("highest"):
                simulated = one.replay.traced(one.space.to_values(u[None]))
                return one.residuals(u[None], simulated)[0], one.bad(simulated)[0]

        def cost(u: jax.Array, arrays: Any, robust: bool) -> jax.Array:
            return robust_cost(residual(u, arrays)[0], robust)

        def quadratic(u: jax.Array, arrays: Any, robust: bool) -> tuple[jax.Array, jax.Array, jax.Array]:
            size = u.shape[0]
            up, down = (jnp.clip(u + sign * STEP * jnp.eye(size), 0.0, 1.0) for sign in (1, -1))
            white, bad = jax.vmap(residual, (0, None))(jnp.concatenate([u[None], up, down]), arrays)
            width = jnp.diagonal(up - down)
            slope = (white[1 : 1 + size] - white[1 + size :]) / width[:, None, None]  # (P, B, K)
            lost = bad[:1] | bad[1 : 1 + size] | bad[1 + size :]
            slope = jnp.where(lost[..., None] | ~jnp.isfinite(slope), 0.0, slope)
            weight = huber_weight(white[0]) if robust else jnp.ones_like(white[0])
            with jax.default_matmul_precision("highest"):
                gradient = jnp.einsum("pbk,bk->p", slope, white[0] * weight)
                hessian = jnp.einsum("pbk,qbk->pq", slope, slope * weight)
            return robust_cost(white[0], robust), gradient, hessian

        self.least = least
        self.sizes: dict[Any, set[int]] = {}
        """Numbers of sets that each function was compiled for."""
        self.cost, self.quadratic = (
            jax.jit(jax.vmap(one, in_axes=(0, None, None)), static_argnums=2) for one in (cost, quadratic))

    def call(self, function: Any, u: np.ndarray, arrays: Any, robust: bool) -> Any:
        """What a function gives for each of u (N, P)."""
        sizes, count = self.sizes.setdefault((function, robust), set()), len(u)
        enough = max(WASTE * count, self.least)
        size = min((size for size in sizes if count <= size <= enough), default=max(count, self.least))
        sizes.add(size)
        padded = np.concatenate([u, np.repeat(u[-1:], size - count, axis=0)])
        found = function(jnp.asarray(padded, jnp.result_type(float)), arrays, robust)
        return jax.tree.map(lambda leaf: np.asarray(leaf[:count], float), found)


class NormalEquations:
    """Sums over the residuals of one objective."""

    def __init__(self, objective: Traceable, least: int = LEAST):
        """`least` is the number of sets that any call is filled up to."""
        compiled, kind = objective.replay.compiled, (objective.kind, least)
        if kind not in compiled:
            compiled[kind] = Sums(objective, least)
        self.sums: Sums = compiled[kind]
        self._arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), objective.arrays)

    def costs(self, u: np.ndarray, robust: bool = False) -> np.ndarray:
        """Sum (N,) of squares, or of the Huber loss, at unit coordinates (N, P)."""
        return self.sums.call(self.sums.cost, u, self._arrays, robust)

    def quadratic(self, u: np.ndarray, robust: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cost (N,), half its gradient (N, P) and half its Hessian (N, P, P) by Gauss and Newton, at u (N, P)."""
        return self.sums.call(self.sums.quadratic, u, self._arrays, robust)


def make_equations(objective: Traceable) -> NormalEquations | None:
    """Those of an objective whose replay an accelerator computes; None on a processor, where residuals are at hand."""
    return None if on_processor() or not hasattr(objective.replay, "traced") else NormalEquations(objective)
