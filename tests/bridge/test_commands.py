"""Whose a command is, and in which type a base listens."""

import numpy as np
import pytest

from bridge.commands import Ear, Endpoint, choose_type, without

pytestmark = pytest.mark.quick
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def test_own_commands_are_never_taken_for_those_of_another_even_where_some_are_lost():
    rng = np.random.default_rng(0)
    ear = Ear()
    for i in range(1000):
        command = (float(rng.choice([0.0, 0.1, rng.normal()])), 0.0)
        ear.sent(*command)
        if rng.random() < 0.9:
            assert not ear.heard(i / 10, *command)
        assert not ear.foreign_zero(i / 10 + 0.05)


@pytest.mark.parametrize("foreign", [(9.0, 0.0), (0.0, 0.1), (float("nan"), 0.0), (0.1000001, 0.0)])
def test_command_that_nobody_of_ours_sent_is_foreign_at_once(foreign):
    ear = Ear()
    ear.sent(0.1, 0.0)
    assert ear.heard(1.0, *foreign)
    assert not ear.heard(1.0, 0.1, 0.0)


def test_zero_of_another_node_is_noticed_but_the_guards_zeros_are_not_taken_for_it():
    ear = Ear()
    ear.guard_reports(0.0, 7)  # stops before this bridge began
    ear.guard_reports(1.0, 9)
    assert not ear.heard(1.01, 0.0, 0.0) and not ear.heard(1.02, 0.0, 0.0)
    assert not ear.foreign_zero(2.0)
    assert not ear.heard(3.0, 0.0, 0.0)
    assert not ear.foreign_zero(3.1) and ear.foreign_zero(3.2) and not ear.foreign_zero(3.3)


def test_zero_heard_before_the_guard_reports_it_is_the_guards():
    ear = Ear()
    ear.guard_reports(0.0, 0)
    ear.heard(1.0, 0.0, 0.0)
    ear.guard_reports(1.05, 1)
    assert not ear.foreign_zero(2.0)


def test_report_of_a_zero_that_was_lost_excuses_no_later_one():
    ear = Ear()
    ear.guard_reports(0.0, 0)
    ear.guard_reports(1.0, 1)
    assert not ear.foreign_zero(2.5)
    ear.heard(3.0, 0.0, 0.0)
    assert ear.foreign_zero(3.2)


@pytest.mark.parametrize("types, chosen", [
    ([], ""), ([TWIST], "Twist"), ([STAMPED], "TwistStamped"), ([STAMPED, TWIST], "Twist"),
    (["std_msgs/msg/String"], ""), (["std_msgs/msg/String", STAMPED], "TwistStamped"),
])
def test_commands_are_sent_as_the_base_listens(types, chosen):
    assert choose_type([Endpoint("/base", kind) for kind in types]) == chosen


def test_second_node_of_the_same_name_is_somebody_else():
    ends = [Endpoint(name, TWIST) for name in ("/bridge_drive", "/bridge_guard", "/bridge_drive", "/left/bridge_guard")]
    assert [end.node for end in without(ends, "/bridge_drive", "/bridge_guard")] == ["/bridge_drive",
                                                                                    "/left/bridge_guard"]
