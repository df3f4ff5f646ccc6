"""The closed loop on drives that stand alone: windows of one long drive, with a slow outside pose of its own clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from linear_drives import EFFECTS, Linear, drives

from sysid.errors.features import BIN, bin_width, make_features
from sysid.logs.records import Command, Log, OdometryStream, PoseStream, Start, Trial, manoeuvre_of
from sysid.missing.catalogue import Axis, Hypothesis
from sysid.missing.days import no_wander
from sysid.missing.drives import session_times
from sysid.missing.joint_fit import Start as JointStart
from sysid.missing.signatures import group_names, manoeuvre_groups
from sysid.replay.one_drive import Commanded, path_of
from sysid.replay.rollout import make_batch
from sysid.verdict import alone, rounds
from sysid.verdict.alone import UNTOLD, search_alone, stands_alone
from sysid.verdict.posterior import NOTHING, Thresholds
from sysid.verdict.preparation import days_of
from sysid.verdict.result import LoopConfig
from sysid.verdict.rounds import Asked, _nearly_best, begin, nearer, refitted
from sysid.verdict.search_record import Candidate
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
    assert [len(group) for group in manoeuvre_groups(windows)] == [2] * 8
    assert [len(group) for group in manoeuvre_groups(windows[:5])] == [1] * 5
    assert stands_alone(windows, known=False) and not stands_alone(windows, known=True)
    again = tuple(window(f"run/{i}") for i in range(16))
    assert [len(group) for group in manoeuvre_groups(again)] == [16]
    assert not stands_alone(again, known=False)


@pytest.mark.parametrize("name", ["run_{}", "run{}", "rosbag2_2026_05_01-10_20_{:02d}"])
def test_what_is_held_back_together_follows_from_the_commands_and_not_from_names_of_files(name):
    speeds = (1.0, 1.2, 1.4, 1.2, 1.6)
    trials = tuple(replace(window(name.format(i), speed=speed), manoeuvre=manoeuvre_of(name.format(i)))
                   for i, speed in enumerate(speeds))
    groups = manoeuvre_groups(trials)
    assert groups == ((0,), (1, 3), (2,), (4,))
    assert len(set(group_names(trials, groups))) == 4


@pytest.mark.parametrize("names, began", [
    (("run_1", "run_2", "run_3"), (100.0, 300.0, 500.0)),
    (("run_7", "run_60"), (1300.0, 11900.0)),
    (("run_7",), (np.nan,)),
    (("run_1",), (100.0,)),
    (("run_2026_05_01-10_20_30",), (np.nan,)),
    (("run1", "run2"), (np.nan, np.nan)),
])
def test_replicates_were_driven_in_the_rounds_that_their_names_count(names, began):
    trials = tuple(replace(window(name), manoeuvre=manoeuvre_of(name)) for name in names)
    np.testing.assert_array_equal(session_times(trials), began)
    others = tuple(window(f"run_{i}", speed=1.0 + 0.2 * i) for i in range(3))
    assert np.isnan(session_times(others)).all()


def asked_of(evidence, refitter):
    ready = SimpleNamespace(hypotheses=EFFECTS, wander=no_wander(evidence.columns))
    return begin(evidence, ready, refitter, LoopConfig(draws=300))


def verdict(sizes, wheels=True, **more):
    """The verdict on linear drives that stand alone."""
    evidence = drives(sizes, **more)
    asked = asked_of(evidence, Linear(evidence))
    return search_alone(asked, wheels=wheels)


def named(found):
    return found.verdict, [one.hypothesis.effect for one in found.accepted]


def test_effects_are_added_as_long_as_they_predict_blocks_that_were_held_back():
    found = verdict((0.0, 0.0, 1.0, 0.4))
    assert named(found) == ("named", ["side_force", "command_scale"])
    assert [one.hypothesis.effect for one in found.rounds[1]][0] == "command_scale" and len(found.rounds) == 3
    assert UNTOLD in found.reason and found.excess[1] < found.excess[0]


class Slow(Linear):
    """Fits that go a tenth of what is left of the way in each iteration."""

    def fit(self, chosen, q, iterations=12):
        return self.fit_all([JointStart(tuple(chosen), self.reference.u, q)], iterations)[0]

    def fit_all(self, starts, iterations):
        return [self.on_the_way(start, 0.9**iterations) for start in starts]

    def on_the_way(self, start, left):
        end, size = super().fit(start.hypotheses, None), len(start.u)
        at = np.concatenate([end.u, end.q])
        away = left * (np.concatenate([start.u, start.q]) - at)
        residual = end.residual - end.jacobian @ away
        return replace(end, u=(at + away)[:size], q=(at + away)[size:], cost=float(np.square(residual).sum()),
                       residual=residual)


def test_a_fit_starts_where_the_drives_fit_better_than_without_the_effect():
    linear = Linear(drives((0.0, 0.0, 1.0, 0.0)))
    current = linear.fit((), None)
    starts = [JointStart(EFFECTS[2:3], current.u, np.array([size])) for size in (1.5, 8.0)]
    first, second = nearer(linear, starts, current)
    assert first is starts[0] and second.q == pytest.approx([0.8])


def test_no_effect_is_credited_with_what_the_fit_before_it_had_not_found_yet():
    evidence = drives((0.0, 0.0, 2.0, 0.0))
    asked = asked_of(evidence, Slow(evidence))
    small = replace(asked.scan, q=tuple(0.1 * q for q in asked.scan.q))  # a linear scan may be far off
    found = search_alone(replace(asked, far=None, scan=small))
    exact = verdict((0.0, 0.0, 2.0, 0.0))
    assert named(found) == named(exact) == ("named", ["side_force"])
    assert found.accepted[0].gain == pytest.approx(exact.accepted[0].gain, rel=1e-3)
    assert max(one.gain for one in found.rounds[1]) < 10  # chance


def test_what_every_block_asks_another_size_of_is_not_named():
    sizes = np.zeros((6, 1, 4))
    sizes[..., 2] = np.array([3.0, -1.0, -1.0, -1.0, 3.0, -1.0])[:, None]
    found = verdict(sizes)
    assert found.rounds and found.verdict != "named" and not found.accepted
    assert "does not predict blocks" in found.reason and UNTOLD in found.reason


@pytest.mark.parametrize(("place", "wheels", "result"), [
    (2, True, "named"), (2, False, "unexplained"), (0, False, "named")])
def test_an_effect_of_the_wheels_has_a_name_only_where_the_wheels_were_seen(place, wheels, result):
    found = verdict(np.eye(4)[place], wheels)
    assert found.verdict == result
    assert ("log their speeds" in found.reason) == (result == "unexplained")


def test_what_stands_beside_an_effect_without_a_name_has_one():
    """The unseen one stays in the fit, so that another does not stand for it."""
    found = verdict((0.0, 0.0, 1.0, 0.4), wheels=False)
    assert named(found) == ("named", ["command_scale"]) and "side_force stands out" in found.reason
    assert [one.effect for one in found.final.hypotheses] == ["side_force", "command_scale"]
    assert 0.05 < found.share < 0.3  # of what is explained, the larger part has no name


@pytest.mark.parametrize(("gains", "result"), [
    ([(9.0, 11.0, 10.0), (8.0, 11.0, 10.0), (2.0, 2.0, 2.0)], "command_delay"),  # as good, and simpler
    ([(9.0, 11.0, 10.0), (3.0, 4.0, 5.0), (2.0, 2.0, 2.0)], "acceleration_limit"),  # surely better
    ([(9.0, -11.0, 10.0), (3.0, 4.0, 5.0), (2.0, 2.0, 2.0)], "command_delay"),  # wrong about a block
])
def test_of_effects_that_predict_held_back_blocks_as_well_the_simplest_is_named(monkeypatch, gains, result):
    found = weighed(monkeypatch, gains, lambda asked, best, _: [best.hypothesis.effect])
    assert named(found) == ("named", [result])
    assert ("acceleration_limit" in found.classes[0]) == (gains[0][1] > 0)


@pytest.mark.parametrize(("foretold", "result"), [
    ((3.0, 4.0, 5.0), ("named", ["command_delay"])),
    ((3.0, -4.0, 5.0), ("unexplained", [])),  # wrong about a block
])
def test_where_wheels_were_not_seen_what_a_pose_shows_is_named_with_the_best_one_in_its_class(
        monkeypatch, foretold, result):
    gains = [(9.0, 11.0, 10.0), foretold, (2.0, -9.0, 2.0)]
    found = weighed(monkeypatch, gains, lambda *_: ["acceleration_limit", "command_delay"], wheels=False)
    assert named(found) == result
    assert found.classes == ([["command_delay", "acceleration_limit"]] if found.accepted else [])
    apart = weighed(monkeypatch, gains, lambda *_: ["acceleration_limit"], wheels=False)
    assert apart.verdict == "unexplained" and "acceleration_limit stands out" in apart.reason


def weighed(monkeypatch, gains, class_of, wheels=True):
    """The verdict in one round of three effects, by what each gains in blocks that were held back."""
    def candidate(effect, axes, gain):
        one = Hypothesis(effect, tuple(Axis(f"{effect}.{i}", 1.0) for i in range(axes)))
        return Candidate(one, gain, 1e-4 if gain > 55 or wheels else 0.01, 1.0, replace(base, cost=gain))

    evidence = drives(np.zeros(4))
    linear = Linear(evidence)
    base = linear.fit((), None)
    asked = Asked(evidence, EFFECTS, linear, no_wander(evidence.columns), Thresholds(), base,
                  SimpleNamespace(p_family=0.0), np.eye(4))
    listed = [candidate(*each) for each in (
        ("acceleration_limit", 3, 60.0), ("command_delay", 1, 50.0), ("slope", 1, 20.0))]
    told = dict(zip((60.0, 50.0, 20.0), gains, strict=True))

    def candidates_of(asked, found, *_):
        found.rounds.append(listed)
        return listed

    monkeypatch.setattr(alone, "ROUNDS", 1)
    monkeypatch.setattr(alone, "candidates_of", candidates_of)
    monkeypatch.setattr(alone, "held_back", lambda asked, fit: np.array(told[fit.cost]))
    monkeypatch.setattr(alone, "class_of", class_of)
    return search_alone(asked, wheels=wheels)


def test_what_may_have_a_name_is_tried_and_followed_to_its_end_beside_what_gains_more(monkeypatch):
    evidence = drives((0.0, 0.0, 1.0, 0.4))
    asked = asked_of(evidence, Linear(evidence))
    monkeypatch.setattr(rounds, "CANDIDATES", 1)

    def tried(asked):
        scan = (asked.scan.gain, asked.scan.worth, asked.scan.q)
        return {one.hypothesis.effect: one for one in refitted(asked, asked.base, [scan])}

    apart = replace(asked, named=lambda effect: effect != "side_force")
    assert "command_scale" not in tried(asked)
    found = tried(apart)
    assert found["side_force"].gain > 2 * found["command_scale"].gain > 0
    fits = [found[name].refit for name in ("side_force", "command_scale")]
    assert _nearly_best(asked, fits, asked.base) == [0] and _nearly_best(apart, fits, asked.base) == [0, 1]


def test_with_nothing_found_it_says_that_it_cannot_tell():
    found = verdict(np.zeros(4))
    assert found.verdict == "none" and found.reason == f"{NOTHING}; {UNTOLD}"


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
    plain = path_of(plant, Cart(), Commanded(command, start))
    late = path_of(plant, Cart((make_effect("pose_delay", delay=0.3),)), Commanded(command, start))
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
