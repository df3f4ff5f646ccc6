"""A wrench without a name for what the catalogue does not have.

A force along the vehicle and a torque about it, as tables over one quantity of the motion, are fitted to what the base
model leaves. Manoeuvres that were held back decide which quantity, how smooth, and which sum of few terms stands for
the table. The winner is replayed as the effect `unnamed`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from sysid.follow_up.wrench_tables import (
    Products,
    Term,
    WrenchTable,
    columns_of,
    few_terms,
    from_first_wave,
    held_back,
    in_words,
    multiplied,
    penalties,
    turned,
)
from sysid.logs.records import Prediction, Trial
from sysid.missing.drives import RECORD_DT, make_drives
from sysid.missing.unexplained import ANGLE_PRICE, PHASES, WHEELS
from sysid.replay.arrays import Quotients
from sysid.replay.models import with_effects
from sysid.replay.records import FreeVehicle, Plant
from sysid.replay.rollout import Replay, make_batch, predictions
from sysid.search.gauss_newton import BoxStep, GaussNewton, Patience, Try
from sysid.verdict.result import Result
from sysid.verdict.vehicles import fitted_before, refit_poses
from whill_mjx.effects import make_effect
from whill_mjx.effects.unnamed import KNOTS, MAP, PERIODIC, QUANTITIES
from whill_mjx.vehicle.parameters import describe, get_values, set_values
from whill_mjx.vehicle.types import VehicleParams

KINDS = ("push", "brake")  # A wrench whatever the motion, or one that turns with its direction
ROOM = ("heading in the room", "x in the room", "y in the room", MAP)  # only an outside pose shows them
REST_RANGE = {"time since rest": 4.0, "distance since rest": 0.6}
FINALISTS = 3  # tables that are fitted to all trials, not to one of each manoeuvre alone
LEAST = 0.1  # least share of the excess residual that a table must predict on held-back manoeuvres
LEAST_GAIN = 25.0  # least lowering of their squared white residual, which tables hardly reach on noise
COMPACT = 0.75  # share of the table's held-back gain that few terms must reach to stand for it
CHOICES = tuple(Try(1.0, share) for share in (1.0, 0.5, 0.2))
ROUNDS = 3  # Gauss-Newton steps


@dataclass(frozen=True)
class TableFit:
    """A table fitted to all trials by regression."""

    table: WrenchTable
    gains: np.ndarray  # (G,) on each manoeuvre, held back
    smoothing: float
    products: Products
    columns: np.ndarray  # (B, n, 2 KNOTS), turned
    phases: np.ndarray  # (B,) each trial's turn


@dataclass(frozen=True)
class Unnamed:
    """A fitted wrench."""

    table: WrenchTable
    wrench: np.ndarray  # (2 KNOTS,) forces [N], then torques [N m]
    terms: tuple[Term, ...]  # the sum that stands for the tables; none where no compact one does
    coefficients: tuple[np.ndarray, ...]  # of each term, for force [N] and torque [N m]
    vehicle: VehicleParams  # the base model refitted beside it, with the effect
    gain: float  # share of the excess residual that it predicts on held-back manoeuvres (of the training trials)
    by_manoeuvre: dict[str, float]  # lowering of the squared white residual of each manoeuvre, held back
    cost: tuple[float, float]  # squared white residual of the training trials per sample, replayed before and after
    tried: tuple[tuple[str, str, float], ...]  # quantity, kind and held-back gain of every table that was fitted
    angles: np.ndarray  # (B,) rad, of the wheels at the start of each trial
    kept: bool


class UnnamedReplays:
    """Replays of the base model with the effect `unnamed` in it."""

    def __init__(self, result: Result):
        reference, base = result.reference, result.search.base
        self.result, self.base_names = result, list(reference.space.names)
        self.params = VehicleParams(reference.params.body, (*reference.params.effects, make_effect("unnamed")))
        self.names = [name for name in describe(self.params) if name.startswith("unnamed.")] + self.base_names
        self.neutral = np.asarray(get_values(self.params, self.names), float)
        self.u = base.u
        drives = make_drives(FreeVehicle(result.plant, self.params, tuple(self.names)), result.log.training,
                             reference.width, gyro=reference.gyro)
        self.drives = drives.weighted(drives.simulate(self.neutral[None])[0], reference.factors, result.log.spec.track)
        weight = 0.01 * result.log.spec.mass * 9.81
        self.sizes = np.repeat([weight, weight * result.log.spec.track / 2], KNOTS)  # N, N m
        self.white = reference.whitener.flat
        self.target = self.white(reference.target_of(self.drives), self.drives.mask)

    def values(self, u: np.ndarray, table: WrenchTable | None = None, wrench: np.ndarray | None = None,
               start: float = 0.0) -> np.ndarray:
        """All replayed parameters at base coordinates and a table."""
        out = self.neutral.copy()
        out[len(out) - len(u) :] = self.result.reference.space.to_values(u)
        if table is not None and wrench is not None:
            for name, value in table.parameters(wrench, start).items():
                out[self.names.index(f"unnamed.{name}")] = value
        return out

    def residual(self, points: Sequence[tuple[np.ndarray, np.ndarray]], table: WrenchTable, phases: np.ndarray
                 ) -> np.ndarray:
        """(N, B, n) white residual of all training trials at base coordinates and wrenches, with each trial's turn."""
        turns = sorted(set(phases.tolist()))
        sets = [self.values(u, table, wrench, float(PHASES[turn])) for u, wrench in points for turn in turns]
        seen = self.drives.simulate(np.stack(sets)).reshape(len(points), len(turns), *self.drives.target.shape)
        chosen = seen[:, [turns.index(turn) for turn in phases.tolist()], np.arange(len(phases))]
        return np.stack([self.target - self.white(one, self.drives.mask) for one in chosen])

    def columns(self, table: WrenchTable, trials: Sequence[int]) -> np.ndarray:
        """(b, n, 2 KNOTS) change of the white features of some trials by each knot, per N and N m."""
        drives, mask = self.drives.of(tuple(self.drives.trials[i] for i in trials)), self.drives.mask[list(trials)]
        own = Quotients.forward(np.zeros(2 * KNOTS), self.sizes)
        sets = [self.values(self.u, table, row) for row in own.above]
        seen = drives.simulate(np.stack([self.values(self.u), *sets]))
        full = np.zeros((*mask.shape, 2 * KNOTS))
        full[:, : seen.shape[2]] = own.slopes(seen[1:], seen[0])
        return self.white(full, mask)


