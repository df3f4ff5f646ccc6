"""The base model fitted to drives in features: bounded Levenberg-Marquardt, and a prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from sysid.errors.noise import Whitener
from sysid.errors.space import Space
from sysid.missing.drives import Drives
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, State, Try
from sysid.search.result import Progress
from whill_mjx.io.steps import step

CHOICES = tuple(Try(factor) for factor in (0.1, 1.0, 10.0, 100.0))
PATIENCE = Patience(tolerance=1e-3, first=3)


@dataclass(frozen=True)
class BaseFit:
    """Fits of the base model to drives: they minimise |W (f(u) - y)|^2 over the unit box."""

    drives: Drives
    """Replays over exactly the parameters of `space`."""
    space: Space
    whitener: Whitener
    sizes: np.ndarray
    """(P,) over which derivatives are taken, in unit coordinates. Differences over what a day changes smooth out the
    roughness of skids, and need no compilation of their own."""

    def run(
        self, start: np.ndarray, iterations: int, prior: tuple[np.ndarray, np.ndarray] | None = None,
        progress: Progress | None = None,
    ) -> np.ndarray:
        """The best unit coordinates (P,), from a start (P,).

        Args:
            prior: mean (P,) and precision (P, P) of the unit coordinates.
        """
        solver = GaussNewton(BoxStep(passes=1), CHOICES, PATIENCE, prior)
        state, measured = solver.init(start[None]), float((self.drives.mask > 0).sum())
        for _ in range(iterations):
            state = State(*step("base fit", partial(self._advanced, solver, state), *state))
            if progress is not None:
                progress(1, f"base fit, cost {state.cost[0] / measured:.3f}")
            if solver.done(state).all():
                break
        return np.asarray(state.u[0])

    def _advanced(self, solver: GaussNewton, state: State) -> State:
        """After an iteration of a single start."""
        at, slopes = self.drives.linearised(self.space.to_values, state.u[0], self.sizes)
        residual = self._white(at[None])
        jacobian = self.whitener.apply(slopes, self.drives.mask).reshape(1, -1, state.u.shape[1])
        state = state._replace(cost=solver.cost(residual, state.u))
        tried = solver.tries(state, *solver.normal(residual, jacobian, state.u))
        points = tried.points[0]
        white = self._white(self.drives.simulate(self.space.to_values(points)))
        return solver.step(state, tried, solver.cost(white, points)[None])

    def _white(self, features: np.ndarray) -> np.ndarray:
        """White residuals (N, n) of features (N, B, K, C)."""
        return np.stack([self.whitener.apply(one - self.drives.target, self.drives.mask).ravel() for one in features])
