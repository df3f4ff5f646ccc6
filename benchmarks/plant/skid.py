"""Skid-steered robots: four or six wheels on fixed axles, each with its own motor, that slide in every turn.

As in `benchmarks.plant.first_day` the true radius and track differ from the believed ones. Loads of the wheels follow
from tyres that give way a little, friction is Coulomb's. `write_skid_urdf` writes the file that its owner has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.plant.base import TICK, Effect
from benchmarks.plant.chair import COULOMB, Chair, Contact, Nominal
from benchmarks.plant.trial import REPORT, ROLLING, Drive, Noise, disturbances, wheel_targets
from whill_mjx.logs.dataset import write_text

WIDTH = 0.4  # of a wheel over its radius
SPIN = 0.5  # inertia of a wheel over its mass times the square of its radius


@dataclass(frozen=True)
class Skid(Chair):
    """One skid-steered robot; masses, gains and limits of wheels are those of each."""

    axles: tuple[float, ...] = (-0.19, 0.19)
    """Places of the axles ahead of the middle [m]."""
    belts: bool = True
    """Whether the wheels of a side turn together."""


HAULER = Skid(
    nominal=Nominal(0.12, 0.46, 0.38, 32.0), radius=(0.12, 0.12), track=0.46, mass=32.0, com=(0.03, 0.0, 0.06),
    gyration=(0.16, 0.2, 0.23), wheel_mass=1.4, armature=0.03, damping=0.05, friction=0.75, patch=1e-3, kp=6.0,
    ki=12.0, torque_limit=16.0, delay=0.05,
)
CRAWLER = Skid(
    nominal=Nominal(0.08, 0.38, 0.44, 15.0), radius=(0.08, 0.08), track=0.38, mass=15.0, com=(-0.02, 0.0, 0.04),
    gyration=(0.12, 0.18, 0.2), wheel_mass=0.5, armature=0.008, damping=0.01, friction=0.6, patch=1e-3, kp=1.5,
    ki=4.0, torque_limit=4.0, delay=0.03, axles=(-0.22, 0.0, 0.22), belts=False,
)
SKIDS = {"hauler": HAULER, "crawler": CRAWLER}
"""One of 32 kg on four wheels with belts, and one of 15 kg on six wheels."""


def places(robot: Skid) -> list[tuple[str, int, float, float]]:
    """Name, side (0 left), place ahead and to the left of each wheel, those on the left first."""
    return [(f"{side}_{k + 1}", number, x, (1 - 2 * number) * robot.track / 2)
            for number, side in enumerate(("left", "right")) for k, x in enumerate(robot.axles)]


def build_skid(robot: Skid, contact: Contact) -> mujoco.MjModel:
    """The model of a robot."""
    wheels = places(robot)
    frame = robot.mass - len(wheels) * robot.wheel_mass
    inertia = " ".join(f"{frame * radius**2:.9g}" for radius in robot.gyration)
    solver = (f'solref="0.012 1" solreffriction="{contact.friction_time:g} 1" solimp="0.9 0.98 0.003" condim="4" '
              f'friction="{robot.friction} {robot.friction} {robot.patch} 1e-4 1e-4"')
    bodies = pairs = belts = ""
    for name, side, x, y in wheels:
        radius = robot.radius[side]
        spin = SPIN * robot.wheel_mass * radius**2
        bodies += (f'<body name="{name}" pos="{x} {y} 0"><joint name="{name}" axis="0 1 0" damping="{robot.damping}" '
                   f'armature="{robot.armature}"/><inertial pos="0 0 0" mass="{robot.wheel_mass}" '
                   f'diaginertia="{0.6 * spin:.6g} {spin:.6g} {0.6 * spin:.6g}"/><geom name="{name}" type="ellipsoid" '
                   f'size="{radius} {WIDTH * radius} {radius}"/></body>')
        pairs += f'<pair geom1="floor" geom2="{name}" {solver}/>'
        first = wheels[side * len(robot.axles)][0]
        if robot.belts and name != first:
            belts += f'<joint joint1="{name}" joint2="{first}" solref="0.004 1"/>'
    return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{contact.timestep:g}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <default><geom contype="0" conaffinity="0" mass="0"/></default>
  <worldbody><geom name="floor" type="plane" size="0 0 1"/>
    <body name="chassis" pos="0 0 {max(robot.radius)}"><freejoint/>
      <inertial pos="{' '.join(map(str, robot.com))}" mass="{frame}" diaginertia="{inertia}"/>{bodies}</body>
  </worldbody><contact>{pairs}</contact><equality>{belts}</equality>
</mujoco>""")


