"""Everything the verdict needs from the simulator, as small matrices.

The white residual of the drives, the columns by which base parameters change it and those by which each hypothesis
does are multiplied with each other once, trial by trial. Fits, tests between trials, held-back manoeuvres and
thousands of simulated nulls are then algebra on these products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.errors.noise import repeated
from sysid.logs.log import Trial
from sysid.missing.catalogue import LEVELS, Hypothesis, base_values
from sysid.missing.drives import Drives
from sysid.missing.reference import Leftover, Reference, alike, difference_sizes
from sysid.search.result import Progress
from whill_mjx.vehicle.types import VehicleParams

UNSEEN = 1e-3  # change by an axis that only acts through others, as a share of theirs, below which it does nothing
PARTS = 10  # in which signatures are simulated, for the progress bar


@dataclass(frozen=True)
class Columns:
    """Where the columns of one hypothesis at one level are."""

    hypothesis: int
    level: float
    index: tuple[int, ...]


@dataclass(frozen=True)
class Evidence:
    """White residual d and columns X = [base | hypotheses] of B trials, and their products."""

    residual: np.ndarray  # (B, n)
    design: np.ndarray  # (B, n, P + S)
    base_size: int
    columns: tuple[Columns, ...]
    precision: np.ndarray  # (P, P) of the base parameters, in unit coordinates
    products: np.ndarray  # (B, P + S, P + S)
    moments: np.ndarray  # (B, P + S)
    pool_moments: tuple[np.ndarray, ...]  # per trial (J, P + S) of white noise of J drives like it
    groups: tuple[tuple[int, ...], ...]  # trials of one manoeuvre
    shared: float = 0.0
    """Share of a drive's noise that the others of its manoeuvre have as well (`Reference.shared`)."""


