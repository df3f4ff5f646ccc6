"""Noise of the sensors beside that of the reference days, on hand-made drives."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sysid.errors.noise import NoiseLevels, NoisyDrives, fit_whitener, noise_levels, said, scatter, steady_bins
from sysid.logs.records import Command
from sysid.missing.days import Leftover, Reference, Wander
from sysid.missing.signatures import white_leftover
from sysid.verdict.result import Prepared
from sysid.verdict.surroundings import with_noise

pytestmark = pytest.mark.quick

CHANNELS = ("odometry.v", "odometry.omega", "pose.yaw")
ALL = (*CHANNELS, "pose.forward", "pose.left")
PAIRS = tuple((2 * k, 2 * k + 1) for k in range(10))
ALPHA = 0.005


def drives(seed, factor=(1.0, 1.0, 1.0), bins=80, replicates=PAIRS, add=None):
    """Ten manoeuvres driven twice: smooth errors of the model that replicates share, and noise of each drive."""
    random = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, bins)
    shared = np.stack([np.sin(2 * np.pi * (1 + k % 3) * t) * random.standard_normal() for k in range(10)])
    series = shared.repeat(2, axis=0)[..., None] + np.array(factor) * random.standard_normal((20, bins, 3))
    if add is not None:
        series = series + add(random, series.shape)
    return NoisyDrives(series, np.ones_like(series), replicates, np.ones(series.shape[:2], bool))


@pytest.mark.parametrize("replicates", [PAIRS, ()], ids=["replicates", "single drives"])
def test_a_channel_that_became_noisier_is_found_and_the_others_are_left(replicates):
    usual, ours = (drives(seed, factor, replicates=replicates)
                   for seed, factor in ((0, (1.0,) * 3), (1, (1.0, 2.6, 1.0))))
    found = noise_levels(ours, usual, CHANNELS, ALPHA)
    assert found.changed.tolist() == [False, True, False]
    low, high = found.interval(1)
    assert low <= 2.6 <= high
    assert found.louder.tolist() == [1.0, found.factor[1], 1.0]
    assert np.all(found.quieter == 1.0)


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_intervals_hold_the_factor_and_usual_noise_is_seldom_called_another(factor):
    found = [noise_levels(drives(2 * seed, (factor,) * 3, bins=40), drives(2 * seed + 1, bins=40), CHANNELS, ALPHA)
             for seed in range(100)]
    inside = [low <= factor <= high for one in found for low, high in map(one.interval, range(3))]
    assert np.mean(inside) > 0.9
    if factor == 1.0:
        assert sum(one.changed.any() for one in found) <= 4
    else:
        assert all(one.changed.all() for one in found)


def test_what_strikes_now_and_then_is_not_noise():
    def strikes(random, shape):
        return 30.0 * (random.random(shape) < 0.008)

    found = noise_levels(drives(1, add=strikes), drives(0), CHANNELS, ALPHA)
    assert not found.changed.any()


def test_bins_that_only_some_replicates_measure_do_not_count():
    ours = drives(1)
    ours.series[...] += 20.0  # far from 0, which stands where nothing was measured
    for drive in range(0, 20, 2):
        ours.weight[drive, drive % 7 :: 7] = 0.0
    found = noise_levels(ours, drives(0), CHANNELS, ALPHA)
    assert not found.changed.any()
    assert found.factor == pytest.approx(1.0, abs=0.25)


def test_without_replicates_only_steady_motion_counts():
    def edges(random, shape):
        return 10.0 * random.standard_normal(shape) * (np.arange(shape[1]) < 30)[:, None]

    usual, ours = drives(0, replicates=()), drives(1, replicates=(), add=edges)
    assert noise_levels(ours, usual, CHANNELS, ALPHA).changed.all()
    steady = np.broadcast_to(np.arange(80) >= 30, (20, 80))
    assert not noise_levels(replace(ours, steady=steady), usual, CHANNELS, ALPHA).changed.any()


def test_too_few_drives_give_no_answer_and_unmeasured_channels_none():
    few = drives(0, replicates=())
    few = replace(few, series=few.series[:2], weight=few.weight[:2], steady=few.steady[:2])
    assert noise_levels(few, drives(1), CHANNELS, ALPHA) is None
    blind = drives(0, (2.0,) * 3)
    blind.weight[..., 2] = 0.0
    found = noise_levels(blind, drives(1), CHANNELS, ALPHA)
    assert found.changed.tolist() == [True, True, False]
    assert set(found.report()) == set(CHANNELS[:2])


def test_a_motion_is_steady_once_commands_have_been_constant_for_a_while():
    t = np.arange(0.0, 10.0, 0.1)
    trial = SimpleNamespace(command=Command(t, np.where(t < 4.95, 0.3, 0.5), 0 * t))
    steady = steady_bins(trial, 40, 0.25)
    assert np.flatnonzero(steady).tolist() == [*range(8, 20), *range(28, 40)]


def reference(random, shared=0.5):
    """Six days of three replicates, a part of whose noise they share."""
    leftovers = []
    command = Command(np.array([0.0, 1.0]), np.array([0.3, 0.3]), np.zeros(2))
    for day in range(6):
        common = np.sqrt(shared) * random.standard_normal((100, 5))
        for number in range(3):
            series = common + np.sqrt(1 - shared) * random.standard_normal((100, 5))
            trial = SimpleNamespace(manoeuvre=f"m{day}", command=command, name=f"m{day}_{number}",
                                    start=SimpleNamespace(v=0.0, omega=0.0), duration=25.0,
                                    odometry=SimpleNamespace(t=np.array([0.0, 25.0])), ground_truth=None)
            leftovers.append(Leftover(trial, day, series, np.ones((100, 5))))
    series = np.stack([one.series for one in leftovers])
    return Reference(None, SimpleNamespace(names=[]), np.zeros(0), np.zeros((0, 0)), np.zeros((6, 0)),
                     fit_whitener(series, np.ones_like(series)), np.ones((4, 5)), tuple(leftovers), 0.25, True, "")


def judged(levels):
    """A vehicle as it is judged at a noise, and that vehicle at the usual one."""
    usual = Prepared(reference(np.random.default_rng(0)), None, (), None, (), None,
                     Wander((), (), 10.0, excess=0.06, scatter=-0.5))
    return with_noise(usual, levels), usual


def white_square(ready, factor, random, shared=0.5):
    """Mean square and scatter of white drives with noise of a factor, of which replicates share a part."""
    common = np.sqrt(shared) * random.standard_normal((40, 100, 5)).repeat(2, axis=0)
    series = common + factor * np.sqrt(1 - shared) * random.standard_normal((80, 100, 5))
    white = ready.reference.whitener.apply(series, np.ones_like(series)).reshape(80, -1)
    return float(np.square(white).mean()), scatter(white, np.arange(80) // 2)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_where_nothing_is_missing_the_white_residual_has_the_expected_size(factor):
    levels = NoiseLevels(ALL, np.full(5, factor), 0.05, 40.0, np.ones(5, bool))
    ready, usual = judged(levels)
    square, apart = white_square(ready, factor, np.random.default_rng(1))
    assert square == pytest.approx(ready.wander.level, rel=0.05)
    assert (apart + 1) / ready.wander.level - 1 == pytest.approx(ready.wander.scatter, abs=0.06)
    assert ready.wander.excess > usual.wander.excess
    if factor > 1:  # simulated nulls are as noisy as the drives, and share less
        noise = [white_leftover(ready.reference, one, one.mask) for one in ready.reference.leftovers]
        assert np.square(noise).mean() == pytest.approx(1.0, rel=0.1)
        assert ready.reference.shared < 0.3 * usual.reference.shared
    else:  # what days differ by is known no better than before
        assert ready.reference.whitener.scale == pytest.approx(usual.reference.whitener.scale)


def test_usual_noise_changes_nothing():
    ready, usual = judged(NoiseLevels(CHANNELS, np.array([1.1, 0.9, np.nan]), 0.1, 40.0, np.zeros(3, bool)))
    assert ready is usual


def test_the_sentence_names_the_channels_that_changed():
    levels = NoiseLevels(CHANNELS, np.array([1.0, 2.6, 0.5]), 0.04, 40.0, np.array([False, True, True])).report()
    text = said(levels, alone=True)
    assert text == ("the reported yaw rate is 2.6 times as noisy as on the reference days (2.4 to 2.8); the outside "
                    "pose, heading is 0.5 times as noisy as on the reference days (0.46 to 0.54); nothing else has "
                    "changed")
    assert said({}, alone=True) == ""
