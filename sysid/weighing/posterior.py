"""Posterior weights over what a vehicle is missing: nothing, one or two effects, or something unknown.

`posterior(evidence, priors)` is a pure function of a saved file. The residual of all drives is explained by the base
parameters within their spread, by what a day adds anyway (bumps in time, apparent effects), by noise of a fitted size,
and by one of

    none         nothing else
    a set        one or two effects of the catalogue, of unknown size, each with an error of its form
    unknown      a smooth function that knows no physics, or correlated noise

Each set is weighed by its evidence: the probability of the drives with its sizes and all of the above integrated out.
Where the evidence holds a nonlinear refit of a set (`Point`), the set is weighed there, otherwise along the response
curve of the simulated sizes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from sysid.weighing.linear_model import Fit, Model, by_colour, log_sum
from sysid.weighing.priors import DEFAULT, Priors, Setting
from sysid.weighing.saved_evidence import Effect, Evidence, Point
from sysid.weighing.smooth_unknown import unknown

GATE = 8.0
"""Log evidence over nothing, of a single effect without form errors, from which sets are refitted."""
FULL = 6
"""Effects that are weighed with form errors, best first."""
Keys = tuple[str, ...]


@dataclass(frozen=True)
class Line:
    """A straight piece of an effect's response: offset + columns z, z ~ N(0, diag(deviation^2))."""

    key: str
    columns: tuple[int, ...]
    """Of the evidence, at the larger size."""
    lower: tuple[int, ...]
    """The same at the smaller size; empty where the line starts at 0 without an offset."""
    deviation: np.ndarray  # (k,)
    start: np.ndarray  # (k,) q at z = 0
    slope: np.ndarray  # (k,) change of q per z
    positive: np.ndarray  # (k,) bool: q must not be negative
    price: float
    """Log of the number of lines of this effect."""

    def on_side(self, z: np.ndarray, deviation: np.ndarray) -> float:
        """Log of how much likelier the drives make a q of the right sign, z (k,) with a standard deviation (k,)."""
        return right_sign(self.start + self.slope * z, self.slope * deviation, self.start, self.slope * self.deviation,
                          self.positive)


