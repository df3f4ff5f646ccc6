"""Nodes of different programs and tests do not hear one another."""

import tempfile

import pytest

from benchmarks import ros_domains

pytestmark = pytest.mark.quick


def test_a_domain_is_not_used_again_while_what_a_test_left_behind_may_still_speak(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(ros_domains.random, "randrange", lambda _: 6)
    monkeypatch.setattr(ros_domains, "LINGER", 600.0)  # however slow the machine
    with ros_domains.free_domain() as one, ros_domains.free_domain() as other:
        assert (one, other) == (7, 8)
    with ros_domains.free_domain() as later:
        assert later == 9
    monkeypatch.setattr(ros_domains, "LINGER", 0.0)
    with ros_domains.free_domain() as again:
        assert again == 7
