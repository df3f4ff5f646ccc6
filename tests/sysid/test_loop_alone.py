"""The closed loop on drives that stand alone: windows of one long drive, with a slow outside pose of its own clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from sysid.errors.features import BIN, bin_width, make_features
from sysid.logs.records import Command, Log, OdometryStream, PoseStream, Start, Trial
from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.joint_fit import Refit
from sysid.missing.signatures import manoeuvre_groups
from sysid.replay.rollout import make_batch, path_of
from sysid.verdict.alone import UNTOLD, judged, simplest, stands_alone
from sysid.verdict.found import Candidate, Thresholds
from sysid.verdict.preparation import days_of
from whill_mjx.effects import make_effect
from whill_mjx.vehicle.specs import HUSKY

pytestmark = pytest.mark.quick


def window(name="run/0", period=0.05, speed=1.0, seconds=6.0, **more):
    """A straight drive at constant speed, its pose measured every `period` [s] after the start."""
    t = np.arange(0.0, seconds, 0.05)
    pose = np.arange(period, seconds, period)
    return Trial(name, "run", Command(t, np.full(len(t), speed), 0 * t),
                 OdometryStream(t, None, None, None, np.full(len(t), speed), 0 * t),
                 PoseStream(pose, speed * pose, 0 * pose, 0 * pose), Start(v=speed, measured=True), **more)


def test_bins_are_as_wide_as_the_outside_pose_asks_for():
    assert bin_width((window(period=0.05),)) == BIN
    assert bin_width((window(period=0.24),)) == 2 * BIN
    assert bin_width((window(period=0.9),)) == 4 * BIN
    assert bin_width((replace(window(), ground_truth=None),)) == BIN


def test_a_start_that_was_measured_is_the_first_pose():
    trial = window(period=0.24)
    features = make_features((trial,), 0.5)
    assert features.mask[0, 0, 2] == 1
    assert make_features((replace(trial, start=replace(trial.start, measured=False)),), 0.5).mask[0, 0, 2] == 0
    _, measured = make_batch((trial,), 0.005)
    seen = features.of(measured)[0]
    np.testing.assert_allclose(seen[features.mask[0, :, 2] > 0, 2], 1.0, atol=1e-9)


def test_bins_that_a_break_of_the_pose_touches_are_not_measured():
    trial = window(period=0.1, breaks=((1.9, 2.1),))
    mask = make_features((trial,), 0.5).mask[0, :, 2]
    whole = make_features((replace(trial, breaks=()),), 0.5).mask[0, :, 2]
    assert np.flatnonzero(mask != whole).tolist() == [3, 4]


def test_windows_without_replicates_are_put_into_eighths_and_replicates_are_not():
    windows = tuple(window(f"run/{i}", speed=1.0 + 0.1 * i) for i in range(16))
    assert [len(group) for group in manoeuvre_groups(SimpleNamespace(trials=windows))] == [2] * 8
    assert stands_alone(windows, known=False) and not stands_alone(windows, known=True)
    again = tuple(window(f"run/{i}") for i in range(16))
    assert [len(group) for group in manoeuvre_groups(SimpleNamespace(trials=again))] == [16]
    assert not stands_alone(again, known=False)


def search_with(residual, column, q=1.0):
    """A search that named one effect with this column (B, n)."""
    one = Hypothesis("quadratic_drag", (Axis("quadratic_drag.coefficient", 1.0),))
    fit = Refit((one,), np.zeros(0), np.array([q]), 0.0, residual, column[..., None], np.zeros(0))
    return SimpleNamespace(verdict="named", reason="", final=fit, accepted=[], classes=[])


@pytest.mark.parametrize("shared", [True, False])
def test_an_effect_is_named_only_where_blocks_of_drives_agree_on_it(shared):
    rng = np.random.default_rng(0)
    column = 3 * rng.standard_normal((16, 40))
    groups = tuple((2 * i, 2 * i + 1) for i in range(8))
    size = np.ones(16) if shared else np.repeat([3.0, -1.0] * 4, 2)
    residual = rng.standard_normal((16, 40)) + (size - size.mean())[:, None] * column
    found = judged(search_with(residual, column), groups, np.zeros((0, 0)), Thresholds())
    assert found.verdict == ("named" if shared else "unexplained")
    assert UNTOLD in found.reason


@pytest.mark.parametrize(("effect", "wheels", "verdict"), [
    ("command_dead_zone", True, "named"), ("command_dead_zone", False, "unexplained"),
    ("command_delay", False, "named"), ("slope", False, "named")])
def test_an_effect_of_the_wheels_has_a_name_only_where_the_wheels_were_seen(effect, wheels, verdict):
    rng = np.random.default_rng(0)
    column, residual = 3 * rng.standard_normal((16, 40)), rng.standard_normal((16, 40))
    groups = tuple((2 * i, 2 * i + 1) for i in range(8))
    given = search_with(residual, column)
    named = Hypothesis(effect, (Axis(f"{effect}.size", 1.0),))
    given.final = replace(given.final, hypotheses=(named,))
    found = judged(given, groups, np.zeros((0, 0)), Thresholds(), wheels)
    assert found.verdict == verdict
    assert ("log their speeds" in found.reason) == (verdict == "unexplained")


def test_of_effects_that_are_not_told_apart_the_simplest_is_named():
    def candidate(effect, axes, gain):
        one = Hypothesis(effect, tuple(Axis(f"{effect}.{i}", 1.0) for i in range(axes)))
        return Candidate(one, gain, 1e-4, 1.0, f"refit of {effect}")

    ramp, delay, other = (candidate(*each) for each in (
        ("acceleration_limit", 3, 60.0), ("command_delay", 1, 50.0), ("slope", 1, 20.0)))
    found = SimpleNamespace(accepted=[ramp], classes=[["acceleration_limit", "command_delay"]],
                            rounds=[[ramp, delay, other]], final=ramp.refit, share=1.0)
    simplest(found)
    assert found.final == "refit of command_delay" and found.accepted == [delay]
    assert found.classes == [["command_delay", "acceleration_limit"]]


def test_with_nothing_found_it_says_that_it_cannot_tell():
    found = judged(SimpleNamespace(verdict="none", reason="nothing stands out"), (), np.zeros((0, 0)), Thresholds())
    assert found.verdict == "none" and found.reason == f"nothing stands out; {UNTOLD}"


@dataclass
class Cart:
    """What `path_of` needs of a vehicle: effects."""

    effects: tuple = field(default_factory=tuple)


def test_a_replay_shows_the_pose_late_and_the_odometry_in_time():
    from sysid.replay.records import Plant

    def observe(state):
        return jnp.concatenate([state, jnp.zeros(2), state[:1], state[:1], jnp.zeros(3)])[:9]

    plant = Plant(place=lambda params, start: start[:3], observe=observe, dt=0.025, move=lambda state, start: state,
                  substep=lambda params, state, command: state.at[0].add(0.025 * command[0]))
    command = jnp.zeros((80, 1, 2)).at[40:, 0, 0].set(2.0)  # at rest for 1 s, then 2 m/s
    start = jnp.zeros(5)
    plain = path_of(plant, Cart(), command, start)
    late = path_of(plant, Cart((make_effect("pose_delay", delay=0.3),)), command, start)
    np.testing.assert_allclose(late[12:, 0], plain[:-12, 0], atol=1e-5)
    np.testing.assert_array_equal(late[:, 3:], plain[:, 3:])


def test_blocks_of_a_long_reference_run_count_as_days():
    windows = tuple(window(f"run/{i:03d}", speed=1.0 + 0.1 * i) for i in range(26))
    long, short = (Log("run", HUSKY, trials, "") for trials in (windows, windows[:9]))
    days = days_of((long, short))
    assert [len(one.training) for one in days] == [4, 4, 3, 3, 3, 3, 3, 3, 9]
    assert [trial.name for one in days[:8] for trial in one.training] == [trial.name for trial in windows]
    assert len({one.name for one in days}) == 9
    twice = Log("day", HUSKY, (*windows, *windows), "")  # driven twice: one day
    assert days_of((twice,)) == (twice,)
