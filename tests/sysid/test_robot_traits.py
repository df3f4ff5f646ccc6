"""Robot files with the traits of public ones: each is read with the right wheels, radius and track, and drives."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from test_robots import joint, link, plugin, robot_file, wheel

from sysid.replay.mjcf import mjcf_model
from sysid.replay.robot_check import check_robot
from sysid.replay.robot_loading import load_robot

pytestmark = pytest.mark.quick
TYRE = '<cylinder radius="0.06" length="0.03"/>'
BASE = link("base", '<box size="0.3 0.2 0.08"/>', 5.0, 0.05, origin="-0.03 0 0.05")
SUPPORT = (link("ball", '<sphere radius="0.03"/>', 0.05, 1e-5) + joint("ball_joint", "ball", "-0.12 0 -0.03"))
SIDES = (("left", 0.15), ("right", -0.15))


def urdf(folder, *parts, base=BASE):
    return robot_file(folder, *parts, base=base)


XACRO = """<?xml version="1.0"?><robot name="bot" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="wheel_radius" default="0.06"/><xacro:arg name="ball" default="true"/>
<xacro:arg name="prefix" default="bot_"/>
<xacro:property name="r" value="$(arg wheel_radius)"/><xacro:property name="track" value="${2 * 0.15}"/>
<xacro:macro name="box" params="m x y z"><inertial><mass value="${m}"/><inertia ixx="${m * (y*y + z*z) / 12}"
  iyy="${m * (x*x + z*z) / 12}" izz="${m * (x*x + y*y) / 12}" ixy="0" ixz="0" iyz="0"/></inertial></xacro:macro>
<xacro:macro name="wheel" params="side reflect">
  <link name="$(arg prefix)${side}_wheel"><xacro:box m="0.2" x="${2*r}" y="0.02" z="${2*r}"/>
    <collision><origin rpy="${pi/2} 0 0"/><geometry><cylinder radius="${r}" length="0.02"/></geometry></collision>
  </link>
  <joint name="$(arg prefix)${side}_wheel_joint" type="continuous"><parent link="plate"/>
    <child link="$(arg prefix)${side}_wheel"/><origin xyz="0 ${reflect * track / 2} ${r - 0.04}"/><axis xyz="0 1 0"/>
  </joint></xacro:macro>
<link name="base_footprint"/>
<joint name="foot" type="fixed"><parent link="base_footprint"/><child link="base_link"/><origin xyz="0 0 0.04"/></joint>
<link name="base_link"><xacro:box m="3" x="0.3" y="0.25" z="0.1"/>
  <collision><origin xyz="-0.02 0 0.06"/><geometry><box size="0.3 0.25 0.1"/></geometry></collision></link>
<link name="plate"/><joint name="up" type="fixed"><parent link="base_link"/><child link="plate"/></joint>
<xacro:wheel side="left" reflect="1"/><xacro:wheel side="right" reflect="-1"/>
<xacro:if value="$(arg ball)"><link name="ball"><collision><geometry><sphere radius="0.02"/></geometry></collision>
  </link><joint name="ball_joint" type="fixed"><parent link="base_link"/><child link="ball"/>
  <origin xyz="-0.12 0 -0.02"/></joint></xacro:if>
