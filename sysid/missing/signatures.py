"""What the simulator adds to the evidence: how base parameters and each hypothesis change the drives."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from sysid.logs.records import Trial
from sysid.logs.replicates import same_course
from sysid.missing.catalogue import Axis, Hypothesis, base_values
from sysid.missing.days import Leftover, Reference, alike, difference_sizes
from sysid.missing.drives import Drives
from sysid.missing.evidence import Evidence, column_layout, with_values
from sysid.search.result import Progress
from whill_mjx.io.steps import step
from whill_mjx.vehicle.types import VehicleParams

UNSEEN = 1e-3  # change by an axis that only acts through others, as a share of theirs, below which it does nothing
PARTS = 10  # in which signatures are simulated, for the progress bar


def base_columns(drives: Drives, reference: Reference, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(B, K, C, P) derivative of the features by the base parameters' unit coordinates."""
    space = reference.space

    def sets(u: np.ndarray) -> np.ndarray:
        row = values.copy()
        row[[names.index(name) for name in space.names]] = space.to_values(u)
        return row

    return drives.linearised(sets, reference.u, difference_sizes(reference.spread))[1]


def _simulated(drives: Drives, sets: np.ndarray) -> list[np.ndarray]:
    return [drives.simulate(sets)]


def signature_columns(
    drives: Drives, hypotheses: Sequence[Hypothesis], values: np.ndarray, names: Sequence[str], at: np.ndarray,
    progress: Progress | None = None,
) -> np.ndarray:
    """(B, K, C, S) change of the features per unit of each coordinate, in the order of `column_layout`.

    Two-sided axes: central differences at 1. One-sided: the change at each level, per unit; of those that only change
    what the others do, against the others alone.
    """
    base = dict(zip(names, values.tolist(), strict=True))
    sets: list[np.ndarray] = []
    jobs: list[tuple[Axis, bool, float]] = []
    for columns in column_layout(hypotheses, 0):
        one = hypotheses[columns.hypothesis]
        for position, axis in enumerate(one.axes):
            q, pair = np.zeros(len(one.axes)), axis.signed or axis.dependent
            if axis.dependent:
                q[one.main] = columns.level
            top = 1.0 if axis.signed else min(columns.level, axis.limit)
            bottom = -1.0 if axis.signed else 0.0
            for size in (top, bottom) if pair else (top,):
                q[position] = size
                sets.append(with_values(values, names, one.values(q, base)))
            jobs.append((axis, pair, top - bottom))
    seen = []
    for part in np.array_split(np.stack(sets), min(PARTS, len(sets))):
        seen += step("signatures", partial(_simulated, drives, part), part)
        if progress is not None:
            progress(1, "signatures")
    flat, cursor, parts = np.concatenate(seen), 0, []
    for axis, pair, span in jobs:
        change = flat[cursor] - (flat[cursor + 1] if pair else at)
        if axis.dependent and np.abs(change).max() < UNSEEN * np.abs(flat[cursor] - at).max():
            change = flat[cursor] - at  # nothing separates the two here: not a column of its own
        parts.append(change / span)
        cursor += 2 if pair else 1
    return np.stack(parts, axis=-1)


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
    signatures = signature_columns(drives, hypotheses, values, names, at, progress)
    white = reference.whitener
    residual = white.flat(reference.target_of(drives) - at, drives.mask)
    design = white.flat(np.concatenate([slopes, signatures], axis=-1), drives.mask)
    offset = reference.space.size
    evidence = Evidence(
        residual, design, offset, column_layout(hypotheses, offset), np.linalg.inv(reference.spread),
        np.einsum("bni,bnj->bij", design, design, optimize=True), np.einsum("bni,bn->bi", design, residual),
        tuple(_pool(reference, trial, drives.mask[i]) @ design[i] for i, trial in enumerate(drives.trials) if pools),
        manoeuvre_groups(drives.trials), reference.shared)
    return evidence, slopes


def manoeuvre_groups(trials: Sequence[Trial]) -> tuple[tuple[int, ...], ...]:
    """Trials of the same commands, whatever their names, in order of first appearance: what is held back together.

    Where none repeats another and names are shared, they are windows of long drives: these are put into eighths, and so
    are more than 40 groups.
    """
    groups, names = same_course(trials, by_name=False), {trial.manoeuvre for trial in trials}
    if len(groups) > 40 or len(names) < len(trials) == len(groups):
        parts = np.array_split(np.arange(len(trials)), min(8, len(trials)))
        return tuple(tuple(int(i) for i in part) for part in parts)
    return tuple(map(tuple, groups))


def group_names(trials: Sequence[Trial], groups: Sequence[Sequence[int]]) -> list[str]:
    """A name of each group: that of its manoeuvre, or of its first trial where groups share a manoeuvre."""
    manoeuvres = [trials[group[0]].manoeuvre for group in groups]
    return [one if manoeuvres.count(one) == 1 else trials[group[0]].name
            for one, group in zip(manoeuvres, groups, strict=True)]


def _pool(reference: Reference, trial: Trial, mask: np.ndarray) -> np.ndarray:
    """(J, n) white noise of reference drives of the same manoeuvre; of any manoeuvre where there are few."""
    like = [one for one in reference.leftovers if alike(one.trial, trial)]
    if len(like) < 3:
        same = [one for one in reference.leftovers if one.trial.manoeuvre == trial.manoeuvre]
        like = same if len(same) >= 3 else list(reference.leftovers)
    return np.stack([white_leftover(reference, one, mask) for one in like])


def white_leftover(reference: Reference, one: Leftover, mask: np.ndarray) -> np.ndarray:
    """(n,) white noise of a reference drive, put into the bins of another drive of weights `mask` (K, C)."""
    series = reference.noise_of(one) * one.mask
    inside = np.flatnonzero(one.mask.prod(-1) > 0)
    last = inside[-1] + 1 if len(inside) else len(series)
    fitted = np.resize(series[:last], mask.shape)  # a longer drive repeats a shorter one's noise
    return reference.whitener.apply(fitted[None], (mask > 0).astype(float)[None]).reshape(-1)
