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
from zlib import crc32

import mujoco
import numpy as np

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import COULOMB, SLOW, VEHICLES, Chair, Contact, Nominal
from benchmarks.plant.commands import nine
from benchmarks.plant.effects import EFFECTS
from benchmarks.plant.effects.sensing import OdometryScale
from benchmarks.plant.make import Result, write_dataset
from benchmarks.plant.sensors import odometry, outside_pose
from benchmarks.plant.skid import SKIDS, Skid, SkidPlant, urdf_wheel
from benchmarks.plant.trial import Noise, Plant
from whill_mjx.logs.dataset import write_text

SPIN = (0.3, 0.5, 0.3)  # inertia of a small robot's wheel over its mass times the square of its radius
SMALL = Chair(
    nominal=Nominal(0.033, 0.16, 0.12, 1.2), radius=(0.033, 0.033), track=0.16, mass=1.2, com=(-0.02, 0.0, 0.03),
    gyration=(0.05, 0.055, 0.06), wheel_mass=0.04, armature=6e-5, damping=4e-4, friction=0.8, patch=5e-4,
    roller=0.05, roller_drag=0.0, kp=0.02, ki=0.1, torque_limit=0.06, delay=0.03,
)
PORTER = Chair(
    nominal=Nominal(0.075, 0.34, 0.3, 9.0), radius=(0.075, 0.075), track=0.34, mass=9.0, com=(-0.04, 0.0, 0.06),
    gyration=(0.1, 0.11, 0.13), wheel_mass=0.3, armature=4e-3, damping=5e-3, friction=0.7, patch=5e-4, roller=0.03,
    roller_drag=0.0, kp=0.35, ki=0.9, torque_limit=1.2, delay=0.07,
)
SMALL_ONES = {"small": SMALL, "porter": PORTER}
"""Two wheels and a ball that slides, 0.36 wheel radii large and half of the stated wheelbase behind."""
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


@dataclass(frozen=True)
class Day:
    """One day of a vehicle that nobody has calibrated."""

    vehicle: str
    """Of `chair.VEHICLES` or `SMALL_ONES`."""
    wrong: Wrong = Wrong()
    seed: int = 0
    """Of command levels, the day, start headings, disturbances and sensor noise."""
    effects: tuple[tuple[str, float], ...] = ()
    """Undeclared ones by name, with their sizes in the units of `effects.EFFECTS`."""
    varies: bool = False
    """Gains, mass and friction differ from those of other days by a few percent."""

    @property
    def small(self) -> bool:
        """Whether it stands on a ball."""
        return self.vehicle in SMALL_ONES

    @property
    def chair(self) -> Chair:
        """The vehicle on this day, with true sizes that differ from its nominal ones."""
        chair = (VEHICLES | SMALL_ONES | SKIDS)[self.vehicle]
        if self.varies:
            chair = chair.on_day(np.random.default_rng([self.seed, 1]))
        radius = chair.nominal.radius * (1 + self.wrong.radius)
        chair = replace(chair, radius=(radius, radius), track=chair.nominal.track * (1 + self.wrong.track))
        for name, size in self.effects:
            chair = EFFECTS[name].make.change(chair, size)
        return chair

    @property
    def noise(self) -> Noise:
        """Disturbances and sensors; of a small robot on a smooth floor, its markers near the cameras."""
        nominal = self.chair.nominal
        noise = Noise().of(self.chair)
        return replace(noise, yaw_torque=0.2 * noise.yaw_torque * nominal.track / Nominal().track, position=0.001,
                       yaw=0.002) if self.small else noise  # fmt: skip

    def effects_of(self, number: int) -> list[Effect]:
        """Fresh effects of one trial, with random numbers of their own."""
        return [EFFECTS[name].make(size, np.random.default_rng([self.seed, 5, crc32(name.encode()), number]),
                                   self.chair) for name, size in self.effects]


