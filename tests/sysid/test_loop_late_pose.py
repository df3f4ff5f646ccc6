"""How late the outside pose is, from drives whose delay is known."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from sysid.errors.space import Space
from sysid.logs.pose_lag import pose_lag, sign_flips
from sysid.logs.records import Command, OdometryStream, PoseStream, Start, Trial
from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.evidence import Columns
from sysid.missing.joint_fit import Refit
from sysid.verdict import late_pose
from sysid.verdict.result import LoopConfig
from sysid.verdict.search_record import Search

pytestmark = pytest.mark.quick
BLOCKS = [list(range(4 * b, 4 * b + 4)) for b in range(8)]
DT = 0.01


def lagged(rate, constant):
    out = rate.copy()
    for k in range(1, len(rate)):
        out[k] = out[k - 1] + DT / constant * (rate[k] - out[k - 1])
    return out


def drives(delay=0.0, body_lag=0.0, noise=0.02, seed=0):
    """Drives of 6 s that ramp from one pair of speeds to another, with an irregular outside pose that is late by
    `delay`; the body is behind its wheels by `body_lag` and turns at 0.7 of what they say. And its yaw rates."""
    rng = np.random.default_rng(seed)
    t = np.arange(-3.0, 6.0, DT)
    shown = t >= 0
    trials, rates = [], {}
    for i in range(32):
        ramp = np.clip(t / rng.uniform(0.5, 2.0), 0.0, 1.0)
        (v0, v1), (w0, w1) = rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 2)
        v, omega = v0 + (v1 - v0) * ramp, w0 + (w1 - w0) * ramp
        body_v, body_omega = v, 0.7 * omega
        if body_lag:
            body_v, body_omega = lagged(body_v, body_lag), lagged(body_omega, body_lag)
        yaw = np.cumsum(body_omega) * DT
        x, y = np.cumsum(body_v * np.cos(yaw)) * DT, np.cumsum(body_v * np.sin(yaw)) * DT
        stamps = np.cumsum(rng.uniform(0.15, 0.35, 30))
        stamps = np.concatenate([[0.0], stamps[stamps < 5.95]])
        seen = [np.interp(stamps - delay, t, one) + noise * rng.standard_normal(len(stamps)) for one in (x, y, yaw)]
        pose = PoseStream(stamps[1:], *(one[1:] for one in seen))
        start = Start(seen[0][0], seen[1][0], seen[2][0], v[shown][0], omega[shown][0], measured=True)
        odometry = OdometryStream(t[shown], None, None, None, v[shown], omega[shown])
        trials.append(Trial(f"run/{i}", f"run.{i}", Command(t[shown], v[shown], omega[shown]), odometry, pose, start))
        rates[f"run/{i}"] = t[shown], body_omega[shown] + 0.02 * rng.standard_normal(shown.sum())
    return trials, rates


@pytest.mark.parametrize("gyro", [True, False])
def test_a_delay_is_found_and_counts_as_found(gyro):
    trials, rates = drives(delay=0.4)
    found = pose_lag(trials, BLOCKS, rates if gyro else None)
    assert found.delay == pytest.approx(0.4, abs=0.1) and found.low < 0.4 < found.high
    assert found.p < 0.01 and found.share > 0.05


@pytest.mark.parametrize("gyro", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_without_a_delay_none_is_told(gyro, seed):
    trials, rates = drives(seed=seed)
    found = pose_lag(trials, BLOCKS, rates if gyro else None)
    assert found.p >= 0.01 or found.delay < 0.005


@pytest.mark.parametrize("gyro", [True, False])
def test_a_body_behind_its_wheels_is_no_late_pose(gyro):
    trials, rates = drives(body_lag=0.4)
    found = pose_lag(trials, BLOCKS, rates if gyro else None)
    assert found.p >= 0.01 or found.delay < 0.005


def test_a_break_of_the_pose_does_not_count():
    trials, rates = drives(delay=0.4)
    broken = []
    for trial in trials:
        one = trial.ground_truth
        later = one.t > 3.0
        moved = PoseStream(one.t, one.x + 2.0 * later, one.y, one.yaw + 1.0 * later)
        middle = (float(one.t[~later].max()), float(one.t[later].min()))
        broken.append(Trial(**{**trial.__dict__, "ground_truth": moved, "breaks": (middle,)}))
    assert pose_lag(broken, BLOCKS, rates).delay == pytest.approx(0.4, abs=0.1)


def test_drives_that_tell_nothing_have_no_delay():
    trials, rates = drives(delay=0.4)
    assert pose_lag([Trial(**{**trial.__dict__, "odometry": None}) for trial in trials], BLOCKS) is None
    assert pose_lag(trials, BLOCKS, {}) is None
    assert pose_lag(trials[:4], BLOCKS[:1], rates) is None


def test_signs_of_blocks_are_drawn_one_sided():
    assert sign_flips(np.ones(8)) == pytest.approx(2**-8)
    assert sign_flips(-np.ones(8)) == 1.0
    assert sign_flips(np.ones(20)) < 1e-3
    assert 0.3 < sign_flips(np.array([1.0, -1.0] * 10)) <= 0.7


@dataclass(frozen=True)
class Told:
    """What `told_late` reads of a closed loop, with a base model of one parameter."""

    search: Search
    evidence: SimpleNamespace
    log: SimpleNamespace
    config: LoopConfig = field(default_factory=LoopConfig)
    names: tuple = ("body.mass", "pose_delay.delay")
    hypotheses: tuple = (Hypothesis("pose_delay", (Axis("pose_delay.delay", 0.05),)),)
    plant: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(dt=0.01))
    seconds: dict = field(default_factory=dict)

    @property
    def reference(self):
        one = np.ones(1)
        return SimpleNamespace(space=Space(("body.mass",), 0 * one, 2 * one, one, np.zeros(1, bool)))


def closed(delay):
    trials, rates = drives(delay=delay)
    base = Refit((), np.ones(1), np.zeros(0), 0.0, np.zeros((32, 5)), np.zeros((32, 5, 1)), np.zeros(2))
    evidence = SimpleNamespace(groups=BLOCKS, columns=[Columns(0, 1.0, (1,))], design=np.ones((32, 5, 2)))
    search = Search("none", base, base, None)
    return Told(search, evidence, SimpleNamespace(training=tuple(trials), fields={"yaw_rate": rates}))


def test_a_late_pose_is_named_with_its_delay_and_later_fits_hold_it(monkeypatch):
    monkeypatch.setattr(late_pose, "fitted", lambda result, delay: np.array([1.5 if delay else 0.5, delay]))
    monkeypatch.setattr(late_pose, "residuals", lambda result, values: np.zeros((2, 32, 5)))
    found = late_pose.told_late(closed(0.4), 0.01)
    assert found.search.verdict == "named" and found.search.classes == [["pose_delay"]]
    assert found.search.final.values[1] == pytest.approx(0.4, abs=0.1)
    assert (found.search.base.u, found.search.final.u) == (0.25, 0.75)
    assert found.config.held == ("pose_delay.delay",)
    assert "s late" in found.search.reason
    on_time = closed(0.0)
    assert late_pose.told_late(on_time, 0.01) is on_time