@dataclass(frozen=True)
class Weighed:
    """One set of effects with its evidence."""

    keys: Keys
    log_evidence: float
    q: np.ndarray
    deviation: np.ndarray
    """Standard deviation of q."""
    parts: tuple[int, ...]
    """Number of coordinates of each effect."""
    refitted: bool

    def of(self, place: int) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of one effect and their standard deviations."""
        part = slice(sum(self.parts[:place]), sum(self.parts[: place + 1]))
        return self.q[part], self.deviation[part]


@dataclass(frozen=True)
class Posterior:
    """Log evidence of every hypothesis."""

    none: float
    sets: tuple[Weighed, ...]
    """Best first."""
    unknown: float
    beside: float
    """Of the best set and the smooth unknown together."""
    families: dict[str, float]
    """Log evidence of the smooth unknown by what it is a function of."""
    noise: np.ndarray  # (C,) noise of each channel over that of the reference
    noise_low: np.ndarray
    noise_high: np.ndarray

    @property
    def quiet(self) -> float:
        """Factor on nats over nothing. Quieter sensors show more of what days differ by, but that is no larger."""
        return float(min(1.0, np.exp(np.log(self.noise_high).mean())) ** 2)

    @property
    def score(self) -> float:
        """How much better than nothing the best explanation is [nats]: the one number that a threshold decides on."""
        best = self.sets[0].log_evidence if self.sets else -np.inf
        return self.quiet * (max(best, self.unknown) - self.none)


def posterior(evidence: Evidence, priors: Priors = DEFAULT) -> Posterior:
    """Weights over what is missing."""
    noise, low, high = noise_factors(evidence, priors)
    model = Model(evidence, priors, *noise_levels(evidence, noise))
    none = model.fit(np.zeros((*evidence.mask.shape, 0)), np.zeros((0, 0)), evidence.residual)
    sets = weighed_sets(model, none)
    sets.sort(key=lambda one: -one.log_evidence)
    nothing = np.zeros((*evidence.mask.shape, 0))
    smooth = unknown(model, evidence.residual, nothing, np.zeros((0, 0)))
    beside = sets[0].log_evidence if sets else none.log_evidence
    point = next((one for one in evidence.points if sets and one.keys == sets[0].keys), None)
    if point is not None and sets[0].log_evidence > max(smooth.log_evidence, none.log_evidence + GATE):
        columns, precision, residual, price = near(model, point)
        bent = form_errors(evidence, point.responses)
        whole = np.diag(np.concatenate([precision, np.full(bent.shape[-1], 0.3**-2)]))
        beside = price + unknown(model, residual, np.concatenate([columns, bent], -1), whole).log_evidence
    return Posterior(none.log_evidence, tuple(sets), smooth.log_evidence, beside, dict(smooth.families), noise, low,
                     high)


def weighed_sets(model: Model, none: Fit) -> list[Weighed]:
    """The best single effects and all refitted sets."""
    evidence = model.evidence
    chosen: dict[str, tuple[Line, float, np.ndarray]] = {}
    for value, line, z in screen(model, evidence.residual, none.setting):
        chosen.setdefault(line.key, (line, value, z))
    points = {point.keys: point for point in evidence.points}
    sets = [at_point(model, point) for point in points.values()]
    for key, (line, _, z) in list(chosen.items())[:FULL]:
        if (key,) not in points:
            sets.append(at_point(model, along_line(model, line, z), refitted=False))
    return sets


def lines(effect: Effect, priors: Priors) -> Iterator[Line]:
    """Straight pieces of an effect's response curve: between simulated sizes, and from 0 to each of them."""
    count = 1 if len(effect.levels) == 1 else 2 * len(effect.levels) - 1
    dependent = np.array([axis.dependent for axis in effect.axes])
    positive = np.array([not axis.signed for axis in effect.axes])
    shift = np.where(dependent, 0.0, 1.0)
    for number, (level, columns) in enumerate(zip(effect.levels, effect.columns, strict=True)):
        size = np.where(dependent, priors.dependent, priors.size) / level
        yield Line(effect.key, columns, (), size, 0 * size, np.full(len(columns), level), positive,
                   float(np.log(count)))
        if number > 0:
            before = effect.levels[number - 1]
            yield Line(effect.key, columns, effect.columns[number - 1], np.where(dependent, size, 0.6),
                       shift * (before + level) / 2, np.where(dependent, level, level - before), positive,
                       float(np.log(count)))


def line_columns(evidence: Evidence, line: Line) -> tuple[np.ndarray, np.ndarray]:
    """Columns (B, K, C, k) of a line and its offset (B, K, C)."""
    upper = evidence.columns[..., list(line.columns)]
    if not line.lower:
        return upper, np.zeros(evidence.mask.shape)
    lower = evidence.columns[..., list(line.lower)]
    moves = line.start > 0
    return upper - lower * moves, 0.5 * (upper + lower)[..., moves].sum(-1)


def screen(model: Model, residual: np.ndarray, likely: Setting, fixed: np.ndarray | None = None,
           precision: np.ndarray | None = None) -> list[tuple[float, Line, np.ndarray]]:
    """Every line of every effect by its log evidence without form errors, best first, with its coordinates z.

    Args:
        fixed: columns (B, K, C, f) of effects that are there already, of prior precision (f, f).
    """
    evidence, priors = model.evidence, model.priors
    fixed = np.zeros((*evidence.mask.shape, 0)) if fixed is None else fixed
    precision = np.zeros((0, 0)) if precision is None else precision
    columns = np.concatenate([fixed, evidence.columns], axis=-1)
    extra = np.concatenate([model.rows_of(columns), model.rows_of(residual)], axis=-1)
    settings = [Setting(0.0, 0.0, 0.3, 0.0), Setting(0.1, 0.15, 0.3, 0.0), likely]
    listed = [line for effect in evidence.effects for line in lines(effect, priors)]
    values: list[list[float]] = [[] for _ in listed]
    best: list[tuple[float, np.ndarray]] = [(-np.inf, np.zeros(0))] * len(listed)
    for colour, group in by_colour(settings):
        products = model.products(colour, extra)
        for setting in group:
            matrix, log_det = products.after_bumps(setting.day)
            square, inside, moments, log_det = _eliminated(model, matrix, log_det, setting, precision)
            for number, line in enumerate(listed):
                less, own, z = _line_evidence(inside, moments, line)
                value = model.student(square - less) - 0.5 * (log_det + own) + setting.weight - line.price
                values[number].append(value)
                if value > best[number][0]:
                    best[number] = value, z
    found = [(log_sum(value), line, z) for value, line, (_, z) in zip(values, listed, best, strict=True)]
    return sorted(found, key=lambda one: -one[0])