def find_unnamed(result: Result) -> Unnamed | None:
    """The wrench over one quantity that best predicts held-back manoeuvres, refitted to whole poses like the base
    model; None unless something is unexplained."""
    if result.search.verdict != "unexplained":
        return None
    found = fit_unnamed(UnnamedReplays(result))
    if not found.kept or not result.config.poses:
        return found
    if found.table.quantity in WHEELS:
        trials = result.log.training
        if len({one.start for one in trials}) < len(trials):  # without an outside pose nothing separates them
            names = list(result.reference.space.names)
            return replace(found, vehicle=set_values(found.vehicle, names, get_values(fitted_before(result), names)))
        plant = with_start_angles(result.plant, trials, found.angles)
        result = replace(result, prepared=replace(result.prepared, plant=plant))
    return replace(found, vehicle=refit_poses(result, found.vehicle))


def with_start_angles(plant: Plant, trials: Sequence[Trial], angles: np.ndarray) -> Plant:
    """A plant that places the wheels at each trial's own angle (B,), which it knows by where the trial starts."""
    starts = jnp.array([[one.start.x, one.start.y, one.start.yaw] for one in trials])
    turned = jnp.asarray(angles, starts.dtype)

    def place(params: Any, start: jnp.ndarray) -> Any:
        state = plant.place(params, start)
        mine = turned[jnp.square(starts - start[:3]).sum(-1).argmin()]
        memory, index = list(state.memory), [effect.name for effect in params.effects].index("unnamed")
        memory[index] = replace(memory[index], angle=mine + jnp.zeros(2))
        return replace(state, memory=tuple(memory))

    return replace(plant, place=place)


