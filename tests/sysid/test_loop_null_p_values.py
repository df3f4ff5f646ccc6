"""p-values of drives with nothing in them, over many sets of reference days, where all is linear and the noise known.

A day's drives of one manoeuvre share a part of their noise: what the model lacks that day. The reference days are one
with three replicates and five with one, as in the benchmark.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sysid.errors.noise import Whitener
from sysid.logs.records import Command, Start
from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.days import Leftover, Reference, expected_without, mean_by_day
from sysid.missing.evidence import Evidence, column_layout
from sysid.missing.wander import _pooled, coordinates
from sysid.verdict.scan import drawn_noise, run

pytestmark = pytest.mark.quick
MANOEUVRES, REPLICATES, SAMPLES, SETS = 6, 3, 40, 150
SHARED = 0.25
EFFECTS = tuple(Hypothesis(name, (Axis(f"{name}.size", 0.01, signed=True, limit=50.0),)) for name in "abcd")
SPREAD = 0.02 * np.eye(1)
PLAIN = Whitener(np.ones(1), np.zeros((1, 1, 1)), np.eye(1))
COURSE = np.repeat(np.arange(MANOEUVRES), REPLICATES)
ONCE = np.arange(0, len(COURSE), REPLICATES)
DESIGN = np.random.default_rng(3).standard_normal((MANOEUVRES, SAMPLES, 5))[COURSE]


def evidence_of(residual, trials=slice(None), **fields):
    design = DESIGN[trials]
    groups = tuple(tuple(range(i, i + REPLICATES)) for i in range(0, len(design), REPLICATES))
    return Evidence(residual, design, 1, column_layout(EFFECTS, 1), np.linalg.inv(SPREAD),
                    np.einsum("bni,bnj->bij", design, design), np.einsum("bni,bn->bi", design, residual),
                    fields.pop("pools", ()), groups, **fields)


def day(rng, trials=slice(None)):
    """(B, n) white noise of one day's drives, and the day's base parameter in it."""
    own, common = rng.standard_normal((len(COURSE), SAMPLES)), rng.standard_normal((MANOEUVRES, SAMPLES))[COURSE]
    noise = np.sqrt(1 - SHARED) * own + np.sqrt(SHARED) * common
    return (noise + DESIGN[..., 0] * np.sqrt(SPREAD[0, 0]) * rng.standard_normal())[trials]


def drive(course):
    """A trial that is told from others by its manoeuvre only."""
    still = np.zeros(2)
    return SimpleNamespace(manoeuvre=f"m{course}", command=Command(still, still, still), odometry=None, start=Start(),
                           ground_truth=None)


def reference_days(rng):
    """Leftovers of six days, less what the other days show, and the evidence of each."""
    leftovers, trials = [], [slice(None)] + [ONCE] * 5
    for number, which in enumerate(trials):
        for course, series in zip(COURSE[which], day(rng, which), strict=True):
            leftovers.append(Leftover(drive(course), number, series[:, None], np.ones((SAMPLES, 1))))
    reference = Reference(None, None, np.zeros(1), SPREAD, np.zeros((6, 1)), PLAIN, np.ones((4, 1)), tuple(leftovers),
                          0.25, True, "")
    left = np.stack([one.series[:, 0] - expected_without(leftovers, one)[:, 0] for one in leftovers])
    scale = np.sqrt(np.mean(left**2))
    reference = replace(reference, whitener=PLAIN.scaled(scale))
    days = np.array([one.day for one in leftovers])
    each = [evidence_of(left[days == number] / scale, which) for number, which in enumerate(trials)]
    return reference, left / scale, scale, _pooled(each[0].columns, [coordinates(one, range(len(one.residual)))
                                                                   for one in each])


def judged(seed):
    """p-values of one null against a set of days of its own: as the loop has it, and as if drives shared nothing."""
    rng = np.random.default_rng(seed)
    reference, left, scale, wander = reference_days(rng)
    like = [np.array([one.trial.manoeuvre == f"m{course}" for one in reference.leftovers]) for course in COURSE]
    expected = np.stack([mean_by_day([one for one, kept in zip(reference.leftovers, mine, strict=True) if kept],
                                     SAMPLES)[:, 0] for mine in like])
    pools = tuple(left[mine] @ DESIGN[i] for i, mine in enumerate(like))
    evidence = evidence_of((day(rng) - expected) / scale, pools=pools, shared=reference.shared)
    return [run(one, EFFECTS, SPREAD, wander, 200, seed).p_family for one in (evidence, replace(evidence, shared=0.0))]


@pytest.fixture(scope="module")
def p_values():
    return np.array([judged(seed) for seed in range(SETS)]).T


def test_nulls_have_uniform_p_values_over_sets_of_reference_days(p_values):
    assert stats.kstest(p_values[0], "uniform").pvalue > 0.05
    assert np.mean(p_values[0] < 0.05) <= 0.1


def test_they_would_be_too_small_if_replicates_shared_no_noise(p_values):
    assert stats.kstest(p_values[1], "uniform").pvalue < 0.01
    assert np.mean(p_values[1] < 0.05) > 0.1


def test_the_shared_noise_is_that_of_replicates_on_one_day():
    found = [reference_days(np.random.default_rng(seed))[0].shared for seed in range(10)]
    error_of_expected = (5 / 6) ** 2 / 5  # of the mean of five days, drawn towards 0: replicates share that too
    assert np.mean(found) == pytest.approx((SHARED + error_of_expected) / (1 + error_of_expected), abs=0.1)


@pytest.mark.parametrize("shared", [0.0, 0.3, 1.0])
def test_drawn_noise_keeps_its_size_and_shares_what_it_should(shared):
    rng = np.random.default_rng(0)
    pools = [np.pad(rng.standard_normal((400, 1)), ((0, 0), (place, 2 - place))) for place in range(3)]
    pools[1:] = [np.roll(pools[0], place, axis=1) for place in (1, 2)]
    draws = np.array([drawn_noise(pools, shared, rng) for _ in range(4000)])
    covariance = np.cov(draws.T)
    assert np.diag(covariance) == pytest.approx(np.ones(3), abs=0.15)
    assert covariance[np.triu_indices(3, 1)] == pytest.approx(np.full(3, shared), abs=0.1)
