"""What is minimised: the paper's J (sum of position RMSE), and a weighted least-squares residual over all channels.

A channel's residual is divided by its noise scale: the spread between replicates, else a default that the residual's
own size replaces after a first fit. The three errors of a measured start pose enter linearly and are solved for in
closed form, with that noise as prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sysid.errors.normal_equations import NormalEquations, make_equations, summed_there
from sysid.errors.prior import Prior
from sysid.errors.space import Residuals, Space, huber_weight
from sysid.logs.metrics import replicate_noise
from sysid.logs.planar import turned_by
from sysid.logs.records import Trial
from sysid.replay.arrays import added, namespace
from sysid.replay.cores import on_processor
from sysid.replay.records import Measured, Simulated
from whill_mjx.io.steps import steps_of_rows

DEFAULT_NOISE = {"ground_truth": np.array([0.02, 0.02, 0.02]), "odometry": np.array([0.02, 0.02, 0.02, 0.02, 0.04])}
"""x, y [m], yaw [rad] and x, y, yaw, v [m/s], omega [rad/s]; only their ratio matters until they are re-estimated."""
GYRO_NOISE = 0.02  # rad/s, until it is re-estimated: that of replicates does not say what a model leaves of its rate
MIN_NOISE = 1e-3  # keeps a noiseless channel from dominating
HUGE = 1e3  # residual, in noise scales, of a sample of a diverged simulation


@dataclass(frozen=True)
class Noise:
    """Standard deviation per channel, and where it comes from."""

    pose: np.ndarray  # (3,)
    odometry: np.ndarray  # (5,)
    source: str  # "replicates", "defaults" or "residuals"
    gyro: float | None = None  # of a gyro's mean rate between two samples [rad/s]; None where no trial has one

    def as_dict(self) -> dict[str, float]:
        names = ["ground_truth.x", "ground_truth.y", "ground_truth.yaw",
                 "odometry.x", "odometry.y", "odometry.yaw", "odometry.v", "odometry.omega"]
        scales = {name: float(value) for name, value in zip(names, [*self.pose, *self.odometry], strict=True)}
        return scales if self.gyro is None else {**scales, "gyro.omega": self.gyro}


def estimate_noise(trials: tuple[Trial, ...]) -> Noise:
    """Noise from the replicates among `trials`; channels without replicates keep the defaults."""
    found = replicate_noise(trials)
    gyro = GYRO_NOISE if any(trial.gyro is not None for trial in trials) else None
    if found is None:
        return Noise(DEFAULT_NOISE["ground_truth"], DEFAULT_NOISE["odometry"], "defaults", gyro)

    def known(channel: str) -> np.ndarray:
        return np.where(np.isfinite(found[channel]), np.maximum(found[channel], MIN_NOISE), DEFAULT_NOISE[channel])

    pose, odometry = known("ground_truth"), known("odometry")
    pose[:2] = np.sqrt(np.mean(pose[:2] ** 2))  # along and across the start heading: a later turn swaps them
    odometry[:2] = np.sqrt(np.mean(odometry[:2] ** 2))
    return Noise(pose, odometry, "replicates", gyro)


class DriveResiduals(Residuals, Protocol):
    """`Objective`, or `sysid.errors.bin_objective.FeatureObjective`: residuals (N, B, K) of B trials."""

    @property
    def trials(self) -> tuple[Trial, ...]: ...

    @property
    def prior(self) -> Prior | None: ...

    def renewed(self, u: np.ndarray) -> Any: ...

    def pieces(self, count: int) -> np.ndarray: ...

    def own_frame(self, residual: np.ndarray) -> np.ndarray: ...


class Replays(Protocol):
    """`sysid.replay.rollout.Replay`, or what stands in for it."""

    def simulate(self, values: np.ndarray) -> Simulated: ...

    def jacobian(self, values: np.ndarray) -> tuple[Simulated, Simulated]: ...


@dataclass(frozen=True)
class Objective:
    """Errors of N parameter sets against B trials, in unit coordinates of `space`."""

    replay: Replays
    space: Space
    trials: tuple[Trial, ...]
    measured: Measured
    noise: Noise
    prior: Prior | None = None  # its P residuals are the last ones of the first trial

    @property
    def counted(self) -> int:
        """Number of measured values."""
        return int(sum(mask.sum() for mask in self._masks)) + (0 if self._rates is None else int(self._rates[1].sum()))

    @cached_property
    def _masks(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks of pose (B, M, 3) and odometry (B, L, 5) without what the start was averaged from: counted once."""
        pose, odometry = self.measured.pose_mask.copy(), self.measured.odometry_mask.copy()
        for i, trial in enumerate(self.trials):
            for mask, stream, known in ((pose, trial.ground_truth, trial.start.position_sigma),
                                        (odometry, trial.odometry, trial.start.odometry_position_sigma)):
                if stream is not None and known > 0:
                    mask[i, : int((stream.t <= trial.start.rest).sum()), :3] = 0.0
        return pose, odometry

    @cached_property
    def _rates(self) -> tuple[np.ndarray, np.ndarray] | None:
        """One over the time between samples of the gyro (B, G - 1, 1), and 1 where both are there; None without one."""
        one = self.measured
        if one.gyro_t is None or one.gyro_mask is None or self.noise.gyro is None:
            return None
        gap = np.diff(one.gyro_t, axis=1)[..., None]
        known = one.gyro_mask[:, 1:] * one.gyro_mask[:, :-1] * (gap > 0)
        return known / np.where(gap > 0, gap, 1.0), known

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What it may differ in from others of the same replay."""
        return self.noise.pose, self.noise.odometry, self.prior, self.noise.gyro

    def with_arrays(self, arrays: tuple[Any, ...]) -> Objective:
        noise = replace(self.noise, pose=arrays[0], odometry=arrays[1], gyro=arrays[3])
        return replace(self, noise=noise, prior=arrays[2])

    @cached_property
    def equations(self) -> NormalEquations | None:
        """What an accelerator computes of the residuals by itself."""
        return make_equations(self)

    def simulate(self, u: np.ndarray) -> Simulated:
        """Replay at unit coordinates (N, P)."""
        return self.replay.simulate(self.space.to_values(u))

    def paper_cost(self, u: np.ndarray) -> np.ndarray:
        """J (N,) [m] = sum over trials of the position RMSE: of the outside pose, or of the odometry without one."""
        if summed_there(self.replay):
            return np.asarray(self._paper_cost_there(jnp.asarray(u, jnp.result_type(float))), float)
        return np.asarray(self._paper_cost_of(self.simulate(u)))

    @cached_property
    def _paper_cost_there(self) -> Callable[[jax.Array], jax.Array]:
        """J on an accelerator, where drives stay; compiled anew for each number of sets."""
        replay: Any = self.replay
        return jax.jit(lambda u: self._paper_cost_of(replay.traced(self.space.to_values(u))))

    def _paper_cost_of(self, simulated: Simulated) -> Any:
        xp, outside = namespace(simulated.pose), self.measured.pose_mask[..., 0].sum() > 0
        values, target, mask = (
            (simulated.pose, self.measured.pose, self.measured.pose_mask) if outside
            else (simulated.odometry, self.measured.odometry, self.measured.odometry_mask))
        error = xp.square(values[..., :2] - target[..., :2]).sum(-1) * mask[..., 0]
        samples = np.maximum(mask[..., 0].sum(-1), 1)
        cost = xp.sqrt(error.sum(-1) / samples).sum(-1)
        return xp.where(self.bad(simulated).any(-1) | ~xp.isfinite(cost), HUGE, cost)

    def weighted_cost(self, u: np.ndarray, simulated: Simulated | None = None) -> np.ndarray:
        """Mean squared residual (N,), 1 at the noise level; `simulated` is what `simulate(u)` gave, if it is known."""
        return np.square(self.residuals(u, simulated)).sum((-1, -2)) / self.counted

    def residuals(self, u: np.ndarray, simulated: Simulated | None = None) -> np.ndarray:
        """(N, B, K) whitened residuals; masked samples are 0. K counts pose, odometry and start-pose terms."""
        residual, _ = self._whiten(self.simulate(u) if simulated is None else simulated, None)
        return residual if self.prior is None else append_prior(residual, self.prior.residual(u))

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (N, B, K) and their derivatives by u (N, B, K, P)."""
        residual, jacobian = steps_of_rows("derivatives", self._jacobian, u, 1 if on_processor() else len(u))
        return residual, jacobian

    def _jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        simulated, derivative = self.replay.jacobian(self.space.to_values(u))
        residual, jacobian = self._whiten(simulated, derivative)
        assert jacobian is not None
        jacobian = jacobian * self.space.slope(u)[:, None, None, :]
        return linear_with_prior(self.prior, u, residual, jacobian)

    def renewed(self, u: np.ndarray) -> Objective:
        """The same with the noise that u (P,) leaves, where it was not known."""
        if self.noise.source == "defaults":
            return replace(self, noise=self.residual_noise(u))
        if self._rates is None:
            return self
        return replace(self, noise=replace(self.noise, gyro=self.residual_noise(u).gyro))

    def pieces(self, count: int) -> np.ndarray:
        """(K,) in which of so many pieces of its drive each residual is, errors of starts apart."""
        tables = (self.measured.pose, self.measured.odometry)
        piece = np.concatenate([np.repeat(np.arange(table.shape[1]) * count // max(table.shape[1], 1), table.shape[2])
                                for table in tables])
        if self._rates is None:
            return piece
        pairs = self._rates[1].shape[1]
        return np.concatenate([piece, np.arange(pairs) * count // max(pairs, 1)])

    def own_frame(self, residual: np.ndarray) -> np.ndarray:
        """(B, K) residuals of pose, odometry and gyro; the outside position along and across the start's heading."""
        tables = (self.measured.pose, self.measured.odometry)
        sizes = [table[0].size for table in tables]
        pose = residual[:, : sizes[0]].reshape(tables[0].shape)
        yaw = np.array([trial.start.yaw for trial in self.trials])[:, None]
        turned = [*turned_by(pose[..., 0], pose[..., 1], -yaw), pose[..., 2]]
        end = sum(sizes) + (0 if self._rates is None else self._rates[1].shape[1])
        return np.concatenate([*turned, residual[:, sizes[0] : end]], axis=1)

    def residual_noise(self, u: np.ndarray) -> Noise:
        """Noise re-estimated as the size of the residual (robustly) at one point u (P,)."""
        simulated = self.simulate(u[None])
        scales = []
        for values, target, mask in ((simulated.pose[0], self.measured.pose, self.measured.pose_mask),
                                     (simulated.odometry[0], self.measured.odometry, self.measured.odometry_mask)):
            error = np.abs(values - target)
            known = [error[..., c][mask[..., c] > 0] for c in range(error.shape[-1])]
            scales.append(np.array([1.4826 * np.median(one) if len(one) else np.nan for one in known]))
        pose = np.where(np.isfinite(scales[0]), np.maximum(scales[0], MIN_NOISE), self.noise.pose)
        odometry = np.where(np.isfinite(scales[1]), np.maximum(scales[1], MIN_NOISE), self.noise.odometry)
        pose[:2] = np.sqrt(np.mean(pose[:2] ** 2))
        return Noise(pose, odometry, "residuals", self._gyro_noise(simulated))

    def _gyro_noise(self, simulated: Simulated) -> float | None:
        """Robust size of what one replay leaves of the gyro's rates [rad/s]."""
        if self._rates is None or simulated.gyro is None:
            return None
        error = np.abs(np.diff(np.asarray(simulated.gyro[0]) - self.measured.gyro, axis=1) * self._rates[0])
        there = self._rates[1] > 0
        known = error[there] / self._rates[1][there]  # whatever the drives weigh
        return max(1.4826 * float(np.median(known)), MIN_NOISE) if len(known) else self.noise.gyro

    def bad(self, simulated: Simulated) -> Any:
        """(N, B) replays that diverged."""
        xp = namespace(simulated.pose)
        finite = xp.isfinite(simulated.pose).all((-1, -2)) & xp.isfinite(simulated.odometry).all((-1, -2))
        return (simulated.diverged > 0.5) | ~finite

    def _whiten(self, simulated: Simulated, derivative: Simulated | None) -> tuple[np.ndarray, np.ndarray | None]:
        measured, noise, xp = self.measured, self.noise, namespace(simulated.pose)
        count, trials = simulated.pose.shape[:2]
        bad = self.bad(simulated)[:, :, None]
        pose_weight, odometry_weight = (
            mask / scale for mask, scale in zip(self._masks, (noise.pose, noise.odometry), strict=True))

        def flat(*tables: np.ndarray) -> np.ndarray:
            return xp.concatenate([one.reshape(count, trials, -1, *one.shape[4:]) for one in tables], axis=2)

        rate_weight = None if self._rates is None else self._rates[0] / noise.gyro
        shown, left = [xp.broadcast_to(pose_weight, simulated.pose.shape),
                       xp.broadcast_to(odometry_weight, simulated.odometry.shape)], [
            (simulated.pose - measured.pose) * pose_weight, (simulated.odometry - measured.odometry) * odometry_weight]
        if rate_weight is not None:
            turn: Any = simulated.gyro
            rates = xp.diff(turn - measured.gyro, axis=2) * rate_weight
            shown, left = [*shown, xp.broadcast_to(rate_weight, rates.shape)], [*left, rates]
        weights, residual = flat(*shown) > 0, flat(*left)
        residual = xp.where(bad, HUGE * weights, residual)
        jacobian = None
        if derivative is not None:
            slopes = [derivative.pose * pose_weight[..., None], derivative.odometry * odometry_weight[..., None]]
            if rate_weight is not None:
                slopes.append(np.diff(np.asarray(derivative.gyro), axis=2) * rate_weight[..., None])
            jacobian = flat(*slopes)
            jacobian = np.where(bad[..., None] | ~np.isfinite(jacobian), 0.0, jacobian)
        return self._solve_start(simulated, residual, jacobian)

    def _solve_start(
        self, simulated: Simulated, residual: np.ndarray, jacobian: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Residual and Jacobian after the best start-pose error of each trial, with that error itself appended.

        A start error n = (dx, dy, dyaw) moves the simulated pose by A n; n minimises |r + A n|^2 + |n / sigma|^2, a
        linear map of r that is applied to the Jacobian as well. Samples that are far off (`space.HUBER`) weigh less in
        it. The odometry, which is counted from its own standstill, has such an error of its own.
        """
        noise, starts = self.noise, [trial.start for trial in self.trials]
        begin, xp = 0, namespace(simulated.pose)
        for values, weight, origin, sigmas in (
            (simulated.pose, self._masks[0] / noise.pose, [(one.x, one.y) for one in starts],
             [(one.position_sigma, one.position_sigma, one.yaw_sigma) for one in starts]),
            (simulated.odometry, self._masks[1] / noise.odometry, np.zeros((len(starts), 2)),
             [(one.odometry_position_sigma, one.odometry_position_sigma, one.odometry_yaw_sigma) for one in starts]),
        ):
            part = slice(begin, begin + values[0, 0].size)
            begin = part.stop
            if not np.any(sigmas):
                continue
            sigma = np.maximum(sigmas, 1e-9)  # (B, 3)
            turned = _StartError.of(values, np.asarray(origin), weight, residual[:, :, part])
            solve = partial(xp.linalg.solve, turned.curvature + sigma[:, None, :] ** -2.0 * np.eye(3))
            error = -solve(turned.pull(residual[:, :, part])[..., None])  # (N, B, 3, 1)
            residual = xp.concatenate([residual, error[..., 0] / sigma], axis=2)
            residual = added(residual, (..., part), turned.moved(error)[..., 0])
            if jacobian is not None:
                slope = -solve(turned.pull(jacobian[:, :, part]))  # (N, B, 3, P)
                jacobian = np.concatenate([jacobian, slope / sigma[..., None]], axis=2)
                jacobian[:, :, part] += turned.moved(slope)
        return residual, jacobian


@dataclass(frozen=True)
class _StartError:
    """How an error (dx, dy, dyaw) of their start moves whitened poses (N, B, M, 3) x, y, yaw: a rotation about the
    start and a shift, by the derivatives (wx, 0, -wx ay), (0, wy, wy ax) and (0, 0, wyaw) of the columns."""

    arm: Any  # (N, B, M, 2) from the start to each pose
    weight: np.ndarray  # (B, M, C) one over the noise, 0 where masked; behind the third column nothing moves
    huber: Any  # (N, B, M, 3)

    @classmethod
    def of(cls, values: Any, origin: np.ndarray, weight: np.ndarray, residual: Any) -> _StartError:
        """That of poses: values (N, B, M, C) of x, y, yaw, ...; origin (B, 2); weight (B, M, C); residual (N, B, M C).
        """
        arm = namespace(values).nan_to_num(values[..., :2] - origin[:, None, :])
        return cls(arm, weight, huber_weight(residual.reshape(values.shape)[..., :3]))

    @property
    def curvature(self) -> Any:
        """(N, B, 3, 3) Gauss-Newton Hessians of the start errors, without their own noise."""
        xp, (x, y) = namespace(self.arm), (self.arm[..., 0], self.arm[..., 1])
        along, across, turn = (self.huber[..., c] * self.weight[..., c] ** 2 for c in range(3))
        xx, yy, xt, yt = along.sum(-1), across.sum(-1), -(along * y).sum(-1), (across * x).sum(-1)
        tt, none = (along * y**2 + across * x**2 + turn).sum(-1), xp.zeros_like(xx)
        return xp.stack([xp.stack(row, axis=-1) for row in ((xx, none, xt), (none, yy, yt), (xt, yt, tt))], axis=-2)

    def pull(self, table: Any) -> Any:
        """Half the gradients (N, B, 3, ...) of whitened residuals, or of their derivatives, (N, B, M C, ...)."""
        more = (1,) * (table.ndim - 3)
        table = table.reshape(*table.shape[:2], *self.weight.shape[1:], *table.shape[3:])
        x, y, turn = (table[:, :, :, c] * (self.huber[..., c] * self.weight[..., c]).reshape(*self.arm.shape[:3], *more)
                      for c in range(3))
        arm_x, arm_y = (self.arm[..., c].reshape(*self.arm.shape[:3], *more) for c in range(2))
        sums = [x.sum(2), y.sum(2), (arm_x * y - arm_y * x + turn).sum(2)]
        return namespace(table).stack(sums, axis=2)

    def moved(self, error: Any) -> Any:
        """What errors (N, B, 3, P) add to whitened residuals (N, B, M C, P)."""
        xp, (x, y) = namespace(error), (self.arm[..., c, None] for c in range(2))
        dx, dy, turn = (error[:, :, None, c] for c in range(3))  # (N, B, 1, P)
        weight = self.weight[..., None]
        columns = [(dx - y * turn) * weight[:, :, 0], (dy + x * turn) * weight[:, :, 1], turn * weight[:, :, 2]]
        columns += [xp.zeros_like(columns[0])] * (weight.shape[2] - 3)
        moved = xp.stack(columns, axis=3)  # (N, B, M, C, P)
        return moved.reshape(*error.shape[:2], -1, error.shape[3])


def without_prior(objective: DriveResiduals, table: np.ndarray) -> np.ndarray:
    """Table (B, K, ...) of the measurements alone."""
    return table if objective.prior is None else table[:, : -objective.space.size]


def linear_with_prior(
    prior: Prior | None, u: np.ndarray, residual: np.ndarray, jacobian: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, B, K) and Jacobian (N, B, K, P) at u (N, P) with those of a prior, if there is one."""
    if prior is None:
        return residual, jacobian
    slope = np.tile(np.diag(prior.slope), (len(u), 1, 1))
    return append_prior(residual, prior.residual(u)), append_prior(jacobian, slope)


def append_prior(table: np.ndarray, more: np.ndarray) -> np.ndarray:
    """Table (N, B, K, ...) with more (N, P, ...) behind the columns of its first trial and zeros behind the others'."""
    xp = namespace(table)
    behind = added(xp.zeros((*table.shape[:2], *more.shape[1:])), (slice(None), 0), more)
    return xp.concatenate([table, behind], axis=2)