def along_line(model: Model, line: Line, z: np.ndarray) -> Point:
    """The linearisation of a single effect on a line, at its coordinates z (k,), in place of a refit."""
    columns, offset = line_columns(model.evidence, line)
    by_q = columns / line.slope
    return Point((line.key,), line.start + line.slope * z, model.evidence.residual - offset + by_q @ line.start, by_q,
                 (offset + columns @ z)[..., None])


def at_point(model: Model, point: Point, refitted: bool = True) -> Weighed:
    """A set near the sizes where it was linearised, with errors of the form of each effect.

    Sizes are integrated over within `priors.reach` of them, with the prior density there: a linearisation says nothing
    of other sizes, and errors of form are shares of the response at these.
    """
    columns, precision, residual, price = near(model, point)
    axes = [axis for key in point.keys for axis in model.evidence.effect(key).axes]
    main = np.array([not axis.dependent for axis in axes])
    fit = with_forms(model, columns, np.diag(precision), residual, point.responses)
    mean = np.where(main, point.q, 0.0) + fit.mean[: len(axes)]
    deviation = np.sqrt(np.diag(fit.covariance)[: len(axes)])
    shaped = ~main & np.array([not axis.signed for axis in axes])
    value = fit.log_evidence + price + right_sign(mean, deviation, 0 * mean, precision**-0.5, shaped)
    parts = tuple(len(model.evidence.effect(key).axes) for key in point.keys)
    return Weighed(point.keys, value, mean, deviation, parts, refitted)