def slowed(tables: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The chair's manoeuvres for a small robot."""
    return {name: table * [1.0, SLOWER, FASTER] for name, table in tables.items()}


def make_uncalibrated(
    out: Path, day: Day, replicates: int = 3, manoeuvres: Mapping[str, np.ndarray] | None = None,
    ground_truth: bool = True,
) -> Path:  # fmt: skip
    """Drive a dataset and write it; returns its folder.

    Args:
        out: folder to write.
        day: of a vehicle.
        replicates: drives of each manoeuvre.
        manoeuvres: command tables (T, 3) t, v, omega by name; default: the nine of the plant.
        ground_truth: whether the outside pose is written.
    """
    chair, wrong, noise = day.chair, day.wrong, day.noise
    plant = (SkidPlant(chair) if isinstance(chair, Skid) else SmallPlant(chair, COULOMB) if day.small else
             Plant(chair))
    tables = dict(manoeuvres or (slowed(nine(day.seed)) if day.small else nine(day.seed)))
    results: list[Result] = []
    for replicate in range(1, replicates + 1):
        for name, messages in tables.items():
            number = len(results)
            random, reading, heading = (np.random.default_rng([day.seed, part, number]) for part in (2, 3, 4))
            start = (0.0, 0.0, float(heading.uniform(-np.pi, np.pi)))
            effects = day.effects_of(number)
            drive = plant.drive(messages, start, effects, noise, random)
            told: list[Effect] = [*effects, OdometryScale(wrong.odometry, random, chair)]
            pose = tracked(outside_pose(drive, replace(noise, position=0.0, yaw=0.0), reading), wrong)
            pose[:, 1:] += reading.standard_normal((len(pose), 3)) * [noise.position, noise.position, noise.yaw]
            results.append((f"{name}_{replicate}", odometry(drive, told, noise, reading), pose, None))
    messages_of = {f"{name}_{k}": table for name, table in tables.items() for k in range(1, replicates + 1)}
    write_dataset(out, chair.nominal, messages_of, results, ground_truth)
    if isinstance(chair, Skid):
        write_text(out / "dataset.toml", (out / "dataset.toml").read_text() + 'drive = "skid"\n')
    return out


def tracked(pose: np.ndarray, wrong: Wrong) -> np.ndarray:
    """Rows (M, 4) t, x, y, yaw of the tracked body, of those of the driven axle's middle."""
    cos, sin = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    x, y = pose[:, 1] + cos * wrong.x - sin * wrong.y, pose[:, 2] + sin * wrong.x + cos * wrong.y
    return np.column_stack([pose[:, 0], x, y, np.pi - np.mod(np.pi - pose[:, 3] - wrong.yaw, 2 * np.pi)])


class SmallPlant(Plant):
    """A small robot: two wheels, a ball behind that slides."""

    @staticmethod
    def build(chair: Chair, contact: Contact = SLOW) -> mujoco.MjModel:
        """Its model."""
        frame = chair.mass - 2 * chair.wheel_mass
        inertia = " ".join(f"{frame * radius**2:.9g}" for radius in chair.gyration)
        spin = " ".join(f"{share * chair.wheel_mass * chair.nominal.radius**2:.6g}" for share in SPIN)
        ball, ball_x = ball_of(chair)
        solver = f'solref="0.006 1" solreffriction="{contact.friction_time:g} 1" solimp="0.95 0.99 0.0005"'
        tyre = f'condim="4" friction="{chair.friction} {chair.friction} {chair.patch} 1e-4 1e-4" {solver}'
        wheels = "".join(
            f'<body name="wheel_{side}" pos="0 {sign * chair.track / 2} 0"><joint name="wheel_{side}" axis="0 1 0" '
            f'damping="{chair.damping}" armature="{chair.armature}"/><inertial pos="0 0 0" mass="{chair.wheel_mass}" '
            f'diaginertia="{spin}"/><geom name="tyre_{side}" type="ellipsoid" '
            f'size="{radius} {0.27 * radius} {radius}"/></body>'
            for side, sign, radius in (("left", 1, chair.radius[0]), ("right", -1, chair.radius[1])))
        high = sum(chair.radius) / 2
        return mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{contact.timestep:g}" integrator="implicitfast" cone="elliptic" impratio="100"/>
  <default><geom contype="0" conaffinity="0" mass="0"/></default>
  <worldbody><geom name="floor" type="plane" size="0 0 1"/>
    <body name="chassis" pos="0 0 {high}"><freejoint/>
      <inertial pos="{' '.join(map(str, chair.com))}" mass="{frame}" diaginertia="{inertia}"/>{wheels}
      <body name="caster" pos="{ball_x} 0 {ball - high}"><geom name="ball" type="sphere" size="{ball}"/></body>
    </body></worldbody>
  <contact><pair geom1="floor" geom2="tyre_left" {tyre}/><pair geom1="floor" geom2="tyre_right" {tyre}/>
    <pair geom1="floor" geom2="ball" condim="3" friction="{chair.roller} {chair.roller} 0 0 0" {solver}/></contact>
</mujoco>""")


def ball_of(chair: Chair) -> tuple[float, float]:
    """Radius of a small robot's ball, and its place ahead of the axle [m]."""
    return 0.36 * chair.nominal.radius, -chair.nominal.wheelbase / 2


def write_mjcf(path: Path, chair: Chair = SMALL) -> Path:
    """An MJCF file of a small robot with believed sizes: motors, and MuJoCo's own contacts."""
    nominal, radius = chair.nominal, chair.nominal.radius
    frame, (ball, ball_x) = chair.mass - 2 * chair.wheel_mass, ball_of(chair)
    inertia, spin = (" ".join(f"{mass * length**2 * share:.6g}" for length, share in lengths) for mass, lengths in (
        (frame, [(one, 1.0) for one in chair.gyration]), (chair.wheel_mass, [(radius, one) for one in SPIN])))
    wheels = "".join(
        f'<body name="{side}_wheel" pos="0 {sign * nominal.track / 2} 0"><joint name="{side}" axis="0 1 0" '
        f'armature="{chair.armature}"/><inertial pos="0 0 0" mass="{chair.wheel_mass}" diaginertia="{spin}"/>'
        f'<geom name="{side}_tyre" type="sphere" size="{radius}"/></body>'
        for side, sign in (("left", 1), ("right", -1)))
    limit = 2 * chair.torque_limit
    motors = "".join(f'<motor name="{side}_motor" joint="{side}" ctrlrange="-{limit} {limit}"/>'
                     for side in ("left", "right"))
    write_text(path, f"""<mujoco model="small robot"><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><geom name="floor" type="plane" size="0 0 1"/>
    <body name="base" pos="0 0 {radius}"><freejoint/>
      <inertial pos="{chair.com[0]} 0 {chair.com[2]}" mass="{frame}" diaginertia="{inertia}"/>
      <geom name="ball" type="sphere" size="{ball}" pos="{ball_x} 0 {ball - radius}" friction="0.05" priority="1"/>
      {wheels}</body></worldbody>
  <actuator>{motors}</actuator>
</mujoco>
""")
    return path


def write_urdf(path: Path, chair: Chair = SMALL) -> Path:
    """The robot file that the owner of a small robot has: believed sizes, a ball, boxes and cylinders."""
    nominal, radius = chair.nominal, chair.nominal.radius
    frame = chair.mass - 2 * chair.wheel_mass
    ixx, iyy, izz = (frame * one**2 for one in chair.gyration)
    turned, rolled = (share * chair.wheel_mass * radius**2 for share in SPIN[:2])
    ball, ball_x = ball_of(chair)
    wheels = "".join(urdf_wheel(side, (0, sign * nominal.track / 2, radius), 0.54 * radius, chair.wheel_mass,
                                (turned, rolled)) for side, sign in (("left", 1), ("right", -1)))
    write_text(path, f"""<?xml version="1.0"?>
<robot name="small_robot">
  <link name="base_link"><inertial><origin xyz="{chair.com[0]} 0 {radius + chair.com[2]}"/><mass value="{frame}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
    <collision><origin xyz="{ball_x / 6} 0 {2 * radius}"/><geometry>
    <box size="{1.2 * nominal.wheelbase} {0.8 * nominal.track} {1.8 * radius}"/></geometry></collision></link>
  <link name="ball"><inertial><mass value="0.001"/><inertia ixx="1e-7" ixy="0" ixz="0" iyy="1e-7" iyz="0" izz="1e-7"/>
    </inertial><collision><geometry><sphere radius="{ball}"/></geometry></collision></link>
  <joint name="ball_joint" type="fixed"><parent link="base_link"/><child link="ball"/>
    <origin xyz="{ball_x} 0 {ball}"/></joint>
  {wheels}
</robot>
""")
    return path