def fit_unnamed(bench: UnnamedReplays) -> Unnamed:
    """The same of any residual, before that refit."""
    result = bench.result
    groups = [list(group) for group in result.evidence.groups]
    if len(groups) < 3:  # too few manoeuvres to hold one back: trials are
        groups = [[i] for i in range(len(result.log.training))]
    residual, jacobian = result.search.base.residual, result.search.base.jacobian

    def table_fit(table: WrenchTable, trials: list[int], split: list[list[int]]) -> TableFit:
        columns, phases = turned(table, bench.columns(table, trials), residual[trials])
        products = multiplied(residual[trials], jacobian[trials], columns, split)
        gains, smoothing = held_back(products, result.evidence.precision, table)
        return TableFit(table, gains - price(table, split), smoothing, products, columns, phases)

    firsts, screened = [group[0] for group in groups], []
    sizes = [len(group) for group in groups]
    positions = [part.tolist() for part in np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])]
    for table in tables(result):
        chosen = firsts if table.quantity not in ROOM else sum(groups, [])
        split = [[i] for i in range(len(firsts))] if chosen is firsts else positions
        gain = float(table_fit(table, chosen, split).gains.sum())
        screened.append((gain * len(residual) / len(chosen), table))
    screened.sort(key=lambda one: -one[0])
    fitted = [table_fit(table, list(range(len(residual))), groups) for _, table in screened[:FINALISTS]]
    best = max(fitted, key=lambda one: float(one.gains.sum()))
    excess = max(result.search.excess[0], 1e-9) * float((bench.drives.mask > 0).sum())
    tried = [(one.table.quantity, one.table.kind, float(one.gains.sum()) / excess) for one in fitted]
    tried += [(table.quantity, table.kind, gain / excess) for gain, table in screened[FINALISTS:]]
    return _replayed(bench, best, groups, excess, tuple(sorted(tried, key=lambda one: -one[2])))


def tables(result: Result) -> list[WrenchTable]:
    """All wrenches that are tried, with the range that the drives cover."""
    trials = result.log.training
    motions = [trial.odometry or trial.command for trial in trials]
    ranges: dict[str, tuple[float, ...]] = {
        "time in the drive": (0.0, max(trial.duration for trial in trials)),
        "speed": _range(np.concatenate([one.v for one in motions])),
        "yaw rate": _range(np.concatenate([one.omega for one in motions])),
        **{name: (0.0, end) for name, end in REST_RANGE.items()}}
    seen = [trial.ground_truth for trial in trials if trial.ground_truth is not None]
    places = [_range(np.concatenate([getattr(one, name) for one in seen])) for name in "xy"] if seen else []
    if seen:
        ranges |= {"x in the room": places[0], "y in the room": places[1], MAP: (*places[0], *places[1])}
    found = [name for name in QUANTITIES if name not in ROOM or seen]
    return [WrenchTable(name, kind, *ranges.get(name, (0.0, 1.0))) for name in found for kind in KINDS]


def _range(series: np.ndarray) -> tuple[float, float]:
    """What nearly all of a quantity's values lie in."""
    low, high = np.quantile(series, [0.002, 0.998])
    return float(low), float(max(high, low + 0.05))


def price(table: WrenchTable, groups: Sequence[Sequence[int]]) -> np.ndarray:
    """(G,) what the trials of each group gain by a start angle of their own even where there is nothing."""
    return np.array([ANGLE_PRICE * len(group) for group in groups]) * (table.quantity in WHEELS)


def _replayed(
    bench: UnnamedReplays, best: TableFit, groups: Sequence[Sequence[int]], excess: float,
    tried: tuple[tuple[str, str, float], ...],
) -> Unnamed:
    """The best table, or the few terms that stand for it, brought to its optimum by replays."""
    result, precision, table = bench.result, bench.result.evidence.precision, best.table
    size, gains = len(precision), best.gains
    penalty, basis = penalties(best.products, precision, best.smoothing, table), np.eye(2 * KNOTS)
    chosen: tuple[Term, ...] = ()
    short = few_terms(best.products, precision, table)
    less = short[0] - price(table, groups)
    if less.sum() >= COMPACT * gains.sum():
        gains, chosen = less, short[1]
        basis, parts = columns_of(chosen, table.knots)
        penalty = np.zeros((size + basis.shape[1], size + basis.shape[1]))
        penalty[:size, :size] = precision
    columns = best.columns @ basis
    design, now = np.concatenate([result.search.base.jacobian, columns], axis=-1), result.search.base.residual
    start, free = np.concatenate([bench.u, np.zeros(basis.shape[1])]), np.full(basis.shape[1], np.inf)
    low, high = np.concatenate([np.zeros(size), -free]), np.concatenate([np.ones(size), free])
    solver = GaussNewton(BoxStep(-np.inf, np.inf, np.inf, ridge=1e-9), CHOICES, Patience(1e-3), (start, penalty),
                         damping=0.0, least=0.0, most=0.0)
    state = solver.init(start[None])._replace(cost=np.square(now).sum()[None])
    before = float(state.cost[0])
    for _ in range(ROUNDS):
        steps = solver.tries(state, *solver.normal(-now, design[None], state.u))
        steps = steps._replace(points=np.clip(steps.points, low, high))
        left = bench.residual([(one[:size], basis @ one[size:]) for one in steps.points[0]], table, best.phases)
        costs = np.square(left).sum((1, 2))
        after = solver.step(state, steps, costs[None])
        if solver.done(after).all():
            break
        state, now = after, left[np.nanargmin(costs)]
    u, wrench, cost = state.u[0, :size], state.u[0, size:], float(state.cost[0])
    coefficients = tuple(wrench[part] for part in parts) if chosen else ()
    more = 0.0
    if table.quantity in WHEELS:
        coefficients, more = from_first_wave(chosen, coefficients)
    full = columns_of(chosen, table.knots)[0] @ np.concatenate(coefficients) if chosen else basis @ wrench
    values = bench.values(u, table, full)
    vehicle = set_values(bench.params, bench.names, jnp.asarray(values, jnp.result_type(float)))
    count = float((bench.drives.mask > 0).sum())
    by_manoeuvre: dict[str, float] = {}
    for group, each in zip(groups, gains, strict=True):
        name = result.log.training[group[0]].manoeuvre
        by_manoeuvre[name] = by_manoeuvre.get(name, 0.0) + float(each)
    gain = float(gains.sum()) / excess
    kept = gain >= LEAST and gains.sum() >= LEAST_GAIN and before - cost > 0.5 * float(gains.sum())
    return Unnamed(table, full, chosen, coefficients, vehicle, gain, by_manoeuvre, (before / count, cost / count),
                   tried, PHASES[best.phases] + more, bool(kept))


