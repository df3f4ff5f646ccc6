"""The environment on a vehicle, without a graph."""

import types

import pytest

pytest.importorskip("gymnasium")
pytestmark = pytest.mark.quick


@pytest.mark.parametrize("period, least", [(0.1, 0.25), (1.0, 2.5)])
def test_vehicle_is_stopped_while_its_camera_is_silent_and_not_only_when_patience_ends(monkeypatch, period, least):
    from bridge import ros_env

    now, sent = [100.0], []
    monkeypatch.setattr(ros_env.time, "monotonic", lambda: now[0])
    env = ros_env.RosEnv.__new__(ros_env.RosEnv)
    env.period, env._newest = period, (5, 0)
    env._send = lambda v, omega: sent.append((now[0] - 100.0, v, omega))

    def spin_once(timeout_sec):
        now[0] += timeout_sec

    env._executor = types.SimpleNamespace(spin_once=spin_once)
    with pytest.raises(TimeoutError, match="no new image"):
        env._wait_for_newer((5, 0))
    ((at, v, omega),) = sent
    assert (v, omega) == (0.0, 0.0) and least < at < least + 0.15
