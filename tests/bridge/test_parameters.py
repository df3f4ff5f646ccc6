"""ROS parameters become options of the command line, which wins over them."""

import pytest

from bridge.drive import parse_arguments
from bridge.parameters import with_options

pytest.importorskip("yaml")
pytestmark = pytest.mark.quick
FILE = """
/**:
  ros__parameters: {use_sim_time: false, e_stop: watch}
bridge_drive:
  ros__parameters:
    policy: runs/a
    v_limits: [-0.2, 0.3]
    require_arm: true
    allow_other_commanders: false
other_node:
  ros__parameters: {e_stop: ignore}
"""


def options(ros_arguments, *own):
    return parse_arguments(with_options(ros_arguments, "bridge_drive", "policy", list(own)))


def test_parameter_file_sets_the_options_of_its_node(tmp_path):
    (tmp_path / "a.yaml").write_text(FILE)
    parsed = options(["--ros-args", "--params-file", str(tmp_path / "a.yaml")])
    assert (parsed.policy, parsed.v_limits, parsed.e_stop) == ("runs/a", [-0.2, 0.3], "watch")
    assert parsed.require_arm and not parsed.allow_other_commanders


def test_later_parameters_and_the_command_line_win(tmp_path):
    (tmp_path / "a.yaml").write_text(FILE)
    ros = ["--ros-args", "--params-file", str(tmp_path / "a.yaml"), "-p", "e_stop:=require", "-p", "stamp_age:=.inf"]
    parsed = options(ros, "runs/b", "--v-limits", "-0.1", "0.1")
    assert (parsed.policy, parsed.v_limits, parsed.e_stop) == ("runs/b", [-0.1, 0.1], "require")
    assert parsed.stamp_age == float("inf")


def test_parameter_that_is_no_option_is_refused():
    with pytest.raises(SystemExit):
        options(["--ros-args", "-p", "policy:=a", "-p", "no_such_option:=1"])


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "3"])
def test_file_that_is_no_parameter_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ValueError, match="YAML|bad.yaml"):
        options(["--ros-args", "--params-file", str(tmp_path / "bad.yaml")])


def test_missing_parameter_file_is_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere.yaml"):
        options(["--ros-args", "--params-file", str(tmp_path / "nowhere.yaml")])