def near(model: Model, point: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Columns (B, K, C, k) of a set, their prior precision (k,), the residual (B, K, C) at their prior mean, and the
    log of the prior there."""
    priors = model.priors
    axes = [axis for key in point.keys for axis in model.evidence.effect(key).axes]
    main = np.array([not axis.dependent for axis in axes])
    owner = np.array([place for place, key in enumerate(point.keys) for _ in model.evidence.effect(key).axes])
    size = np.sqrt(np.array([np.square(point.q[main & (owner == o)]).sum() for o in owner]))
    radius = np.where(main, np.maximum(priors.reach * size, 0.05), priors.dependent)
    centre = np.where(main, point.q, 0.0)
    density = -np.log(np.pi * priors.size * (1 + np.square(point.q / priors.size)) / (np.sqrt(2 * np.pi) * radius))
    density += np.log([1.0 if axis.signed else 2.0 for axis in axes])
    price = float(np.minimum(density, 0.0)[main].sum()) - _set_price(model, len(point.keys))
    return point.columns, radius**-2.0, point.residual - point.columns @ centre, price


def with_forms(model: Model, columns: np.ndarray, precision: np.ndarray, residual: np.ndarray, responses: np.ndarray
               ) -> Fit:
    """Evidence of a set with errors of its form, of one relative size for all its effects."""
    bent = form_errors(model.evidence, responses)
    values, best = [], None
    for share, weight in model.priors.form:
        prior = np.zeros((columns.shape[-1] + bent.shape[-1],) * 2)
        prior[: len(precision), : len(precision)] = precision
        place = np.arange(len(precision), len(prior))
        prior[place, place] = share**-2
        fit = model.fit(np.concatenate([columns, bent], -1), prior, residual)
        values.append(fit.log_evidence + float(np.log(weight)))
        if best is None or fit.log_evidence > best.log_evidence:
            best = fit
    assert best is not None
    return Fit(log_sum(values), best.setting, best.mean, best.covariance, best.variance)


def form_errors(evidence: Evidence, responses: np.ndarray) -> np.ndarray:
    """(B, K, C, m) what effects change, `responses` (B, K, C, e), in other forms: in proportion to speed and turning,
    of a size of its own in each manoeuvre, earlier or later."""
    v, omega = evidence.motion[..., 1], evidence.motion[..., 2]
    factors = []
    for series in (v, omega):
        scaled = np.clip(series / max(float(np.quantile(np.abs(series), 0.9)), 1e-6), -2.0, 2.0)
        factors += [scaled, np.abs(scaled)]
    groups = int(evidence.manoeuvre.max()) + 1
    factors += [np.broadcast_to((evidence.manoeuvre == g)[:, None], v.shape) for g in range(groups)]
    early, late = np.zeros_like(responses), np.zeros_like(responses)
    early[:, :-1], late[:, 1:] = responses[:, 1:], responses[:, :-1]
    parts = [responses * one[..., None, None] for one in factors]
    return np.concatenate([*parts, (early - late) / 2, early + late - 2 * responses], axis=-1)


def proposals(evidence: Evidence, priors: Priors = DEFAULT, singles: int = 4, pairs: int = 3
              ) -> list[tuple[Keys, np.ndarray]]:
    """Sets worth a nonlinear refit next, and where it starts: first single effects, then what joins the best of them.

    Empty where everything worth it is in the evidence.
    """
    model = Model(evidence, priors, *noise_levels(evidence, noise_factors(evidence, priors)[0]))
    none = model.fit(np.zeros((*evidence.mask.shape, 0)), np.zeros((0, 0)), evidence.residual)
    done = {point.keys for point in evidence.points}
    if not done:
        screened = screen(model, evidence.residual, none.setting)
        if screened[0][0] - none.log_evidence < GATE:
            return []
        ranked = _by_effect(evidence, screened, set())
        return [((line.key,), line.start + line.slope * z) for line, z in ranked[:singles]]
    if any(len(keys) > 1 for keys in done):
        return []
    best = sorted((at_point(model, point) for point in evidence.points), key=lambda one: -one.log_evidence)[:2]
    out: list[tuple[Keys, np.ndarray]] = []
    for first, most in zip(best, (pairs, 1), strict=False):
        point = next(one for one in evidence.points if one.keys == first.keys)
        bent = form_errors(evidence, point.responses)
        fixed = np.concatenate([point.columns, bent], -1)
        precision = np.diag(np.concatenate([np.full(len(point.q), priors.size**-2), np.full(bent.shape[-1], 0.3**-2)]))
        ranked = _by_effect(evidence, screen(model, point.residual, none.setting, fixed, precision),
                            {evidence.effect(first.keys[0]).name})
        for line, z in ranked[:most]:
            if not any(set(keys) == {first.keys[0], line.key} for keys, _ in out):
                out.append(((first.keys[0], line.key), np.concatenate([point.q, line.start + line.slope * z])))
    return out


def noise_factors(evidence: Evidence, priors: Priors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise of each channel over that of the reference, with a 95 % interval.

    From what replicates do not share, where both have replicates: no model is needed. Otherwise from second
    differences in time, which what is missing hardly changes.
    """
    mine, theirs = own_noise(evidence.residual, evidence.mask, evidence.course), reference_noise(evidence)
    log_factor = np.log(mine[0] / theirs[0])
    deviation = np.sqrt(mine[1] ** 2 + theirs[1] ** 2)
    low, high = (np.exp(log_factor + sign * 1.96 * deviation) for sign in (-1, 1))
    return np.clip(np.exp(log_factor), *priors.noise_range), low, high


def noise_levels(evidence: Evidence, factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation (C,) of what each drive has by itself, and of what replicates share: the model's error, which
    does not grow with the sensors' noise and is that of the reference days."""
    own = reference_noise(evidence)[0]
    whole = np.square(evidence.pool).sum((0, 1)) / np.maximum((evidence.pool != 0).sum((0, 1)), 1)
    return factors * own, np.sqrt(np.maximum(whole - own**2, 0.0))


def reference_noise(evidence: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """`own_noise` of the reference days."""
    return own_noise(evidence.pool, (evidence.pool != 0).astype(float), evidence.pool_course)


def own_noise(rows: np.ndarray, mask: np.ndarray, course: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Noise (C,) of rows (B, K, C), and the standard deviation of its logarithm."""
    squares = []
    for number in np.unique(course):
        mine = rows[course == number]
        if len(mine) > 1:
            whole = mask[course == number].min(0)
            square = np.square((mine - mine.mean(0)) * whole).sum(1) / np.maximum(whole.sum(0), 1)  # (n, C)
            squares += [square.sum(0) / (len(mine) - 1)] * (len(mine) - 1)
    if len(squares) >= 5:
        each = np.stack(squares)
        return np.sqrt(each.mean(0)), each.std(0) / each.mean(0) / np.sqrt(len(each)) / 2
    second = np.diff(rows, 2, axis=1)
    size = np.median(np.abs(second), axis=(0, 1)) / 0.6745 / np.sqrt(6.0)
    return np.maximum(size, 1e-3), np.full(rows.shape[-1], 0.1)


def _by_effect(evidence: Evidence, screened: Sequence[tuple[float, Line, np.ndarray]], taken: set[str]
               ) -> list[tuple[Line, np.ndarray]]:
    """The best line of each effect, best first; effects in `taken` are left out."""
    seen = set(taken)
    out = []
    for _, line, z in screened:
        name = evidence.effect(line.key).name
        if name not in seen:
            seen.add(name)
            out.append((line, z))
    return out


def _eliminated(model: Model, matrix: np.ndarray, log_det: float, setting: Setting, own: np.ndarray
                ) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Square, products and moments of the effects' columns with base, wander and own columns integrated out."""
    prior, kept = model.prior(setting.wander, own)
    rest = np.arange(model.base.shape[-1] + len(own), len(matrix))
    inside = matrix[np.ix_(kept, kept)]
    factor = np.linalg.cholesky(inside + prior + 1e-9 * np.diag(np.diag(inside) + 1e-9))
    half = np.linalg.solve(factor, matrix[np.ix_(kept, rest)])
    left = matrix[np.ix_(rest, rest)] - half.T @ half
    log_det += 2 * float(np.log(np.diag(factor)).sum()) - float(np.linalg.slogdet(prior)[1])
    return float(left[-1, -1]), left[:-1, :-1], left[:-1, -1], log_det


def _line_evidence(inside: np.ndarray, moments: np.ndarray, line: Line) -> tuple[float, float, np.ndarray]:
    """What a line takes from the square, its log determinant, and its coordinates."""
    upper, size = list(line.columns), len(line.columns)
    turn = np.zeros((size + len(line.lower), size))
    turn[:size] = np.eye(size)
    offset = np.zeros(size + len(line.lower))
    if line.lower:
        moves = (line.start > 0).astype(float)
        turn[size:] = -np.diag(moves)
        offset = 0.5 * np.concatenate([moves, moves])
    place = [*upper, *line.lower]
    part, right = inside[np.ix_(place, place)], moments[place]
    less = float(2 * offset @ right - offset @ part @ offset)
    right = turn.T @ (right - part @ offset)
    part = turn.T @ part @ turn
    whole = part + np.diag(line.deviation**-2.0)
    covariance = np.linalg.inv(whole)
    z = covariance @ right
    log_det = float(np.linalg.slogdet(whole)[1]) + 2 * float(np.log(line.deviation).sum())
    return less + float(right @ z), log_det - 2 * line.on_side(z, np.sqrt(np.diag(covariance))), z


def right_sign(mean: np.ndarray, deviation: np.ndarray, prior: np.ndarray, prior_deviation: np.ndarray,
               positive: np.ndarray) -> float:
    """Log of posterior over prior probability that sizes (k,) which must be positive are."""
    inside = log_ndtr(mean / deviation) - log_ndtr(prior / prior_deviation)
    return float(inside[positive].sum())


def _set_price(model: Model, effects: int) -> float:
    """Log of the number of sets of so many effects."""
    return effects * float(np.log(max(len(model.evidence.effects), 1)))
