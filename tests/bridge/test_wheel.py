"""The robot's own wheel holds all that the robot needs and nothing of the training."""

import ast
import configparser
import runpy
import shlex
import shutil
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest
import tiny_policy

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of the folder alone."""
    pytest.importorskip("wheel")
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT / "bridge", folder / "bridge", ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index",
                    "--wheel-dir", folder / "out", folder / "bridge"], check=True, cwd=folder)
    (path,) = (folder / "out").glob("*.whl")
    return path


CLEAN = """
import importlib, pkgutil, sys

class Forbidden:
    names = "jax jaxlib flax mujoco optax orbax scipy onnx whill_mjx dreamer sysid benchmarks cv2 matplotlib".split()
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in self.names:
            raise ModuleNotFoundError(f"{name} is not on the robot")

sys.meta_path.insert(0, Forbidden())
wheel, policy = sys.argv[1:]
sys.path.insert(0, wheel)
import bridge
assert bridge.__file__.startswith(wheel), bridge.__file__
for module in pkgutil.iter_modules(bridge.__path__):
    importlib.import_module(f"bridge.{module.name}")
assert "rclpy" not in sys.modules
from bridge.driving.controller import Controller
from bridge.drive import parse_arguments, safety_config
from bridge.sensing.image import RawImage
from bridge.policy import Policy
loaded = Policy.load(policy)
controller = Controller(loaded, safety_config(loaded, parse_arguments([policy])))
images = [RawImage(64, 64, "rgb8", 192, bytes([200 + i]) * 12288) for i in range(5)]
commands = [controller.on_image(i / 10, i / 10, 0.0, image) for i, image in enumerate(images)]
assert commands[-1].v > 0.1 and commands[-1].reason == "", commands
"""


def test_wheel_drives_where_nothing_of_the_training_can_be_imported(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    policy = tiny_policy.write(tmp_path / "tiny")
    result = subprocess.run([sys.executable, "-I", "-c", CLEAN, tmp_path / "installed", policy], cwd=tmp_path,
                            capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_wheel_is_pure_python_3_10_with_two_dependencies_and_carries_the_files_of_ros(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        (metadata,) = [archive.read(name).decode() for name in names if name.endswith("/METADATA")]
        (entries,) = [archive.read(name).decode() for name in names if name.endswith("/entry_points.txt")]
    required = {line.split(": ")[1] for line in metadata.splitlines() if line.startswith("Requires-Dist")}
    assert {name for name in required if "extra" not in name} == {"numpy", "onnxruntime"}
    assert "Requires-Python: >=3.10" in metadata
    assert {"bridge_drive", "bridge_guard", "bridge_record"} <= {line.split(" =")[0] for line in entries.splitlines()}
    for end in ("bridge/fastdds.xml", "whill_bridge/package.xml", "drive.launch.py", "whill.yaml",
                "whill-bridge.service", "resource_index/packages/whill_bridge"):
        assert any(name.endswith(end) for name in names), end
    assert "bridge/setup.py" not in names and "bridge/safeguards/safety.py" in names


def test_ament_package_and_wheel_agree_on_name_version_and_licence():
    package = ElementTree.parse(ROOT / "bridge" / "package.xml").getroot()
    config = configparser.ConfigParser()
    config.read(ROOT / "bridge" / "setup.cfg")
    text = {name: package.findtext(name) for name in ("name", "version", "license")}
    assert text == {"name": config["metadata"]["name"].replace("-", "_"), "version": config["metadata"]["version"],
                    "license": config["metadata"]["license"]}
    assert package.findtext("export/build_type") == "ament_python"
    assert config["install"]["install_scripts"] == f"$base/lib/{text['name']}"  # where `ros2 run` looks


def test_parameter_file_of_the_package_holds_options_of_the_node_only():
    pytest.importorskip("yaml")
    from bridge.drive import parse_arguments
    from bridge.nodes.parameters import as_options

    file = ROOT / "bridge" / "config" / "whill.yaml"
    options = parse_arguments(as_options(["--ros-args", "--params-file", str(file)], "bridge_drive", "policy"))
    assert options.require_arm and options.resume == "arm" and options.e_stop == "require" and options.base == "whill"


@pytest.mark.parametrize("name", ["drive", "twist_mux"])
def test_launch_file_names_programs_of_the_package_and_topics_of_the_node(name):
    from bridge.nodes import ros

    text = (ROOT / "bridge" / "launch" / f"{name}.launch.py").read_text(encoding="utf-8")
    compile(text, name, "exec")
    assert 'package="whill_bridge", executable="bridge_drive"' in text and f'"{ros.COMMAND_TOPIC}"' in text


def test_policy_behind_a_mux_yields_to_each_source_that_goes_before_it():
    yaml = pytest.importorskip("yaml")
    mux = yaml.safe_load((ROOT / "bridge" / "config" / "twist_mux.yaml").read_text(encoding="utf-8"))
    sources = mux["twist_mux"]["ros__parameters"]["topics"]
    before = [one["topic"] for one in sources.values() if one["priority"] > sources["policy"]["priority"]]
    text = (ROOT / "bridge" / "launch" / "twist_mux.launch.py").read_text(encoding="utf-8")
    given = [ast.literal_eval(node) for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Dict)]
    (yields,) = [one["yield_to"] for one in given if "yield_to" in one]
    assert sorted(yields) == sorted(before)


def service_unit():
    """The section of the service unit."""
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(ROOT / "bridge" / "systemd" / "whill-bridge.service")
    return unit["Service"]


def test_service_stops_the_node_itself_in_order_and_leaves_the_guard_to_stop_a_dead_ones_vehicle():
    unit = service_unit()
    command = shlex.split(unit["ExecStart"])[-1]
    assert "ros2 launch" not in command and "ros2 run" not in command  # they leave SIGINT to the terminal
    assert command.rpartition("; ")[2].startswith('exec "$at/lib/whill_bridge/bridge_drive" ')
    assert unit["KillSignal"] == "SIGINT" and unit["KillMode"] == "process"  # mixed kills the guard with the node


def test_service_starts_the_node_with_the_parameters_of_the_package():
    pytest.importorskip("yaml")
    from bridge.drive import parse_arguments
    from bridge.nodes.parameters import with_options
    from bridge.nodes.ros import split_ros_arguments

    config = configparser.ConfigParser()
    config.read(ROOT / "bridge" / "setup.cfg")
    assert config["develop"]["script_dir"] == config["install"]["install_scripts"] == "$base/lib/whill_bridge"
    line = shlex.split(service_unit()["ExecStart"])[-1].rpartition("; ")[2].removeprefix("exec ")
    program, *words = shlex.split(line.replace("$at/share/whill_bridge", str(ROOT / "bridge")))
    own, of_ros = split_ros_arguments(words)
    options = parse_arguments(with_options(of_ros, "bridge_drive", "policy", own))
    assert options.policy == "/opt/whill/policy" and options.require_arm


def test_service_starts_again_after_a_crash_and_writes_where_its_user_may():
    service = service_unit()
    assert service["Restart"] == "always"
    assert not [value for value in service.values() if "%h" in value]  # the home of root, whatever User says


def test_every_command_of_the_package_is_a_program_of_both_wheels():
    import tomllib

    from bridge.__main__ import COMMANDS

    config = configparser.ConfigParser()
    config.read(ROOT / "bridge" / "setup.cfg")
    own = config["options.entry_points"]["console_scripts"]
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    for name in COMMANDS:
        assert f"bridge_{name} = bridge.{name}:main" in own.splitlines()
        assert scripts[f"bridge-{name.replace('_', '-')}"] == f"bridge.{name}:main"


def test_launch_file_leaves_the_dds_profile_that_the_user_chose(monkeypatch):
    def recorded(kind):
        return lambda *words, **options: (kind, *words, options)

    modules = {"launch": ["LaunchDescription"], "launch.actions": ["DeclareLaunchArgument", "SetEnvironmentVariable"],
               "launch.substitutions": ["EnvironmentVariable", "LaunchConfiguration"], "launch_ros": [],
               "launch_ros.actions": ["Node"], "ament_index_python": [], "ament_index_python.packages": []}
    for name, kinds in modules.items():
        module = types.ModuleType(name)
        module.get_package_share_directory = lambda package: "/share"
        vars(module).update({kind: recorded(kind) for kind in kinds})
        monkeypatch.setitem(sys.modules, name, module)
    launch = runpy.run_path(str(ROOT / "bridge" / "launch" / "drive.launch.py"))
    _, actions, _ = launch["generate_launch_description"]()
    (chosen,) = [action for action in actions if action[0] == "SetEnvironmentVariable"]
    variable = "FASTRTPS_DEFAULT_PROFILES_FILE"
    own = ("EnvironmentVariable", variable, {"default_value": "/share/fastdds.xml"})  # what is set wins
    assert chosen == ("SetEnvironmentVariable", variable, own, {})
