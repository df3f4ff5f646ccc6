"""A late outside pose, named before any other effect.

Where poses are stamped on receipt they are old by an unknown time, and irregular: their noise within a bin is many
times that of a whole drive, in which it does not add up. A base model that is fitted without the delay imitates a part
of it by tyres that slip too easily, and hides it. The delay is found without a vehicle model, by what was measured on
the vehicle itself (`sysid.logs.pose_lag`); then the base model is fitted to whole poses with it, both from where it was
and from where its first fit began. Without the delay it is fitted from the same starts, so that these are no reason to
be better. Later fits hold the delay: they would bend it to what the base model lacks.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sysid.errors.space import make_space
from sysid.logs.pose_lag import Rates, pose_lag
from sysid.logs.records import Log
from sysid.missing.catalogue import PARAMETER
from sysid.missing.evidence import with_values
from sysid.missing.pose_fit import fit_poses
from sysid.verdict.result import Result
from sysid.verdict.search_record import Candidate
from sysid.verdict.vehicles import drives_of, fitted_before
from whill_mjx.vehicle.parameters import set_values

NAME = "pose_delay"
ITERATIONS = 20


def told_late(result: Result, alpha: float) -> Result:
    """The result with a late outside pose named, where it follows what was measured on the vehicle with a delay; else
    as it is."""
    search, evidence = result.search, result.evidence
    rates = yaw_rates(result.log)
    lag = pose_lag(result.log.training, evidence.groups, rates)
    if lag is None:
        return result
    result.seconds["p of a late pose"] = lag.p
    if lag.p >= alpha or lag.delay < result.plant.dt:
        return result
    [one] = [one for one in result.hypotheses if one.effect == NAME]
    null, late = fitted(result, 0.0), fitted(result, lag.delay)
    space = result.reference.space
    q = np.array([lag.delay / one.axes[0].unit])
    column = [columns for columns in evidence.columns if columns.hypothesis == result.hypotheses.index(one)][0].index
    jacobian = np.concatenate([search.base.jacobian, evidence.design[..., list(column)]], axis=-1)
    units = [space.to_unit(np.array([values[list(result.names).index(name)] for name in space.names]))
             for values in (null, late)]
    left = residuals(result, np.stack([null, late]))
    fit = replace(search.base, hypotheses=(one,), u=units[1], q=q, cost=float(np.square(left[1]).sum()),
                  residual=left[1], jacobian=jacobian, values=late)
    base_fit = replace(search.base, u=units[0], cost=float(np.square(left[0]).sum()), residual=left[0], values=null)
    named = Candidate(one, 0.0, lag.p, lag.share, fit)
    means = "odometry" if rates is None else "yaw rate"
    reason = (f"the outside pose follows the vehicle's own {means} {lag.delay:.2f} s late ({lag.low:.2f} to "
              f"{lag.high:.2f} s): {lag.share:.0%} less error in blocks of drives that were held back")
    return replace(
        result, config=replace(result.config, held=(*result.config.held, PARAMETER)),
        search=replace(search, verdict="named", base=base_fit, final=fit,
                       accepted=[named], classes=[[NAME]], share=lag.share, reason=reason))


def yaw_rates(log: Log) -> Rates | None:
    """Yaw rates of the body, of the trials that have a gyro; None where none has."""
    known: Rates | None = log.fields.get("yaw_rate")
    if known is not None:
        return known
    gyros = {trial.name: trial.gyro for trial in log.training if trial.gyro is not None and len(trial.gyro.t) > 1}
    return {name: (one.t, np.gradient(one.turn, one.t)) for name, one in gyros.items()} or None


def residuals(result: Result, values: np.ndarray) -> np.ndarray:
    """White residuals (N, B, n) of the binned drives with values (N, all)."""
    reference = result.reference
    drives, _ = result.prepared.drives(result.log.training, result.log.spec.track)
    target = reference.target_of(drives)
    return np.stack([reference.whitener.flat(target - one, drives.mask) for one in drives.simulate(values)])


def fitted(result: Result, delay: float) -> np.ndarray:
    """Values (all,) of the base model fitted to whole poses that are late by `delay` [s]."""
    names, reference = list(result.names), result.reference
    drives, values = drives_of(result, result.log.training, fitted_before(result))
    values = with_values(values, names, {PARAMETER: delay})
    vehicle = set_values(result.full, names, jnp.asarray(values, jnp.result_type(float)))
    space = make_space(vehicle, result.log.spec, list(reference.space.names))
    first = space.to_unit(reference.space.initial)
    u = fit_poses(drives, space, values, reference.spread, ITERATIONS, first[None])
    found = space.to_values(space.to_unit(space.initial) if u is None else u)
    return with_values(values, names, dict(zip(space.names, found.tolist(), strict=True)))
