"""The hypothesis of something that the catalogue does not have: smooth functions of what a motion has.

Each family is a Gaussian process with few columns: functions of speed, yaw rate, time, place, command or wheel angle.
Families that all drives share have one set of coefficients for each channel; the others have one for each drive or
manoeuvre. The unknown may also be correlated noise alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid.weighing.linear_model import Block, Model, Rows, Smooth, bumps, by_colour, log_sum, times
from sysid.weighing.priors import Setting
from sysid.weighing.saved_evidence import MOTION, Evidence

REST = 0.05  # m/s below which a vehicle rests: the sign of a speed must not be that of its noise
LAGS = 3  # bins over which the motion answers
HARMONICS = (1, 2, 3, 4, 6)  # of a wheel's angle
RINGING = (0.5, 0.8, 1.2, 1.6)  # Hz
DECAY = 1.5  # s, of a ringing
SETTINGS = 2  # of noise and day, the likeliest, at which families are compared
Own = tuple[np.ndarray, Sequence[Sequence[np.ndarray]]]
"""Columns (B, K, F), and in blocks of whole courses the drives that have one set of coefficients."""


@dataclass(frozen=True)
class Unknown:
    """Evidence of something unexplained, and by family."""

    log_evidence: float
    families: Mapping[str, float]


def families(evidence: Evidence) -> tuple[dict[str, np.ndarray], dict[str, Own]]:
    """Columns (B, K, F) of the families that all drives share, and those with coefficients of their own."""
    motion = dict(zip(MOTION, np.moveaxis(evidence.motion, -1, 0), strict=True))
    inside = motion["inside"][..., None]
    v, omega = (_of_courses(motion[name], evidence.course) for name in ("v", "omega"))
    bins = v.shape[1]
    t = np.broadcast_to((np.arange(bins) + 0.5) * evidence.width, v.shape)
    still = np.hypot(v, omega * evidence.track / 2) < REST
    moving, sign = (~still)[..., None], (np.sign(v) * (np.abs(v) > REST))[..., None]
    command = np.stack([motion["command_v"], motion["command_omega"]], -1)
    change = np.diff(command, axis=1, prepend=command[:, :1])
    speed = bumps(v, -1.0, 1.0, 8)
    late = (t / t.max())[..., None]
    shared = {
        "time": bumps(t, 0.0, 25.0, 8), "time while moving": bumps(t, 0.0, 25.0, 8) * sign * moving,
        "speed": speed, "yaw rate": bumps(omega, -1.0, 1.0, 8),
        "speed and yaw rate": _outer(bumps(v, -1.0, 1.0, 5), bumps(omega, -1.0, 1.0, 5)),
        "speed and time": np.concatenate([speed, speed * late, speed * late**2], -1),
        "command": np.concatenate([command, change, np.abs(command), command[..., :1] * command[..., 1:]], -1),
        "time since rest": bumps(_since(sign[..., 0], still, evidence.width), 0.0, 4.0, 8) * sign,
        "ringing after commands": _ringing(change, evidence.width)}
    if np.isfinite(motion["x"]).all():
        heading = motion["yaw"]
        waves = np.stack([np.sin(heading), np.cos(heading), np.sin(2 * heading), np.cos(2 * heading)], -1)
        shared["heading"] = np.concatenate([waves, waves * sign], -1)
        across = np.concatenate([bumps(motion[axis], -4.0, 4.0, 20) for axis in ("x", "y")], -1)
        shared["place"] = across * sign * moving
    shared = {name: each if name in ("place", "ringing after commands") else _with_lags(each)
              for name, each in shared.items()}
    shared = {name: each * inside for name, each in shared.items()}
    drives = [[np.array([b]) for b in np.flatnonzero(evidence.course == c)] for c in np.unique(evidence.course)]
    groups = [[np.flatnonzero(evidence.manoeuvre == g)] for g in range(int(evidence.manoeuvre.max()) + 1)]
    own: dict[str, Own] = {f"{side} wheel's angle": (_waves(motion[f"{side}_angle"]) * moving * inside, drives)
                           for side in ("left", "right")}
    own["each drive"] = bumps(t, 0.0, float(t.max()), 20) * inside, drives
    own["each manoeuvre"] = bumps(t, 0.0, float(t.max()), 40) * inside, groups
    return shared, own


def unknown(model: Model, residual: np.ndarray, beside: np.ndarray, precision: np.ndarray) -> Unknown:
    """Evidence of the smooth unknown beside columns (B, K, C, k) of prior precision (k, k)."""
    rows = np.concatenate([model.rows_of(beside), model.rows_of(residual)], axis=-1)
    plain: list[tuple[float, Setting]] = []
    for colour, group in by_colour(model.priors.settings(calm=False)):
        products = model.products(colour, rows)
        plain += [(model.solve(*products.after_bumps(one.day), one, precision).log_evidence, one) for one in group]
    plain.sort(key=lambda one: -one[0])
    found = {"correlated noise": [value for value, _ in plain]}
    chosen: dict[tuple[float, float], Setting] = {}
    for _, setting in plain:
        if len(chosen) < SETTINGS:
            chosen.setdefault((setting.colour, setting.day), setting)
    chosen.setdefault((0.0, 0.0), next(one for _, one in plain if (one.colour, one.day) == (0.0, 0.0)))
    shared, own = families(model.evidence)
    for setting in chosen.values():
        for name, value in _at(model, rows, precision, setting, shared, own):
            found.setdefault(name, []).append(value)
    each = {name: log_sum(values) for name, values in found.items()}
    return Unknown(log_sum(list(each.values())) - float(np.log(len(each))), each)


def _at(model: Model, rows: Rows, precision: np.ndarray, setting: Setting, shared: Mapping[str, np.ndarray],
        own: Mapping[str, Own]) -> Iterator[tuple[str, float]]:
    """Log evidence of each family at one setting of noise and day."""
    products = model.products(setting.colour, rows)
    target = model.whole_block(setting.colour, rows)
    stacked = np.concatenate(list(shared.values()), -1)
    blocks = [model.block(model.rows_of(stacked, channel)[None], setting.colour, channel)
              for channel in range(len(rows))]
    cross = [_after_bumps(model, block, channel, target, setting) for channel, block in enumerate(blocks)]
    start = 0
    for name, columns in shared.items():
        part = slice(start, start + columns.shape[-1])
        start = part.stop
        smooth = _turned([inside[part, part] for inside, _ in cross], [right[part] for _, right in cross])
        yield name, _over_amplitudes(model, products.after_bumps(setting.day), smooth, setting, precision)
    for name, (columns, groups) in own.items():  # these take the place of the day's bumps
        inside, right = [], []
        for block in groups:
            together = np.isin(np.arange(len(columns)), np.concatenate(block))  # their rows are turned together
            mine = np.zeros((*columns.shape[:2], len(block), columns.shape[-1]))
            for place, drives in enumerate(block):
                mine[drives, :, place] = columns[drives]
            mine = mine.reshape(*columns.shape[:2], -1)
            for channel in range(len(rows)):
                each = model.coloured(model.rows_of(mine, channel)[together], setting.colour)
                inside.append(times(each, each))
                right.append(times(each, target.rows[channel, together]))
        yield name, _over_amplitudes(model, (products.matrix, products.log_det), _turned(inside, right), setting,
                                    precision)


def _after_bumps(model: Model, block: Block, channel: int, target: Block, setting: Setting
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Products (F, F) of a channel's kernel columns and (F, m) with the others, with the day's bumps integrated out."""
    values = model.bump_values(setting.colour)[channel].reshape(-1)
    share = (setting.day**2 / (1 + setting.day**2 * values))[:, None]
    mine, theirs = (one.reshape(-1, one.shape[-1]) for one in (block.bumps, target.bumps[channel]))
    return (times(block.rows, block.rows) - (share * mine).T @ mine,
            times(block.rows, target.rows[channel]) - (share * mine).T @ theirs)


