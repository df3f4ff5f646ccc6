"""No signal that ends a command is lost, and none hides an error."""

import os
import signal
from types import SimpleNamespace

import pytest

from bridge.nodes import ros, signals
from bridge.nodes.exits import Exit, OptionError
from bridge.nodes.options import ends_at_ctrl_c

pytestmark = pytest.mark.quick


@pytest.fixture(autouse=True)
def handlers():
    """Those of a command that a user starts, without nohup, which has SIGHUP ignored."""
    before = {number: signal.getsignal(number) for number in signals.ENDING}
    for number in signals.ENDING:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def kill(number=signal.SIGINT):
    os.kill(os.getpid(), number)


def test_ctrl_c_whose_exception_an_import_turned_into_another_still_ends_the_command(capsys):
    @ends_at_ctrl_c
    def main(arguments):
        try:
            kill()
        except KeyboardInterrupt:
            raise ImportError("the extension is not there") from None

    assert main([]) == Exit.STOPPED and capsys.readouterr().err.endswith("stopped (SIGINT)\n")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_without_a_signal_stays_an_error():
    @ends_at_ctrl_c
    def main(arguments):
        raise ImportError("the extension is not there")

    with pytest.raises(ImportError):
        main([])


@pytest.fixture
def session(monkeypatch):
    """A node session without ROS: what happens while the node is made, and what became of it."""
    pytest.importorskip("rclpy")
    ended, during = [], []

    def join(name, arguments, managed):
        for act in during:
            act()
        return SimpleNamespace(destroy_node=lambda: ended.append(name))

    monkeypatch.setattr(ros, "_join", join)
    monkeypatch.setattr("rclpy.try_shutdown", lambda: None)
    return SimpleNamespace(ended=ended, during=during)


def run(block):
    @ends_at_ctrl_c
    def main(arguments):
        with ros.node_session("bridge_test", []) as node:
            block(node)
        return Exit.DONE

    return main([])


@pytest.mark.parametrize("number", signals.ENDING)
def test_a_signal_while_the_node_is_made_ends_the_command_before_it_runs(number, session, capsys):
    session.during.append(lambda: kill(number))
    assert run(lambda node: pytest.fail("begun")) == Exit.STOPPED
    assert session.ended == ["bridge_test"] and signals.name_of(number) in capsys.readouterr().err


def test_ctrl_c_that_was_swallowed_before_the_node_is_not_lost(session):
    @ends_at_ctrl_c
    def main(arguments):
        try:
            kill()
        except KeyboardInterrupt:
            pass  # as Python does in a callback of its garbage collector
        with ros.node_session("bridge_test", []):
            pytest.fail("begun")

    assert main([]) == Exit.STOPPED


@pytest.mark.parametrize("number", signals.ENDING)
def test_a_signal_between_the_node_and_its_spin_is_heeded_by_the_spin(number, session, monkeypatch):
    executor = SimpleNamespace(add_node=lambda _: None, remove_node=lambda _: None, shutdown=lambda: None,
                               spin_once=lambda timeout_sec: pytest.fail("spins"))
    monkeypatch.setattr(ros, "make_executor", lambda: executor)

    def block(node):
        kill(number)
        ros.spin(node)
        kill(number)  # an impatient second one disturbs no goodbye

    assert run(block) == Exit.DONE and session.ended == ["bridge_test"]


def test_an_error_after_an_orderly_end_is_not_called_a_stop(session):
    def block(node):
        kill()
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        run(block)
    assert session.ended == ["bridge_test"]


def test_an_option_that_shows_only_in_the_graph_to_be_wrong_is_refused_with_one_line(session, capsys):
    def block(node):
        raise OptionError("--yield-to a: is b. Leave it out.")

    with pytest.raises(SystemExit) as ended:
        run(block)
    assert ended.value.code == Exit.REFUSED and session.ended == ["bridge_test"]
    assert capsys.readouterr().err == "bridge.test: --yield-to a: is b. Leave it out.\n"


def test_an_event_of_a_reader_that_was_replaced_by_another_does_not_end_a_node(session, monkeypatch):
    implementation = pytest.importorskip("rclpy.impl.implementation_singleton").rclpy_implementation
    events = [implementation.InvalidHandle("the reader is gone"), None]

    def spin_once(timeout_sec):
        if (event := events.pop(0)) is not None:
            raise event

    executor = SimpleNamespace(add_node=lambda _: None, remove_node=lambda _: None, shutdown=lambda: None,
                               spin_once=spin_once)
    monkeypatch.setattr(ros, "make_executor", lambda: executor)
    assert run(lambda node: ros.spin(node, done=lambda: not events)) == Exit.DONE and not events