class SkidPlant:
    """A robot ready to drive: compiled and settled once."""

    def __init__(self, robot: Skid, contact: Contact = COULOMB) -> None:
        self.robot, self.model = robot, build_skid(robot, contact)
        self.substeps = round(TICK / contact.timestep)
        self.sides = np.array([side for _, side, _, _ in places(robot)])
        joints = [self.model.joint(name) for name, *_ in places(robot)]
        self.wheel_q, self.wheel_v = ([int(getattr(one, what)[0]) for one in joints] for what in ("qposadr", "dofadr"))
        self.data = mujoco.MjData(self.model)
        for _ in range(round(1.0 / contact.timestep)):
            self.data.qfrc_applied[self.wheel_v] = -robot.kp * self.data.qvel[self.wheel_v]
            mujoco.mj_step(self.model, self.data)
        self.rest = self.data.qpos.copy()

    def drive(
        self, messages: np.ndarray, start: tuple[float, float, float], effects: list[Effect], noise: Noise,
        random: np.random.Generator, session: float = 0.0,
    ) -> Drive:  # fmt: skip
        """One trial from rest, as `benchmarks.plant.trial.Plant.drive`; effects may act on commands alone."""
        robot, model, data = self.robot, self.model, self.data
        count = math.ceil((messages[-1, 0] + REPORT) / TICK - 1e-6) + 1
        t = np.arange(count) * TICK
        target = wheel_targets(robot, messages, t, effects)[:, self.sides]
        force, twist = disturbances(noise, count, random)
        model.pair_friction[:, :2] = robot.friction * np.exp(noise.grip * random.standard_normal((len(self.sides), 1)))
        self._place(start)
        integral, pose, speed = np.zeros(len(self.sides)), np.empty((count, 3)), np.empty((count, 3))
        angle, torques = np.empty((count, 2)), np.empty((count, 2))
        for k in range(count):
            q, w = data.qpos, data.qvel
            yaw = math.atan2(2 * (q[3] * q[6] + q[4] * q[5]), 1 - 2 * (q[5] ** 2 + q[6] ** 2))
            cos, sin = math.cos(yaw), math.sin(yaw)
            pose[k] = q[0], q[1], yaw
            speed[k] = cos * w[0] + sin * w[1], cos * w[1] - sin * w[0], w[5]
            spins = w[self.wheel_v]
            angle[k] = [(q - self.rest)[self.wheel_q][self.sides == side].mean() for side in (0, 1)]
            error = target[k] - spins
            integral += error * TICK
            torque = np.clip(robot.kp * error + robot.ki * integral, -robot.torque_limit, robot.torque_limit)
            torques[k] = [torque[self.sides == side].mean() for side in (0, 1)]
            rough = min(1.0, np.abs(spins).mean() * 2 / ROLLING)
            applied = data.qfrc_applied
            applied[:2] = cos * rough * force[k], sin * rough * force[k]
            applied[5] = rough * twist[k]
            applied[self.wheel_v] = torque
            mujoco.mj_step(model, data, self.substeps)
        pose[:, 2] = np.unwrap(pose[:, 2])
        return Drive(chair=robot, t=t, pose=pose, speed=speed, encoder=angle, torque=torques)

    def _place(self, start: tuple[float, float, float]) -> None:
        """At rest, settled, at x, y, yaw."""
        data, attitude = self.data, np.empty(4)
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = self.rest
        turn = np.array([math.cos(start[2] / 2), 0.0, 0.0, math.sin(start[2] / 2)])
        mujoco.mju_mulQuat(attitude, turn, self.rest[3:7])
        data.qpos[:2], data.qpos[3:7] = start[:2], attitude


def urdf_wheel(name: str, place: tuple[float, float, float], width: float, mass: float, inertia: tuple[float, float]
               ) -> str:
    """A driven wheel of a robot file: its link, and the joint to `base_link`.

    Args:
        name: with `_wheel` behind it the name of the link.
        place: x, y, z of its centre in `base_link` [m]; z is its radius.
        width: [m].
        mass: [kg].
        inertia: across its axle and about it [kg m2].
    """
    x, y, radius = place
    across, about = inertia
    return (f'<link name="{name}_wheel"><inertial><mass value="{mass}"/><inertia ixx="{across:.6g}" ixy="0" ixz="0" '
            f'iyy="{across:.6g}" iyz="0" izz="{about:.6g}"/></inertial><collision><geometry>'
            f'<cylinder radius="{radius}" length="{width}"/></geometry></collision></link>'
            f'<joint name="{name}_wheel_joint" type="continuous"><parent link="base_link"/><child link="{name}_wheel"/>'
            f'<origin xyz="{x} {y} {radius}" rpy="-1.5707963 0 0"/><axis xyz="0 0 1"/></joint>')


def write_skid_urdf(path: Path, robot: Skid = HAULER) -> Path:
    """The robot file that its owner has: believed sizes, a box and cylinders."""
    nominal, radius = robot.nominal, robot.nominal.radius
    frame = robot.mass - 2 * len(robot.axles) * robot.wheel_mass
    ixx, iyy, izz = (frame * one**2 for one in robot.gyration)
    spin = SPIN * robot.wheel_mass * radius**2
    wheels = "".join(urdf_wheel(name, (x, (1 - 2 * side) * nominal.track / 2, radius), 2 * WIDTH * radius,
                                robot.wheel_mass, (0.6 * spin, spin)) for name, side, x, _ in places(robot))
    write_text(path, f"""<?xml version="1.0"?>
<robot name="skid_robot">
  <link name="base_link"><inertial><origin xyz="{robot.com[0]} 0 {radius + robot.com[2]}"/><mass value="{frame}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
    <collision><origin xyz="0 0 {2 * radius}"/><geometry>
    <box size="{1.2 * nominal.wheelbase} {0.8 * nominal.track} {radius}"/></geometry></collision></link>
  {wheels}
</robot>
""")
    return path
