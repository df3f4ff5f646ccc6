"""Frames of an odometry, found in its rows alone."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from sysid.logs.odometry_frames import at_frames, find_period
from sysid.logs.records import Command, OdometryStream, Start, Trial

NOISE = 3e-4  # m and rad, of a row: ticks of an encoder


def driven(t, frame=None, phase=0.0, seed=0, still=False, weaving=False):
    """A trial of steady stretches of 2 s, forward and turning, with rows at t that tell of the latest frame."""
    random = np.random.default_rng(seed)
    v, omega = random.uniform(0.3, 1.0, 6) * random.choice([-1, 1], 6), random.uniform(-1, 1, 6) * (np.arange(6) % 2)
    if still:
        v, omega = 0 * v, 0 * omega
    fine = np.arange(0, 12.0, 0.001)
    block = np.minimum((fine / 2.0).astype(int), 5)
    eased = [np.convolve(values[block], np.ones(150) / 150)[: len(fine)] for values in (v, omega)]  # takes 0.15 s
    sent = 2.0 * np.arange(6)
    if weaving:  # commands change all the time
        sent, v, omega = ROWS, 0 * ROWS + 0.6, 0.5 * np.sin(ROWS)
        eased = [np.interp(fine, sent, values) for values in (v, omega)]
    yaw = np.cumsum(eased[1]) * 0.001
    x, y = np.cumsum(eased[0] * np.cos(yaw)) * 0.001, np.cumsum(eased[0] * np.sin(yaw)) * 0.001
    true = t if frame is None else np.maximum((np.floor(t / frame - phase + 1e-9) + phase) * frame, 0.0)
    rows = [np.interp(true, fine, values) + NOISE * random.standard_normal(len(t)) for values in (x, y, yaw)]
    speeds = [np.interp(true, fine, values) for values in eased]
    command = Command(sent, v, omega)
    return Trial(f"drive_{seed}", "drive", command, OdometryStream(t, *rows, *speeds), None, Start()), true


ROWS = np.arange(0, 12.0, 0.05)
JITTERED = ROWS + np.random.default_rng(9).uniform(0, 0.01, len(ROWS))


@pytest.mark.quick
@pytest.mark.parametrize(("frame", "rows"), [(0.02, ROWS), (1 / 30, ROWS), (0.02, JITTERED), (0.0125, JITTERED)])
def test_frames_are_found_and_rows_are_put_at_them(frame, rows):
    drives = [driven(rows, frame, phase, seed) for seed, phase in enumerate((0.1, 0.3, 0.6, 0.9))]
    trials = [trial for trial, _ in drives]
    period = find_period(trials)
    assert period == pytest.approx(frame, rel=1e-3)
    for moved, (trial, true) in zip(at_frames(trials, period), drives, strict=True):
        found, stamps = moved.odometry.t, trial.odometry.t
        late = (found - true)[10:]  # an age that all rows share does not show
        assert np.mean(np.abs(late - np.median(late)) < 5e-4) > 0.97 and (found <= stamps + 1e-12).all()
        assert np.ptp((stamps - true)[10:]) > 5e-3
        np.testing.assert_array_equal(moved.odometry.x, trial.odometry.x)


@pytest.mark.quick
def test_drives_that_are_never_steady_are_put_at_frames_too():
    weaving, true = driven(ROWS, 0.02, 0.3, 7, weaving=True)
    [moved] = at_frames([weaving], 0.02)
    late = moved.odometry.t - true
    assert np.ptp(late[1:]) < 1e-3 < np.ptp((weaving.odometry.t - true)[1:])


@pytest.mark.quick
@pytest.mark.parametrize("rows", [ROWS, JITTERED])
def test_rows_at_their_own_times_stay_where_they_are(rows):
    trials = [driven(rows, seed=seed)[0] for seed in range(4)]
    assert find_period(trials) is None
    assert at_frames(trials, None) == tuple(trials)


@pytest.mark.quick
def test_ages_without_a_period_are_not_taken_for_frames():
    random = np.random.default_rng(3)
    trials = []
    for seed in range(4):
        late = np.sort(ROWS + random.uniform(0, 0.02, len(ROWS)))
        trial, _ = driven(late, seed=seed)
        trials.append(dataclasses.replace(trial, odometry=dataclasses.replace(trial.odometry, t=ROWS)))
    assert find_period(trials) is None


@pytest.mark.quick
def test_a_log_that_says_nothing_of_steady_motion_has_no_frames():
    standing = [driven(ROWS, 0.02, seed=seed, still=True)[0] for seed in range(4)]
    assert find_period(standing) is None
    speeds = [dataclasses.replace(trial, odometry=dataclasses.replace(trial.odometry, x=None, y=None, yaw=None))
              for trial, _ in (driven(ROWS, 0.02, seed=seed) for seed in range(4))]
    assert find_period(speeds) is None and find_period([]) is None
    assert at_frames(speeds, 0.02) == tuple(speeds)


@pytest.mark.parametrize("period", [0.02, 0.025])
def test_speeds_of_frames_are_means_over_them_low_passed_once_a_frame(period):
    """Against the recursion itself, as an odometry runs it, at the frames of a drive that starts in motion."""
    from sysid.replay.delays import framed

    dt, time_constant = 0.01, 0.042
    t = np.arange(400) * dt
    speeds = np.column_stack([0.4 + 0.3 * np.sin(3 * t), np.cos(2 * t)])
    ways = np.column_stack([0.4 * t + 0.1 * (1 - np.cos(3 * t)), np.sin(2 * t) / 2])
    frame = np.arange(1, int(t[-1] / period)) * period
    at = np.column_stack([np.interp(np.r_[0.0, frame], t, column) for column in ways.T])
    means, kept, expected = np.diff(at, axis=0) / period, speeds[0], []
    keep = np.exp(-period / time_constant)
    for mean in means:
        kept = keep * kept + (1 - keep) * mean
        expected.append(kept)
    told = np.asarray(framed(jnp.asarray(speeds), jnp.asarray(time_constant), period, dt))
    seen = np.column_stack([np.interp(frame, t, column) for column in told.T])
    np.testing.assert_allclose(seen, expected, atol=2e-3)
