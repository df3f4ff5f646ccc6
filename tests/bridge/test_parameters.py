"""ROS parameters become options of the command line, which wins over them."""

import importlib
from pathlib import Path

import pytest

from bridge.drive import parse_arguments
from bridge.nodes.parameters import command_line, with_options

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


@pytest.mark.parametrize("value", ["1", "false", "''", "null"])
def test_parameter_that_is_no_option_is_refused(value, capsys):
    with pytest.raises(SystemExit):
        options(["--ros-args", "-p", "policy:=a", "-p", f"no_such_option:={value}"])
    assert "--no-such-option" in capsys.readouterr().err


def test_an_option_whose_parameter_is_false_or_empty_keeps_its_default():
    given = ["--ros-args", "-p", "policy:=a", "-p", "realtime:=false", "-p", "v_limits:=null"]
    assert options(given) == options(["--ros-args", "-p", "policy:=a"])


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "3"])
def test_file_that_is_no_parameter_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ValueError, match="YAML|bad.yaml"):
        options(["--ros-args", "--params-file", str(tmp_path / "bad.yaml")])


TWO = """
/left/bridge_drive: {ros__parameters: {v_limits: [-0.1, 0.1]}}
/right:
  bridge_drive: {ros__parameters: {v_limits: [-0.2, 0.2]}}
/far/*: {ros__parameters: {v_limits: [-0.3, 0.3]}}
"""


@pytest.mark.parametrize("namespace, limit", [("/left", 0.1), ("/right", 0.2), ("right/", 0.2), ("/far", 0.3)])
def test_each_of_several_chairs_gets_the_parameters_of_its_namespace(tmp_path, namespace, limit):
    (tmp_path / "two.yaml").write_text(TWO)
    parsed = options(["--ros-args", "-r", f"__ns:={namespace}", "--params-file", str(tmp_path / "two.yaml")], "runs/a")
    assert parsed.v_limits == [-limit, limit]


@pytest.mark.parametrize("names", [(), ("-r", "__ns:=/middle"), ("-r", "__ns:=/left", "-r", "__node:=other")])
def test_file_without_a_section_for_the_node_is_refused_by_name(tmp_path, names):
    (tmp_path / "two.yaml").write_text(TWO)
    with pytest.raises(ValueError, match=r"two.yaml: has no section for the node .*/left/bridge_drive, /right/bridge"):
        options(["--ros-args", *names, "--params-file", str(tmp_path / "two.yaml")], "runs/a")


def test_file_whose_table_contains_itself_is_refused(tmp_path):
    (tmp_path / "endless.yaml").write_text("a: &a {b: *a, c: *a}")
    with pytest.raises(ValueError, match=r"endless.yaml: holds more than"):
        options(["--ros-args", "--params-file", str(tmp_path / "endless.yaml")], "runs/a")


def test_renamed_node_has_the_section_of_its_name_and_parameters_of_others_are_left_alone(tmp_path):
    (tmp_path / "one.yaml").write_text("chair_1: {ros__parameters: {e_stop: watch}}")
    ros = ["--ros-args", "-r", "__node:=chair_1", "--params-file", str(tmp_path / "one.yaml"),
           "-p", "other:base:=generic", "-p", "chair_1:blind:=stop"]
    parsed = options(ros, "runs/a")
    assert (parsed.e_stop, parsed.base, parsed.blind) == ("watch", "whill", "stop")


@pytest.mark.parametrize("name, parameter, option, value", [
    ("guard", "command_topic:=base/cmd_vel", "command_topic", "base/cmd_vel"),
    ("chair", "wheel_radius:=0.13", "wheel_radius", 0.13),
    ("chair_joy", "full:=[0.5, 0.4, 0.8]", "full", [0.5, 0.4, 0.8]),
    ("record", "odometry_topic:=odom", "odometry_topic", "odom"),
    ("simulate", "seed:=4", "seed", 4),
])
def test_each_command_takes_its_parameters(name, parameter, option, value):
    command = importlib.import_module(f"bridge.{name}")
    words = ["logs", "one"] if name == "record" else []
    own, _ = command_line([*words, "--ros-args", "-r", "__ns:=/left", "-p", parameter, "-p", "use_sim_time:=false"],
                          f"bridge.{name}")
    assert getattr(command.parse_arguments(own), option) == value
    with pytest.raises(SystemExit):  # and none in silence
        command.main([*words, "--ros-args", "-p", "no_such_option:=1"])


@pytest.mark.parametrize("name, words, parameters, expected", [
    ("record", ["logs", "one"], ["held_out:=[a_1, b_1]"], {"trial": "one", "held_out": ["a_1", "b_1"]}),
    ("record", ["--seconds", "3", "--", "logs", "one"], ["held_out:=[a_1]"], {"trial": "one", "held_out": ["a_1"]}),
    ("simulate", ["runs/a"], ["wheels:=[left, right]"], {"policy": Path("runs/a"), "wheels": ["left", "right"]}),
    ("simulate", ["runs/a"], ["policy:=runs/b", "seed:=3"], {"policy": Path("runs/a"), "seed": 3}),
    ("simulate", ["--seed", "3"], ["policy:=runs/b", "wheels:=[left, right]"], {"policy": Path("runs/b"), "seed": 3}),
])
def test_a_list_of_a_parameter_takes_no_word_of_the_command_line(name, words, parameters, expected):
    command = importlib.import_module(f"bridge.{name}")
    ros = [word for one in parameters for word in ("-p", one)]
    own, _ = command_line([*words, "--ros-args", *ros], f"bridge.{name}", "policy" if name == "simulate" else "")
    parsed = vars(command.parse_arguments(own))
    assert {key: parsed[key] for key in expected} == expected


def test_command_without_a_section_in_its_parameter_file_says_so(tmp_path, capsys):
    from bridge.chair import main

    (tmp_path / "one.yaml").write_text("bridge_drive: {ros__parameters: {e_stop: watch}}")
    with pytest.raises(SystemExit) as ended:
        main(["--ros-args", "--params-file", str(tmp_path / "one.yaml")])
    assert ended.value.code == 1 and "no section for the node /bridge_chair" in capsys.readouterr().err


def test_missing_parameter_file_is_named(tmp_path):
    with pytest.raises(ValueError, match="nowhere.yaml"):
        options(["--ros-args", "--params-file", str(tmp_path / "nowhere.yaml")])