def as_report(found: Unnamed) -> dict[str, Any]:
    """The fitted wrench for report.json: `quantity` and `kind` ("push", or "brake": it turns with the motion), `knots`,
    `values` and `units`, `symbolic` (sums of few terms in z, null where none is as good), `gain` on held-back
    manoeuvres, `cost` before and after, what else was `tried`, whether it is `kept`, and all `parameters` with it."""
    table, names = found.table, list(describe(found.vehicle))
    symbolic = {"force": in_words(found.terms, found.coefficients, 0),
                "torque": in_words(found.terms, found.coefficients, 1)} if found.terms else None
    return {
        "quantity": table.quantity, "kind": table.kind, "periodic": table.quantity in PERIODIC,
        "knots": table.knots.tolist(),
        "values": {"force": found.wrench[:KNOTS].tolist(), "torque": found.wrench[KNOTS:].tolist()},
        "units": {"quantity": QUANTITIES[table.quantity], "force": "N", "torque": "N m"}, "symbolic": symbolic,
        "gain": {"held_back": found.gain, "by_manoeuvre": found.by_manoeuvre},
        "cost": {"before": found.cost[0], "after": found.cost[1]},
        "tried": [{"quantity": quantity, "kind": kind, "gain": gain} for quantity, kind, gain in found.tried],
        "kept": found.kept,
        "parameters": dict(zip(names, np.asarray(get_values(found.vehicle, names), float).tolist(), strict=True)),
    }


def vehicle_of(result: Result, parameters: dict[str, float]) -> VehicleParams:
    """The base model with the effect `unnamed`, and with what a refit to poses added, at these values."""
    params = result.reference.params
    full = VehicleParams(params.body, (*params.effects, make_effect("unnamed")))
    more = dict.fromkeys(name.partition(".")[0] for name in parameters if name not in describe(full))
    full = with_effects(full, tuple(more))
    return set_values(full, list(parameters), jnp.asarray(list(parameters.values()), jnp.result_type(float)))


def replay_unnamed(result: Result, found: Unnamed, trials: tuple[Trial, ...]) -> list[Prediction]:
    """Replays of trials with the wrench; a wheel's start angle is that which fits each trial's reported speeds best."""
    batch, measured = make_batch(trials, result.plant.dt, RECORD_DT)
    replay = Replay(result.plant, batch, lambda values: set_values(found.vehicle, ["unnamed.start_angle"], values))
    seen = replay.simulate((PHASES if found.table.quantity in WHEELS else PHASES[:1])[:, None])
    error = np.square((np.asarray(seen.odometry) - measured.odometry) * measured.odometry_mask)[..., 3:]
    away = (error.sum(2) / np.maximum(np.square(result.reference.whitener.scale[:2]), 1e-12)).sum(-1)  # (G, B)
    best = away.argmin(0)
    row = np.arange(len(trials))
    return predictions(trials, type(seen)(*(np.asarray(leaf)[best, row] for leaf in (
        seen.pose, seen.odometry, seen.diverged))))
