"""Fixtures of the tests with real ROS nodes."""

import importlib.util

import pytest
import tiny_policy
from ros_graph import Graph

from benchmarks.ros_domains import free_domain


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
