"""The chair's joystick is locked only while the vehicle is armed, and never for good."""

import pytest

from bridge.drive import main
from bridge.nodes.exits import Exit
from bridge.safeguards.joystick_lock import AGAIN, NOT_LOCKED, JoystickLock
from bridge.safeguards.safety import SafetyConfig, Supervisor
from bridge.safeguards.watchdog import FORGET, Watchdog

pytestmark = pytest.mark.quick


class Driver:
    """The chair's driver, which answers when it is told to."""

    def __init__(self):
        self.asked, self.waiting = [], []

    def ask(self, locked, answered):
        self.asked.append(locked)
        self.waiting.append(answered)

    def answer(self, done=True):
        self.waiting.pop(0)(done)


@pytest.fixture
def chair():
    driver = Driver()
    lock = JoystickLock(driver.ask)
    supervisor = Supervisor(SafetyConfig((-1.0, -1.0), (1.0, 1.0), require_arm=True))
    return driver, lock, supervisor


def test_armed_vehicle_stands_until_the_driver_has_confirmed_the_lock(chair):
    driver, lock, supervisor = chair
    lock.follow(0.0, supervisor)
    driver.answer()
    assert driver.asked == [False] and supervisor.holds == []  # disarmed: the joystick is the rider's
    supervisor.arm()
    lock.follow(1.0, supervisor)
    assert driver.asked == [False, True] and supervisor.holds == [NOT_LOCKED]
    driver.answer()
    lock.follow(1.01, supervisor)
    assert supervisor.holds == [] and driver.asked == [False, True]


def test_request_is_made_again_until_it_is_confirmed(chair):
    driver, lock, supervisor = chair
    supervisor.arm()
    lock.follow(0.0, supervisor)
    lock.follow(0.9 * AGAIN, supervisor)
    assert driver.asked == [True]
    driver.answer(done=False)
    lock.follow(1.1 * AGAIN, supervisor)
    assert driver.asked == [True, True] and supervisor.holds == [NOT_LOCKED]


@pytest.mark.parametrize("stop", ["latch", "yield"])
def test_stop_that_needs_a_person_unlocks_the_joystick_at_once(chair, stop):
    driver, lock, supervisor = chair
    supervisor.arm()
    lock.follow(0.0, supervisor)
    driver.answer()
    supervisor.latch("emergency stop") if stop == "latch" else supervisor.foreign_command(0.1)
    lock.follow(0.1, supervisor)
    assert driver.asked == [True, False]


def test_late_answer_to_an_earlier_request_confirms_nothing(chair):
    driver, lock, supervisor = chair
    supervisor.arm()
    lock.follow(0.0, supervisor)
    supervisor.latch("emergency stop")
    lock.follow(0.1, supervisor)
    driver.answer()  # that it was locked
    assert lock.locked is None
    driver.answer()
    assert lock.locked is False


@pytest.mark.parametrize("driving, after", [(True, 0.2), (False, FORGET + 0.1)])
def test_guard_finds_that_a_node_is_gone_whether_it_drove_or_stood(driving, after):
    watchdog = Watchdog()
    for tick in range(10):
        watchdog.heartbeat(0.01 * tick, "a", driving)
        watchdog.tick(0.01 * tick)
    assert not watchdog.abandoned
    for tick in range(10, 10 + int(after / 0.01) + 1):
        watchdog.tick(0.01 * tick)
    assert watchdog.abandoned
    watchdog.heartbeat(9.0, "b", False)
    assert not watchdog.abandoned


def test_lock_without_an_operator_is_refused(policy, capsys):
    assert main([str(policy), "--joystick-lock"]) == Exit.REFUSED
    assert "Give --require-arm too" in capsys.readouterr().err