<gazebo><plugin name="drive" filename="libgazebo_ros_diff_drive.so">
  <left_joint>$(arg prefix)left_wheel_joint</left_joint><right_joint>$(arg prefix)right_wheel_joint</right_joint>
  <wheel_separation>${track}</wheel_separation><wheel_diameter>${2 * r}</wheel_diameter></plugin></gazebo></robot>"""


def arguments(folder):
    """A xacro file with arguments, properties, macros, a base without inertia and a plugin."""
    pytest.importorskip("xacro")
    path = folder / "bot.urdf.xacro"
    path.write_text(XACRO)
    return path


def hubs(folder):
    """Revolute joints with ends far away turn hubs without a shape; spheres without inertia are fixed to them."""
    limit = '<limit lower="-1e16" upper="1e16" effort="5" velocity="20"/>'
    parts = [link(f"{side}_hub", "", 0.2, 2e-4)
             + joint(f"{side}_wheel_joint", f"{side}_hub", f"0 {0.8 * y} 0", "revolute", more=limit)
             + f'<link name="{side}_tyre"><collision><geometry><sphere radius="0.06"/></geometry></collision></link>'
             + joint(f"{side}_tyre_joint", f"{side}_tyre", f"0 {0.2 * y} 0", parent=f"{side}_hub") for side, y in SIDES]
    return urdf(folder, *parts, SUPPORT)


def followers(folder):
    """A plugin drives the front wheels, and the rear ones mimic them."""
    parts = [wheel(f"{axle}_{side}", x, y, TYRE, more=f'<mimic joint="front_{side}"/>' if axle == "rear" else "")
             for axle, x in (("front", 0.12), ("rear", -0.12)) for side, y in SIDES]
    return urdf(folder, *parts, plugin("libgazebo_ros_diff_drive.so", leftJoint="front_left", rightJoint="front_right"))


def followers_of_followers(folder):
    """A plugin drives the front wheels, the middle ones mimic them, and the rear ones the middle ones."""
    parts = [wheel(f"{axle}_{side}", x, y, TYRE, more=f'<mimic joint="{before}_{side}"/>' if before else "")
             for axle, before, x in (("front", "", 0.12), ("middle", "front", 0.0), ("rear", "middle", -0.12))
             for side, y in SIDES]
    return urdf(folder, *parts, plugin("libgazebo_ros_diff_drive.so", leftJoint="front_left", rightJoint="front_right"))


def rockers(folder):
    """Six wheels on rockers and bogies, which are held."""
    end = '<limit lower="-0.5" upper="0.5" effort="0" velocity="1"/>'
    parts = []
    for side, y in SIDES:
        rocker, bogie, name = f"{side}_rocker", f"{side}_bogie", f"wheel_{side[0]}"
        parts += [link(rocker, "", 0.5, 1e-3) + joint(f"{rocker}_joint", rocker, f"0.05 {y} 0", "revolute", more=end),
                  link(bogie, "", 0.3, 1e-3) + joint(f"{bogie}_joint", bogie, "-0.15 0 0", "revolute", more=end,
                                                     parent=rocker),
                  wheel(f"{name}f", 0.15, 0, TYRE, parent=rocker), wheel(f"{name}m", 0.08, 0, TYRE, parent=bogie),
                  wheel(f"{name}b", -0.1, 0, TYRE, parent=bogie)]
    return urdf(folder, *parts)


def turned_frames(folder):
    """Frames of wheels that CAD programs turn, whose axes point outwards."""
    parts = [link(f"{side}_wheel", TYRE, 0.3, 3e-4)
             + joint(f"{side}_wheel_joint", f"{side}_wheel", f'0 {y} 0" rpy="{-np.sign(y) * np.pi / 2} 0 0',
                     "continuous", "0 0 1") for side, y in SIDES]
    return urdf(folder, *parts, SUPPORT)


def ring_mesh(path):
    """A wheel of 60 mm radius and 30 mm width as a binary STL, its axle along y."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    inner, outer = (np.column_stack([0.06 * np.cos(turn), 0 * turn + y, 0.06 * np.sin(turn)]) for y in (-0.015, 0.015))
    faces = [face for k in range(24) for n in [(k + 1) % 24] for face in (
        (inner[k], inner[n], outer[k]), (inner[n], outer[n], outer[k]), (inner[0], inner[k], inner[n]),
        (outer[0], outer[n], outer[k]))]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(face), 0) for face in faces)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b" " * 80 + struct.pack("<I", len(faces)) + rows)


def meshes(folder, file="wheel.stl", separation=0.3):
    """Wheels that collide as meshes, without cylinders; pictures of them are missing."""
    ring_mesh(folder / "meshes" / "wheel.stl")
    shape = '<mesh filename="package://bot/meshes/{}"/>'
    seen = f'<visual><geometry>{shape.format("wheel.dae")}</geometry></visual><collision>'
    parts = [(link(f"{side}_wheel", shape.format(file), 0.3, 3e-4)
              + joint(f"{side}_wheel_joint", f"{side}_wheel", f"0 {y} 0", "continuous")).replace("<collision>", seen)
             for side, y in SIDES]
    return urdf(folder, *parts, SUPPORT, plugin(
        "libgazebo_ros_diff_drive.so", leftJoint="left_wheel_joint", rightJoint="right_wheel_joint",
        wheelSeparation=separation, wheelDiameter=0.12))


