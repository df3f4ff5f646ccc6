"""The policy node with its guard on a WHILL.

    ros2 launch whill_bridge drive.launch.py policy:=/opt/whill/policy namespace:=chair_1
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    share = Path(get_package_share_directory("whill_bridge"))
    return LaunchDescription([
        DeclareLaunchArgument("policy", description="policy file: a folder or a zip of it"),
        DeclareLaunchArgument("parameters", default_value=str(share / "config" / "whill.yaml")),
        DeclareLaunchArgument("namespace", default_value=""),
        DeclareLaunchArgument("image", default_value="sensing/camera/front/image_raw"),
        DeclareLaunchArgument("command", default_value="whill/controller/cmd_vel"),
        # camera nodes that are started from here get the profile too: large images are lost without it
        SetEnvironmentVariable(PROFILE, EnvironmentVariable(PROFILE, default_value=str(share / "fastdds.xml"))),
        Node(package="whill_bridge", executable="bridge_drive", name="bridge_drive", output="screen",
             namespace=LaunchConfiguration("namespace"), parameters=[LaunchConfiguration("parameters")],
             arguments=[LaunchConfiguration("policy")],
             remappings=[("sensing/camera/front/image_raw", LaunchConfiguration("image")),
                         ("whill/controller/cmd_vel", LaunchConfiguration("command"))]),
    ])
