"""Whether the outside pose is late, told by whole poses.

Where poses are stamped on receipt they are old by an unknown time, and irregular: their noise within a bin is many
times that of a whole drive, in which it does not add up, and a lag of the body behind its wheels looks like it. So the
delay is fitted to whole poses, beside the base model, on one half of the blocks of drives, and judged by whether it
predicts the poses of the other half better than the base model alone fitted to the same half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid.log import Trial
from sysid.loop.evidence import with_values
from sysid.loop.poses import fit_poses
from sysid.loop.search import Candidate
from sysid.metrics import score
from sysid.rollout import predictions
from sysid.space import make_space

if TYPE_CHECKING:
    from sysid.close_loop import Result

NAME = "pose_delay"
PARAMETER = "pose_delay.delay"
START = 0.2  # s
ITERATIONS = 8
FLIPS = 20000


@dataclass(frozen=True)
class LatePose:
    """A delay of the outside pose."""

    delay: float
    """Fitted to all blocks [s]."""
    p: float
    """Probability of so much better a prediction if the delay told nothing: drives with their signs drawn."""
    share: float
    """Mean of the shares of held-back position and yaw RMSE that it removes."""


def told_late(result: Result, alpha: float) -> Result:
    """The result with a late outside pose named, where held-back drives tell of it; else as it is."""
    found = judge(result)
    result.seconds["p of a late pose"] = found.p
    if found.p >= alpha or found.delay < result.plant.dt:
        return result
    search, evidence = result.search, result.evidence
    [one] = [one for one in result.hypotheses if one.effect == NAME]
    q = np.array([found.delay / one.axes[0].unit])
    base = dict(zip(result.names, search.base.values.tolist(), strict=True))
    values = with_values(search.base.values, result.names, one.values(q, base))
    h = result.hypotheses.index(one)
    column = [columns for columns in evidence.columns if columns.hypothesis == h][0].index
    jacobian = np.concatenate([search.base.jacobian, evidence.design[..., list(column)]], axis=-1)
    fit = replace(search.base, hypotheses=(one,), q=q, jacobian=jacobian, values=values)
    named = Candidate(one, 0.0, found.p, found.share, fit)
    return replace(result, search=replace(
        search, verdict="named", final=fit, accepted=[named], classes=[[NAME]], share=found.share,
        reason=f"{found.share:.0%} less error in whole poses of blocks of drives that were held back"))


def judge(result: Result) -> LatePose:
    """Cross-validated on halves of the blocks, every second one."""
    trials = result.log.training
    blocks = [list(block) for block in result.evidence.groups]
    halves = [sum(blocks[0::2], []), sum(blocks[1::2], [])]
    gains = np.zeros((len(trials), 2))
    for fitted, told in (halves, halves[::-1]):
        errors = []
        for late in (False, True):
            values = _fit(result, [trials[i] for i in fitted], late)
            errors.append(_errors(result, [trials[i] for i in told], values))
        gains[told] = (errors[0] - errors[1]) / errors[0].mean(0)
    each = gains.sum(1)  # every drive starts from a measured pose, so its error is its own
    signs = np.random.default_rng(0).choice((-1.0, 1.0), (FLIPS, len(each)))
    p = (1 + int((signs @ each >= each.sum()).sum())) / (1 + FLIPS)
    delay = float(_fit(result, list(trials), True)[list(result.names).index(PARAMETER)])
    return LatePose(delay, p, float(gains.mean()))


def _fit(result: Result, trials: Sequence[Trial], late: bool) -> np.ndarray:
    """Values (all,) of the base model, with a delay or without, fitted to whole poses of some trials."""
    from sysid.close_loop import all_values, drives_of

    values = all_values(result, result.before)
    free = list(result.reference.space.names)
    if late:
        free.append(PARAMETER)
        values[list(result.names).index(PARAMETER)] = START
    space = make_space(_vehicle(result, values), result.log.spec, free)
    spread = np.zeros((space.size, space.size))
    known = len(result.reference.space.names)
    spread[:known, :known] = result.reference.spread
    u = fit_poses(drives_of(result, tuple(trials)), tuple(trials), space, values, spread, ITERATIONS)
    found = dict(zip(space.names, space.to_values(space.to_unit(space.initial) if u is None else u), strict=True))
    return with_values(values, result.names, found)


def _vehicle(result: Result, values: np.ndarray) -> object:
    import jax.numpy as jnp

    from whill_mjx.parameters import set_values

    return set_values(result.full, result.names, jnp.asarray(values, jnp.result_type(float)))


def _errors(result: Result, trials: Sequence[Trial], values: np.ndarray) -> np.ndarray:
    """(B, 2) RMSE of outside position [m] and yaw [rad]."""
    from sysid.close_loop import drives_of

    seen = drives_of(result, tuple(trials)).replay(values[None])
    told = predictions(tuple(trials), type(seen)(seen.pose[0], seen.odometry[0], seen.diverged[0]))
    scores = [score(trial, one)["ground_truth"] for trial, one in zip(trials, told, strict=True)]
    return np.array([[one.trajectory, one.yaw] for one in scores], float)