def lost_meshes(folder):
    """The meshes are missing, and the plugin states the diameter of the wheels."""
    return meshes(folder, "gone.stl")


def included(folder):
    """MJCF: defaults and actuators in an included file, gears of both signs, a ball caster, an arm with a gripper."""
    (folder / "drive.xml").write_text("""<mujoco><default><default class="wheel"><joint axis="0 0 1" damping="0.01"/>
      <geom type="cylinder" size="0.06 0.015" mass="0.3" friction="0.9"/></default></default>
      <actuator><velocity name="drive_l" joint="l" kv="0.3" gear="2"/><velocity name="drive_r" joint="r" kv="0.3"
      gear="-2"/><position name="arm" joint="arm" kp="5"/></actuator></mujoco>""")
    path = folder / "car.xml"
    path.write_text("""<mujoco><compiler angle="degree"/><include file="drive.xml"/><worldbody>
      <body name="car" pos="0 0 0.06"><freejoint/><geom type="box" size="0.15 0.1 0.03" pos="-0.02 0 0.05" mass="4"/>
        <body pos="-0.12 0 -0.03"><joint type="ball" name="ball"/><geom type="sphere" size="0.03" mass="0.1"/></body>
        <body pos="0 0.15 0" euler="-90 0 0"><joint name="l" class="wheel"/><geom class="wheel"/></body>
        <body pos="0 -0.15 0" euler="-90 0 0"><joint name="r" class="wheel"/><geom class="wheel"/></body>
        <body pos="0.1 0 0.1"><joint name="arm" axis="0 1 0" range="-90 90"/>
          <geom type="capsule" size="0.01 0.05" mass="0.1" contype="0" conaffinity="0"/>
          <body pos="0 0.02 0.06"><joint name="finger" type="slide" axis="0 1 0" range="0 0.02"/>
            <geom type="box" size="0.005 0.005 0.02" mass="0.01"/></body>
          <body pos="0 -0.02 0.06"><joint name="thumb" type="slide" axis="0 -1 0" range="0 0.02"/>
            <geom type="box" size="0.005 0.005 0.02" mass="0.01"/></body></body></body></worldbody>
      <tendon><fixed name="grip"><joint joint="finger" coef="1"/><joint joint="thumb" coef="1"/></fixed></tendon>
      <equality><joint joint1="finger" joint2="thumb"/></equality></mujoco>""")
    return path


def ellipsoids(folder):
    """MJCF: nested defaults, motors with gears and limits, tyres that are ellipsoids, a skid of higher priority."""
    path = folder / "rover.xml"
    tyre = ('<body name="wheel_{0}" pos="0.05 {1} 0"><joint name="wheel_{0}_joint" axis="0 1 0" armature="0.002"/>'
            '<geom type="ellipsoid" size="0.06 0.02 0.06" mass="0.5"/></body>')
    path.write_text(f"""<mujoco><default><default class="rover"><geom conaffinity="0"/>
      <default class="seen"><geom contype="0" group="2"/></default>
      <default class="drive"><motor gear="15" ctrlrange="-1 1" forcerange="-2 2"/></default></default></default>
      <worldbody><geom type="plane" size="0 0 1"/><body name="base" pos="0 0 0.06" childclass="rover"><freejoint/>
        <geom class="seen" type="box" size="0.2 0.12 0.05"/>
        <geom type="box" size="0.18 0.1 0.03" pos="-0.03 0 0.06" mass="8"/>
        <geom name="skid" type="sphere" size="0.02" pos="-0.15 0 -0.04" friction="0.1" priority="2"/>
        {"".join(tyre.format(side, y) for side, y in (("FL", 0.15), ("FR", -0.15)))}</body></worldbody>
      <actuator><motor class="drive" joint="wheel_FL_joint"/><motor class="drive" joint="wheel_FR_joint"/></actuator>
      </mujoco>""")
    return path


FILES = {arguments: 2, hubs: 2, followers: 4, followers_of_followers: 6, rockers: 6, turned_frames: 2, meshes: 2,
         lost_meshes: 2, included: 2, ellipsoids: 2}