def _turned(inside: Sequence[np.ndarray], right: Sequence[np.ndarray]) -> Smooth:
    """Independent sets of columns along the eigenvectors of their products."""
    along = [np.linalg.eigh(one) for one in inside]
    return Smooth(np.concatenate([np.maximum(values, 0.0) for values, _ in along]),
                  np.concatenate([turn.T @ one for (_, turn), one in zip(along, right, strict=True)]))


def _over_amplitudes(model: Model, products: tuple[np.ndarray, float], smooth: Smooth, setting: Setting,
                     precision: np.ndarray) -> float:
    matrix, log_bumps = products
    values = []
    for amplitude, weight in model.priors.kernel:
        less, log_det = smooth.integrated(amplitude)
        solved = model.solve(matrix - less, log_bumps + log_det, setting, precision)
        values.append(solved.log_evidence + float(np.log(weight)))
    return log_sum(values)


def _with_lags(design: np.ndarray) -> np.ndarray:
    """(B, K, F LAGS) the functions now and in the bins before."""
    return np.concatenate([np.pad(design, ((0, 0), (lag, 0), (0, 0)))[:, : design.shape[1]] for lag in range(LAGS)], -1)


def _outer(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:2], -1)


def _waves(angle: np.ndarray) -> np.ndarray:
    """(B, K, 2 H) harmonics of a wheel's angle."""
    return np.stack([wave(k * angle) for k in HARMONICS for wave in (np.sin, np.cos)], -1)


def _of_courses(series: np.ndarray, course: np.ndarray) -> np.ndarray:
    """(B, K) mean over the replicates of each drive: less of a drive's own noise."""
    out = np.empty_like(series)
    for number in np.unique(course):
        out[course == number] = series[course == number].mean(0)
    return out


def _since(sign: np.ndarray, still: np.ndarray, width: float) -> np.ndarray:
    """(B, K) time since rest or reversal [s]."""
    turned = sign != np.concatenate([sign[:, :1], sign[:, :-1]], axis=1)
    out = np.zeros(sign.shape)
    for k in range(1, sign.shape[1]):
        out[:, k] = np.where(still[:, k] | turned[:, k], 0.0, out[:, k - 1] + width)
    return out


def _ringing(change: np.ndarray, width: float) -> np.ndarray:
    """(B, K, 4 R) decaying oscillations that changes of the two commands (B, K, 2) start."""
    bins, parts = change.shape[1], []
    t = np.arange(bins) * width
    for frequency in RINGING:
        for wave in (np.sin, np.cos):
            answer = np.exp(-t / DECAY) * wave(2 * np.pi * frequency * t)
            lower = np.tril(answer[np.abs(np.subtract.outer(np.arange(bins), np.arange(bins)))])
            parts.append(lower @ change)
    return np.concatenate(parts, -1)
