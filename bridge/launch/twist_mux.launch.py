"""Policy, planner and joystick behind one twist_mux: the chain of nav2, velocity smoother included.

    ros2 launch whill_bridge twist_mux.launch.py policy:=/opt/whill/policy

The policy sends to policy/cmd_vel, nav2's velocity smoother to nav/cmd_vel_smoothed, the joystick to joy/cmd_vel; only
twist_mux sends to the base. twist_mux itself drops a silent source after its timeout. The base must stop by itself when
nobody speaks, as the WHILL does after 200 ms. The policy yields to the other two and then waits to be armed: else it
would drive off as soon as a person lets go of the joystick.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the launch description."""
    config = Path(get_package_share_directory("whill_bridge")) / "config"
    return LaunchDescription([
        DeclareLaunchArgument("policy", description="policy file: a folder or a zip of it"),
        Node(package="whill_bridge", executable="bridge_drive", name="bridge_drive", output="screen",
             parameters=[str(config / "whill.yaml"), {"yield_to": ["joy/cmd_vel", "nav/cmd_vel_smoothed"]}],
             arguments=[LaunchConfiguration("policy")],
             remappings=[("whill/controller/cmd_vel", "policy/cmd_vel")]),
        Node(package="nav2_velocity_smoother", executable="velocity_smoother", name="velocity_smoother",
             parameters=[{"smoothing_frequency": 20.0, "velocity_timeout": 0.2}],
             remappings=[("cmd_vel", "nav/cmd_vel"), ("cmd_vel_smoothed", "nav/cmd_vel_smoothed")]),
        # the smoother is a lifecycle node: it passes nothing before it is activated
        Node(package="nav2_lifecycle_manager", executable="lifecycle_manager", name="lifecycle_manager_smoother",
             parameters=[{"autostart": True, "node_names": ["velocity_smoother"]}]),
        Node(package="twist_mux", executable="twist_mux", name="twist_mux", parameters=[str(config / "twist_mux.yaml")],
             remappings=[("cmd_vel_out", "whill/controller/cmd_vel")]),
    ])