def base_columns(drives: Drives, reference: Reference, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(B, K, C, P) derivative of the features by the base parameters' unit coordinates."""
    space = reference.space

    def sets(u: np.ndarray) -> np.ndarray:
        row = values.copy()
        row[[names.index(name) for name in space.names]] = space.to_values(u)
        return row

    return drives.differences(sets, reference.u, difference_sizes(reference.spread))


def signature_columns(
    drives: Drives, hypotheses: Sequence[Hypothesis], values: np.ndarray, names: Sequence[str], at: np.ndarray,
    progress: Progress | None = None,
) -> tuple[np.ndarray, list[Columns]]:
    """(B, K, C, S) change of the features per unit of each coordinate, and which column is which.

    Two-sided axes: central differences at 1. One-sided: the change at each level, per unit; of those that only change
    what the others do, against the others alone.
    """
    base = dict(zip(names, values.tolist(), strict=True))
    sets: list[np.ndarray] = []
    jobs: list[tuple[int, float, int, float]] = []
    for number, one in enumerate(hypotheses):
        for level in ((1.0,) if one.signed else LEVELS):
            for position, axis in enumerate(one.axes):
                q = np.zeros(len(one.axes))
                if axis.dependent:
                    q[one.main] = level
                top = 1.0 if axis.signed else min(level, axis.limit)
                bottom = -1.0 if axis.signed else 0.0
                for size in (top, bottom) if axis.signed or axis.dependent else (top,):
                    q[position] = size
                    sets.append(with_values(values, names, one.values(q, base)))
                jobs.append((number, level, position, top - bottom))
    seen = []
    for part in np.array_split(np.stack(sets), min(PARTS, len(sets))):
        seen.append(drives.simulate(part))
        if progress is not None:
            progress(1, "signatures")
    flat, cursor = np.concatenate(seen), 0
    parts, columns = [], []
    for number, level, position, span in jobs:
        axis = hypotheses[number].axes[position]
        pair = axis.signed or axis.dependent
        change = flat[cursor] - (flat[cursor + 1] if pair else at)
        if axis.dependent and np.abs(change).max() < UNSEEN * np.abs(flat[cursor] - at).max():
            change = flat[cursor] - at  # nothing tells the two apart here: not a column of its own
        parts.append(change / span)
        cursor += 2 if pair else 1
        if position == 0:
            columns.append(Columns(number, level, ()))
        columns[-1] = Columns(number, level, (*columns[-1].index, len(parts) - 1))
    return np.stack(parts, axis=-1), columns


def column_layout(hypotheses: Sequence[Hypothesis], offset: int) -> tuple[Columns, ...]:
    """Which columns `gather` makes, behind those of `offset` base parameters."""
    found = []
    for number, one in enumerate(hypotheses):
        for level in (1.0,) if one.signed else LEVELS:
            found.append(Columns(number, level, tuple(range(offset, offset + len(one.axes)))))
            offset += len(one.axes)
    return tuple(found)


def with_values(values: np.ndarray, names: Sequence[str], changes: dict[str, float]) -> np.ndarray:
    """Values (P,) with some of them replaced."""
    out = values.copy()
    for name, value in changes.items():
        out[names.index(name)] = value
    return out


def gather(
    drives: Drives, reference: Reference, hypotheses: Sequence[Hypothesis], full: VehicleParams,
    progress: Progress | None = None, pools: bool = True,
) -> tuple[Evidence, np.ndarray]:
    """Simulate and multiply out; also returns the base's derivatives (B, K, C, P).

    `full` is the vehicle with the catalogue; `drives` free all its parameters. `pools`: with noise for simulated nulls.
    """
    base = base_values(full)
    names = list(drives.names)
    values = np.array([base[name] for name in names])
    at = drives.simulate(values[None])[0]
    slopes = base_columns(drives, reference, values, names)
    signatures, columns = signature_columns(drives, hypotheses, values, names, at, progress)
    white = reference.whitener
    residual = white.apply(reference.target_of(drives) - at, drives.mask)
    design = white.apply(np.concatenate([slopes, signatures], axis=-1), drives.mask)
    count, size = len(residual), residual[0].size
    residual, design = residual.reshape(count, size), design.reshape(count, size, -1)
    pool = [_pool(reference, trial, drives.mask[i]) for i, trial in enumerate(drives.trials)] if pools else []
    offset = reference.space.size
    placed = tuple(Columns(c.hypothesis, c.level, tuple(offset + i for i in c.index)) for c in columns)
    evidence = Evidence(
        residual, design, offset, placed, np.linalg.inv(reference.spread),
        np.einsum("bni,bnj->bij", design, design, optimize=True), np.einsum("bni,bn->bi", design, residual),
        tuple(noise @ design[i] for i, noise in enumerate(pool)), manoeuvre_groups(drives),
        reference.shared)
    return evidence, slopes


def at_fit(evidence: Evidence, residual: np.ndarray, jacobian: np.ndarray, moved: np.ndarray) -> Evidence:
    """The evidence after a fit of the base and of some coordinates, which join the base.

    Args:
        residual: (B, n) white residual there.
        jacobian: (B, n, P + k) of the white features there.
        moved: (P,) how far the base parameters are from the reference.
    """
    size, extra = evidence.base_size, jacobian.shape[-1] - evidence.base_size
    residual = residual + jacobian[..., :size] @ moved
    design = np.concatenate([jacobian, evidence.design[..., size:]], axis=-1)
    precision = np.zeros((size + extra, size + extra))
    precision[:size, :size] = evidence.precision
    columns = tuple(replace(c, index=tuple(i + extra for i in c.index)) for c in evidence.columns)
    return replace(evidence, residual=residual, design=design, base_size=size + extra, columns=columns,
                   precision=precision, products=np.einsum("bni,bnj->bij", design, design, optimize=True),
                   moments=np.einsum("bni,bn->bi", design, residual))


def manoeuvre_groups(drives: Drives) -> tuple[tuple[int, ...], ...]:
    """Trials of one manoeuvre, in order of first appearance; single windows of a long drive are put into eighths."""
    names: dict[str, list[int]] = {}
    for i, trial in enumerate(drives.trials):
        names.setdefault(trial.manoeuvre, []).append(i)
    if len(names) > 40 or len(names) < len(drives.trials) and not repeated(drives.trials):
        parts = np.array_split(np.arange(len(drives.trials)), 8)
        return tuple(tuple(int(i) for i in part) for part in parts)
    return tuple(tuple(each) for each in names.values())


def _pool(reference: Reference, trial: Trial, mask: np.ndarray) -> np.ndarray:
    """(J, n) white noise of reference drives of the same manoeuvre; of any manoeuvre where there are few."""
    like = [one for one in reference.leftovers if alike(one.trial, trial)]
    if len(like) < 3:
        same = [one for one in reference.leftovers if one.trial.manoeuvre == trial.manoeuvre]
        like = same if len(same) >= 3 else list(reference.leftovers)
    return np.stack([white_leftover(reference, one, mask) for one in like])


def white_leftover(reference: Reference, one: Leftover, mask: np.ndarray) -> np.ndarray:
    """(n,) white noise of a reference drive, put into the bins of another drive of weights `mask` (K, C)."""
    series = (one.series - reference.expected_on_others(one)) * one.mask
    inside = np.flatnonzero(one.mask.prod(-1) > 0)
    last = inside[-1] + 1 if len(inside) else len(series)
    fitted = np.resize(series[:last], mask.shape)  # a longer drive repeats a shorter one's noise
    return reference.whitener.apply(fitted[None], (mask > 0).astype(float)[None]).reshape(-1)
