"""Tests for paired errors of a few drives: exact sign flips, and Holm's correction for several tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

EXACT_UP_TO = 12  # pairs up to which all sign patterns are counted (4096 of them)
RESAMPLES = 20_000
TIE = 1e-12  # relative difference of two sums that counts as none


def sign_flip_p(differences: Sequence[float] | np.ndarray, seed: int = 0) -> float:
    """Two-sided p-value of paired differences (n,) against a mean of 0, by flipping their signs.

    Exact for up to EXACT_UP_TO pairs, else from RESAMPLES random patterns. With n pairs no p-value is below 2 / 2**n:
    three drives cannot reach 0.05, six can. ValueError without pairs, or with differences that are not finite.
    """
    values = np.asarray(differences, float)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise ValueError(f"differences {values!r} must be a list of finite numbers, one per pair. Leave out pairs of "
                         "which one was not measured.")
    count = len(values)
    if count <= EXACT_UP_TO:
        patterns = np.arange(2**count)[:, None] >> np.arange(count) & 1
        sums = np.abs((2 * patterns - 1) @ values)
        return float(np.mean(sums >= abs(values.sum()) * (1 - TIE)))
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (RESAMPLES, count))
    extreme = np.sum(np.abs(signs @ values) >= abs(values.sum()) * (1 - TIE))
    return float((extreme + 1) / (RESAMPLES + 1))


def smallest_p(count: int) -> float:
    """The least p-value that `count` pairs can give."""
    return 2.0 / 2**count if count <= EXACT_UP_TO else 1.0 / (RESAMPLES + 1)


def holm(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """p-values (m,) adjusted so that the chance of any false finding among the m tests stays bounded (Holm 1979)."""
    p = np.asarray(p_values, float)
    if ((p < 0) | (p > 1) | ~np.isfinite(p)).any():
        raise ValueError(f"p-values {p!r} must lie within 0 to 1.")
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def mean_sd(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and sample standard deviation; nan for the latter where there is one value only."""
    array = np.asarray(values, float)
    return float(array.mean()), float(array.std(ddof=1)) if len(array) > 1 else float("nan")


def upper_rate(events: int, count: int) -> float:
    """Upper end of the one-sided 95 % interval of a rate (Clopper and Pearson 1934)."""
    from scipy import stats

    return float(stats.beta.ppf(0.95, events + 1, count - events)) if events < count else 1.0
