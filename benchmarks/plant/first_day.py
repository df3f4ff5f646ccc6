"""Drives of a vehicle that nobody has calibrated: sizes of its wheels and the place of its markers are not as believed.

The contact plant drives with true radii and a true track; controller and odometry take the believed ones. The outside
pose follows a rigid body that is off the axle's middle and turned. `small` is a robot of a kilogram on two wheels and a
ball. `write_urdf` writes the file that its owner has of it, with the believed sizes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import COULOMB, SLOW, VEHICLES, Chair, Contact, Nominal
from benchmarks.plant.commands import nine
from benchmarks.plant.effects.sensing import OdometryScale
from benchmarks.plant.make import Result, write_dataset
from benchmarks.plant.sensors import odometry, outside_pose
from benchmarks.plant.trial import Noise, Plant
from whill_mjx.logs.dataset import write_text

BALL, BALL_X = 0.012, -0.06  # m, radius of the small robot's ball and its place
SMALL = Chair(
    nominal=Nominal(0.033, 0.16, 0.12, 1.2), radius=(0.033, 0.033), track=0.16, mass=1.2, com=(-0.02, 0.0, 0.03),
    gyration=(0.05, 0.055, 0.06), wheel_mass=0.04, armature=6e-5, damping=4e-4, friction=0.8, patch=5e-4,
    roller=0.05, roller_drag=0.0, kp=0.02, ki=0.1, torque_limit=0.06, delay=0.03,
)
SLOWER, FASTER = 0.25, 1.8  # of speeds and yaw rates of the chair's manoeuvres, for the small robot


@dataclass(frozen=True)
class Wrong:
    """By how much what is believed is wrong."""

    radius: float = 0.03
    """True wheel radius over the believed one, less 1."""
    track: float = -0.05
    """The same of the track."""
    odometry: float = 0.0
    """Radius that the odometry takes, over the controller's, less 1."""
    x: float = 0.12
    """Tracked point ahead of the driven axle's middle [m]."""
    y: float = -0.05
    """Tracked point to the left of it [m]."""
    yaw: float = math.radians(8.0)
    """Tracked heading to the left of the vehicle's [rad]."""


def uncalibrated(vehicle: str, wrong: Wrong) -> Chair:
    """A vehicle of `chair.VEHICLES`, or `small`, with true sizes that differ from its nominal ones."""
    chair = SMALL if vehicle == "small" else VEHICLES[vehicle]
    radius = chair.nominal.radius * (1 + wrong.radius)
    return replace(chair, radius=(radius, radius), track=chair.nominal.track * (1 + wrong.track))


def make_uncalibrated(
    out: Path, vehicle: str, wrong: Wrong, seed: int = 0, replicates: int = 3,
    manoeuvres: Mapping[str, np.ndarray] | None = None, ground_truth: bool = True,
) -> Path:  # fmt: skip
    """Drive a dataset and write it; returns its folder.

    Args:
        out: folder to write.
        vehicle: of `chair.VEHICLES`, or `small`.
        wrong: what is wrong with the believed sizes.
        seed: of command levels, start headings, disturbances and sensor noise.
        replicates: drives of each manoeuvre.
        manoeuvres: command tables (T, 3) t, v, omega by name; default: the nine of the plant.
        ground_truth: whether the outside pose is written.
    """
    chair = uncalibrated(vehicle, wrong)
    small = vehicle == "small"
    plant = SmallPlant(chair, COULOMB) if small else Plant(chair)
    tables = dict(manoeuvres or nine(seed))
    if small and manoeuvres is None:
        tables = {name: table * [1.0, SLOWER, FASTER] for name, table in tables.items()}
    noise = Noise().of(chair)
    if small:  # a smooth floor, markers near the cameras
        noise = replace(noise, yaw_torque=0.2 * noise.yaw_torque * chair.nominal.track / Nominal().track,
                        position=0.001, yaw=0.002)
    results: list[Result] = []
    for replicate in range(1, replicates + 1):
        for name, messages in tables.items():
            number = len(results)
            random, reading, heading = (np.random.default_rng([seed, part, number]) for part in (2, 3, 4))
            start = (0.0, 0.0, float(heading.uniform(-np.pi, np.pi)))
            drive = plant.drive(messages, start, [], noise, random)
            scale: list[Effect] = [OdometryScale(wrong.odometry, random, chair)]
            pose = tracked(outside_pose(drive, replace(noise, position=0.0, yaw=0.0), reading), wrong)
            pose[:, 1:] += reading.standard_normal((len(pose), 3)) * [noise.position, noise.position, noise.yaw]
            results.append((f"{name}_{replicate}", odometry(drive, scale, noise, reading), pose, None))
    messages_of = {f"{name}_{k}": table for name, table in tables.items() for k in range(1, replicates + 1)}
    write_dataset(out, chair.nominal, messages_of, results, ground_truth)
    return out


