"""Whether drives do what the law of an effect forbids (`sysid.verdict.falsifiers`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from sysid.logs.records import Trial, command_in_force
from sysid.missing.joint_fit import Refit, moved_last
from sysid.missing.refit import Refitter, without_each
from sysid.verdict.agreement import beside
from sysid.verdict.falsifiers import QUIET, SPLITS, BinnedCourse, Tested
from whill_mjx.effects import card_of
from whill_mjx.effects.card import Falsifier

ALPHA = 0.01  # of all predictions of one effect together
POWER = 0.8  # least power with which drives must show the opposite for a prediction to count as tested
LEFT = 1.0  # largest share of what effects gain that may be left where one does nothing


@dataclass(frozen=True)
class Law:
    """One prediction of an effect, and the level at which drives must contradict it."""

    effect: str
    falsifier: Falsifier
    alpha: float


def put_to_test(
    fit: Refit, refitter: Refitter, trials: Sequence[Trial], groups: Sequence[Sequence[int]], track: float,
    p_excess: Callable[[float], float],
) -> list[list[Tested]]:
    """Every prediction of every effect in a joint fit, effect by effect.

    Args:
        groups: trials of each manoeuvre; errors count them as what is independent.
        p_excess: probability that a day with nothing in it leaves as much above the noise.
    """
    features = refitter.drives.simulate(np.stack([fit.values, *without_each(fit, refitter)]))
    course = course_of(trials, features[0], refitter.drives.features.width, track)
    seen = refitter.drives.mask > 0
    out: list[list[Tested]] = []
    for number, one in enumerate(fit.hypotheses):
        change = features[0] - features[1 + number]  # (B, K, C)
        energy = np.square(refitter.white(change)).reshape(seen.shape).sum(-1)
        tested = card_of(one.effect).forbids
        out.append([])
        for falsifier in tested:
            law = Law(one.effect, falsifier, ALPHA / len(tested))
            if falsifier.kind == "absent":
                quiet = QUIET[falsifier.by](course)[..., None] & seen
                part = fit.parts[number]
                gains = (_gain(moved_last(fit, number), part.stop - part.start, refitter.precision),
                         _gain(fit, len(fit.q), refitter.precision))
                out[-1].append(_absent(law, fit.residual.reshape(quiet.shape)[quiet], gains, p_excess))
                continue
            sides = SPLITS[falsifier.by](course, energy)
            parts = np.stack([change * (sides == which)[..., None] for which in (-1.0, 1.0, 0.0)], axis=-1)
            size, covariance = sizes_in_parts(fit, fit.parts[number], refitter.white(parts), refitter, groups)
            out[-1].append(_same(law, size[:2], covariance[:2, :2], len(groups) - 1))
    return out


def sizes_in_parts(
    fit: Refit, part: slice, signatures: np.ndarray, refitter: Refitter, groups: Sequence[Sequence[int]]
) -> tuple[np.ndarray, np.ndarray]:
    """(S,) sizes of the parts of an effect, as factors on the joint fit, and their covariance (S, S): a linear step.

    The covariance is the larger, part by part, of that of white noise and of one that takes manoeuvres as what is
    independent: the form of an effect is never quite the catalogue's.

    Args:
        part: the effect's coordinates within q, which the parts take the place of.
        signatures: (B, n, S) white change of the features by each part of the effect.
    """
    size, count = len(fit.u), signatures.shape[-1]
    own = np.arange(size + part.start, size + part.stop)
    columns = np.concatenate([np.delete(fit.jacobian, own, axis=-1), signatures], axis=-1)
    flat, residual = columns.reshape(-1, columns.shape[-1]), fit.residual.reshape(-1)
    matrix, right = flat.T @ flat, flat.T @ residual
    matrix[:size, :size] += refitter.precision
    right[:size] -= refitter.precision @ (fit.u - refitter.reference.u)
    matrix[np.diag_indices(len(matrix))] += 1e-9 * max(float(np.diag(matrix).max()), 1e-12)
    step, inverse = np.linalg.solve(matrix, right), np.linalg.inv(matrix)
    left = fit.residual - columns @ step
    scores = np.stack([np.einsum("bni,bn->i", columns[list(group)], left[list(group)]) for group in groups])
    robust = inverse @ (scores.T @ scores) @ inverse * len(groups) / max(len(groups) - 1, 1)
    usual, clustered = inverse[-count:, -count:], robust[-count:, -count:]
    scale = np.sqrt(np.maximum(np.diag(clustered) / np.diag(usual), 1.0))
    return 1 + step[-count:], usual * scale[:, None] * scale


def _same(law: Law, size: np.ndarray, covariance: np.ndarray, freedom: int) -> Tested:
    """Whether the weaker part is surely below `least` of the stronger one."""
    falsifier = law.falsifier
    weak = int(np.argmin(size))
    contrast = np.full(2, -falsifier.least)
    contrast[weak] = 1.0
    error = float(np.sqrt(contrast @ covariance @ contrast))
    t = stats.t(max(freedom, 1))
    p = float(min(2 * t.cdf(float(contrast @ size) / error), 1.0))  # the weaker of two was picked
    power = float(t.cdf((falsifier.least - falsifier.else_) / error + t.ppf(law.alpha / 2)))
    outcome = "falsified" if p < law.alpha else "holds" if power >= POWER else "untold"
    return Tested(law.effect, falsifier, outcome, tuple(size.tolist()), error, p, power)


def _absent(law: Law, residual: np.ndarray, gains: tuple[float, float], p_excess: Callable[[float], float]) -> Tested:
    """Whether the residual (N,) where an effect does nothing is too large for it to be what is missing; `gains` has by
    how much it alone and all effects lower the cost."""
    count = float(len(residual))
    left = float(np.square(residual).sum()) - count
    own, every = gains
    p, share = float(p_excess(left / count)) if count else 1.0, left / every
    visible = count > 0 and p_excess(own / count) < law.alpha  # had it all been left there, it would have been seen
    outcome = "falsified" if p < law.alpha and share > LEFT else "holds" if visible else "untold"
    return Tested(law.effect, law.falsifier, outcome, (share,), float(np.sqrt(2 * max(count, 1.0)) / own), p,
                  1.0 if visible else 0.0)


def _gain(fit: Refit, count: int, precision: np.ndarray) -> float:
    """By how much the last `count` coordinates lower the cost of a joint fit, beside all others. Linear."""
    q = fit.q[-count:]
    return max(float(q @ beside(fit.products(precision), count) @ q), 1e-9)


def course_of(trials: Sequence[Trial], simulated: np.ndarray, width: float, track: float) -> BinnedCourse:
    """The course of trials, from simulated features (B, K, 5) and their commands."""
    bins = simulated.shape[1]
    t = (np.arange(bins) + 0.5) * width
    measured = np.stack([np.arange(bins) * width < trial.duration for trial in trials])
    v, omega = np.where(measured, simulated[..., 0], 0.0), np.where(measured, simulated[..., 1], 0.0)
    start = np.array([trial.start.yaw for trial in trials])[:, None]
    heading = start + np.cumsum(omega * width, axis=1) - omega * width / 2
    rows = [_changes(trial, t, track) for trial in trials]
    asked, step, rising, since = (np.stack([row[k] for row in rows]) for k in range(4))
    return BinnedCourse(t, v, omega * track / 2, omega, heading, asked, step, rising, since)


def _changes(trial: Trial, t: np.ndarray, track: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Turning that is commanded at times t (K,), size of the command's last change before, 1 or -1 by whether it led
    away from rest, and time since."""
    command = np.stack([trial.command.v, trial.command.omega * track / 2], axis=-1)
    change = np.diff(command, axis=0, prepend=command[:1])
    size = np.linalg.norm(change, axis=-1)
    grown = np.sign(np.diff(np.linalg.norm(command, axis=-1), prepend=np.linalg.norm(command[0])))
    held = np.maximum(command_in_force(trial.command, t), 0)
    moved = np.where(size > 1e-6, np.arange(len(size)), -1)
    last = np.maximum.accumulate(moved)[held]
    known = last >= 0
    return (command[held, 1], np.where(known, size[last], 0.0), np.where(known, grown[last], 0.0),
            np.where(known, t - trial.command.t[last], t))