"""Each file, and how many driven wheels it has; all have a radius of 60 mm and a track of 0.3 m."""


@pytest.mark.parametrize(("write", "count"), FILES.items(), ids=[write.__name__ for write in FILES])
def test_a_file_is_read_with_its_wheels_radius_and_track_and_drives(tmp_path, write, count):
    path = write(tmp_path)
    robot = load_robot(path)
    assert len(robot.wheels) == count
    assert robot.wheel_radius == pytest.approx(0.06, abs=2e-4) and robot.distance == pytest.approx(0.3, abs=1e-4)
    assert robot.forward == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    check = check_robot(robot)
    assert check.drives_straight and check.speed == pytest.approx(check.command[0], rel=0.1)
    assert check.rate == pytest.approx(check.command[1], rel=0.1 if count == 2 else 0.8)
    assert mjcf_model(path, calibrate=True).params.values


def test_a_size_that_a_plugin_takes_otherwise_is_named(tmp_path):
    robot = load_robot(meshes(tmp_path, separation=0.33))
    [note] = [one for one in robot.notes if "a plugin takes" in one]
    assert "a plugin takes 0.33 m for the distance between the wheels, but its shapes have 0.3 m" in note


def test_the_radius_that_a_plugin_states_is_not_that_of_a_caster(tmp_path):
    caster = link("caster_wheel", '<mesh filename="gone.stl"/>', 0.3, 1.35e-4) + joint(
        "caster_wheel_joint", "caster_wheel", "-0.12 0 -0.03", "continuous")
    path = meshes(tmp_path)
    path.write_text(path.read_text().replace("</robot>", f"{caster}</robot>"))
    [note] = [one for one in load_robot(path).notes if "caster_wheel" in one and "stands in" in one]
    assert "a cylinder of 0.03 m radius" in note


def test_supports_before_and_behind_the_axle_are_raised_whichever_way_a_robot_faces(tmp_path):
    tyres = [f'<link name="{side}_wheel"><inertial><mass value="0.3"/><inertia ixx="3e-4" iyy="3e-4" izz="3e-4" ixy="0"'
             f' ixz="0" iyz="0"/></inertial><collision><origin rpy="0 1.5707963 0"/><geometry>{TYRE}</geometry>'
             f'</collision></link>{joint(f"{side}_wheel_joint", f"{side}_wheel", f"{-y} 0 0", "continuous", "1 0 0")}'
             for side, y in SIDES]
    balls = [link(name, '<sphere radius="0.03"/>', 0.05, 1e-5) + joint(f"{name}_joint", name, f"0 {y} -0.03")
             for name, y in (("front_ball", 0.12), ("rear_ball", -0.12))]
    base = link("base", '<box size="0.2 0.3 0.08"/>', 5.0, 0.05, origin="0 0 0.05")
    robot = load_robot(urdf(tmp_path, *tyres, *balls, base=base))
    assert robot.forward == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)
    assert any("front_ball, rear_ball are raised" in note for note in robot.notes)
    check = check_robot(robot)
    assert check.drives_straight and check.rate == pytest.approx(check.command[1], rel=0.1)


def test_wheels_of_swivelling_casters_are_not_driven_where_the_driven_joints_have_other_names(tmp_path):
    casters = [link(f"{side}_fork", mass=0.1) + joint(f"caster_{side}_swivel", f"{side}_fork", f"-0.12 {0.6 * y} 0",
                                                      "continuous", "0 0 1")
               + link(f"{side}_roll", '<sphere radius="0.03"/>', 0.1, 1e-4)
               + joint(f"caster_{side}_wheel", f"{side}_roll", "-0.03 0 -0.03", "continuous", parent=f"{side}_fork")
               for side, y in SIDES]
    robot = load_robot(urdf(tmp_path, wheel("drive_l", 0.1, 0.15, TYRE), wheel("drive_r", 0.1, -0.15, TYRE), *casters))
    assert [robot.host.joint(one).name for one in robot.joints] == ["drive_l", "drive_r"]
    assert robot.wheel_radius == pytest.approx(0.06) and check_robot(robot).drives_straight
