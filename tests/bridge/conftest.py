"""Fixtures of the tests with real ROS nodes."""

import importlib.util
import os

import pytest
import tiny_policy
from ros_graph import Graph, free_domain

os.environ.setdefault("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")  # of peers in this process, as `LOOPBACK` of the others


@pytest.fixture
def graph(tmp_path):
    if importlib.util.find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    with free_domain() as domain:
        graph = Graph(tmp_path, domain)
        yield graph
        graph.close()


@pytest.fixture
def policy(tmp_path):
    return tiny_policy.write(tmp_path / "tiny")
