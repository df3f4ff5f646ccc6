"""Errors before and after, manoeuvre by manoeuvre: what they are, their intervals, and what got worse."""

import numpy as np
import pytest

from sysid.follow_up.changes import by_manoeuvre, squared_errors, worse
from sysid.logs.metrics import score
from sysid.logs.records import Command, OdometryStream, PoseStream, Prediction, Start, Trial

pytestmark = pytest.mark.quick
T = np.linspace(0.0, 12.0, 121)


def trial(name, held_out=False):
    zero = np.zeros_like(T)
    return Trial(f"{name}_1", name, Command(T[:1], zero[:1], zero[:1]), OdometryStream(T, zero, zero, zero, zero, zero),
                 PoseStream(T, zero, zero, zero), Start(), held_out)


def off(size, seed):
    """A replay that is off by noise of some size in everything."""
    rng = np.random.default_rng(seed)
    return Prediction(PoseStream(T, *(size * rng.standard_normal((3, len(T))))),
                      OdometryStream(T, *(size * rng.standard_normal((5, len(T))))))


def test_squares_are_those_of_the_score():
    one, replay = trial("circle"), off(0.1, 0)
    squares, scores = squared_errors(one, replay), score(one, replay)
    for channel, errors in scores.items():
        for metric, value in errors.items():
            assert value is None or np.sqrt(squares[channel][metric][1].mean()) == pytest.approx(value)


def test_each_manoeuvre_is_told_apart_and_what_got_worse_is_listed():
    trials = [trial("circle"), trial("circle"), trial("turn"), trial("turn", held_out=True)]
    before = [off(0.1, k) for k in range(4)]
    after = [off(size, 10 + k) for k, size in enumerate((0.05, 0.05, 0.2, 0.1))]
    rows = by_manoeuvre(trials, before, after)
    circle, turn, held_out = ([row for row in rows if (row["manoeuvre"], row["part"]) == key] for key in (
        ("circle", "training"), ("turn", "training"), ("turn", "held_out")))
    assert len(circle) == len(turn) == len(held_out) == 6  # two of the pose, four of the odometry
    assert all(row["interval"][1] < 0 and row["trials"] == 2 for row in circle)
    assert all(row["interval"][0] < row["change"] < row["interval"][1] for row in rows)
    grown = worse(rows)
    assert {row["manoeuvre"] for row in grown if row["part"] == "training"} == {"turn"}
    assert sum(row["part"] == "training" for row in grown) == 6
    shares = [row["change"] / row["before"] for row in grown]
    assert shares == sorted(shares, reverse=True)


def test_intervals_hold_the_true_change_as_often_as_they_say():
    inside = 0
    for seed in range(100):
        trials = [trial("circle") for _ in range(3)]
        rows = by_manoeuvre(trials, [off(0.2, 1000 * seed + k) for k in range(3)],
                            [off(0.1, 1000 * seed + 500 + k) for k in range(3)], seed)
        low, high = next(row["interval"] for row in rows if row["metric"] == "velocity")
        inside += low < -0.1 < high
    assert 85 <= inside <= 100