def tracked(pose: np.ndarray, wrong: Wrong) -> np.ndarray:
    """Rows (M, 4) t, x, y, yaw of the tracked body, of those of the driven axle's middle."""
    cos, sin = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    x, y = pose[:, 1] + cos * wrong.x - sin * wrong.y, pose[:, 2] + sin * wrong.x + cos * wrong.y
    return np.column_stack([pose[:, 0], x, y, np.pi - np.mod(np.pi - pose[:, 3] - wrong.yaw, 2 * np.pi)])


class SmallPlant(Plant):
    """The small robot: cylinder wheels, a ball behind that slides."""

    @staticmethod
    def build(chair: Chair, contact: Contact = SLOW) -> mujoco.MjModel:
        """Its model."""
        frame = chair.mass - 2 * chair.wheel_mass
        inertia = " ".join(f"{frame * radius**2:.9g}" for radius in chair.gyration)
        solver = f'solref="0.006 1" solreffriction="{contact.friction_time:g} 1" solimp="0.95 0.99 0.0005"'
        tyre = f'condim="4" friction="{chair.friction} {chair.friction} {chair.patch} 1e-4 1e-4" {solver}'
        wheels = "".join(
            f'<body name="wheel_{side}" pos="0 {sign * chair.track / 2} 0"><joint name="wheel_{side}" axis="0 1 0" '
            f'damping="{chair.damping}" armature="{chair.armature}"/><inertial pos="0 0 0" mass="{chair.wheel_mass}" '
            f'diaginertia="1.3e-5 2.2e-5 1.3e-5"/><geom name="tyre_{side}" type="ellipsoid" '
            f'size="{radius} 0.009 {radius}"/></body>'
            for side, sign, radius in (("left", 1, chair.radius[0]), ("right", -1, chair.radius[1])))
        high = sum(chair.radius) / 2
        return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{contact.timestep:g}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <default><geom contype="0" conaffinity="0" mass="0"/></default>
  <worldbody><geom name="floor" type="plane" size="0 0 1"/>
    <body name="chassis" pos="0 0 {high}"><freejoint/>
      <inertial pos="{' '.join(map(str, chair.com))}" mass="{frame}" diaginertia="{inertia}"/>{wheels}
      <body name="caster" pos="{BALL_X} 0 {BALL - high}"><geom name="ball" type="sphere" size="{BALL}"/></body>
    </body></worldbody>
  <contact><pair geom1="floor" geom2="tyre_left" {tyre}/><pair geom1="floor" geom2="tyre_right" {tyre}/>
    <pair geom1="floor" geom2="ball" condim="3" friction="{chair.roller} {chair.roller} 0 0 0" {solver}/></contact>
</mujoco>""")


def write_urdf(path: Path, chair: Chair = SMALL) -> Path:
    """The robot file that the owner of the small robot has: believed sizes, a ball, boxes and cylinders."""
    nominal, radius = chair.nominal, chair.nominal.radius
    frame = chair.mass - 2 * chair.wheel_mass
    ixx, iyy, izz = (frame * one**2 for one in chair.gyration)
    wheels = "".join(
        f'<link name="{side}_wheel"><inertial><mass value="{chair.wheel_mass}"/><inertia ixx="1.3e-5" ixy="0" ixz="0" '
        f'iyy="1.3e-5" iyz="0" izz="2.2e-5"/></inertial><collision><geometry><cylinder radius="{radius}" '
        f'length="0.018"/></geometry></collision></link><joint name="{side}_wheel_joint" type="continuous">'
        f'<parent link="base_link"/><child link="{side}_wheel"/><origin xyz="0 {sign * nominal.track / 2} {radius}" '
        f'rpy="-1.5707963 0 0"/><axis xyz="0 0 1"/></joint>' for side, sign in (("left", 1), ("right", -1)))
    write_text(path, f"""<?xml version="1.0"?>
<robot name="small_robot">
  <link name="base_link"><inertial><origin xyz="{chair.com[0]} 0 {radius + chair.com[2]}"/><mass value="{frame}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
    <collision><origin xyz="-0.01 0 0.065"/><geometry><box size="0.14 0.13 0.06"/></geometry></collision></link>
  <link name="ball"><inertial><mass value="0.001"/><inertia ixx="1e-7" ixy="0" ixz="0" iyy="1e-7" iyz="0" izz="1e-7"/>
    </inertial><collision><geometry><sphere radius="{BALL}"/></geometry></collision></link>
  <joint name="ball_joint" type="fixed"><parent link="base_link"/><child link="ball"/>
    <origin xyz="{BALL_X} 0 {BALL}"/></joint>
  {wheels}
</robot>
""")
    return path
