"""The chair as numbers and as a MuJoCo model with real wheel contacts.

Ellipsoid wheels touch the floor in one smooth point, and a front beam that pivots about the chair's long axis keeps all
four wheels loaded: cylinders on a rigid frame chatter. Front wheels are nearly frictionless spheres, which is what an
omni wheel is to the frame. The chassis frame lies at the middle of the drive axle: x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

TIMESTEP = 0.002  # s, of the contact dynamics
FRONT_RADIUS, FRONT_Y = 0.1, 0.19  # m, of the front wheels, from the middle
GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Contact:
    """How the contacts are computed."""

    timestep: float = TIMESTEP
    """Of the contact dynamics [s]; it divides the controllers' sample time."""
    friction_time: float = 0.05
    """Time in which friction would stop a sliding wheel [s]. A slow one keeps skidding wheels on the floor: with a
    stiff one the cone lifts them, and they hop."""


SLOW = Contact()
COULOMB = Contact(0.0005, 0.01)
"""A skidding tyre gives its friction times its load: at 2 ms and 50 ms it falls to 0.67 where 0.82 is stated, and a
wheel that gets its grip back slides on for 50 ms. It hops, but by less than its sensors see."""

@dataclass(frozen=True)
class Nominal:
    """What the data sheet says, and what controllers and odometry assume."""

    radius: float = 0.1325
    """Of the drive wheels [m]."""
    track: float = 0.496
    """Between the drive wheels [m]."""
    wheelbase: float = 0.45
    """From the drive axle to the front wheels [m]."""
    mass: float = 54.0
    """[kg]"""


@dataclass(frozen=True)
class Chair:
    """Everything about one chair on one day. Left comes before right in every pair."""

    nominal: Nominal = Nominal()
    radius: tuple[float, float] = (Nominal.radius, Nominal.radius)
    """True wheel radii [m]."""
    track: float = Nominal.track
    """True distance between the drive wheels' contacts [m]."""
    mass: float = Nominal.mass
    """All of it, wheels included [kg]."""
    com: tuple[float, float, float] = (0.156, 0.0, 0.167)
    """Centre of mass of the frame from the drive axle [m]."""
    gyration: tuple[float, float, float] = (0.24, 0.27, 0.293)
    """Radii of gyration of the frame about its centre of mass [m]."""
    wheel_mass: float = 2.0
    """One drive wheel with its hub motor [kg]."""
    armature: float = 0.027
    """Rotor inertia of one drive, seen at the wheel [kg m^2]."""
    damping: float = 0.16
    """Viscous friction of one wheel's bearing [N m s/rad]."""
    friction: float = 0.82
    """Tyre on floor [-]."""
    patch: float = 0.002
    """Torsional friction of one tyre per load: the radius of its friction patch [m]."""
    roller: float = 0.002
    """Sliding friction of the front wheels [-]."""
    roller_drag: float = 4.4
    """Viscous friction of one front wheel's rollers against sideways motion [N s/m]."""
    kp: float = 9.0
    """Of the wheel-speed controller [N m s/rad]."""
    ki: float = 12.0
    """Of the wheel-speed controller [N m/rad]."""
    torque_limit: float = 14.0
    """Of one drive [N m]."""
    delay: float = 0.02
    """From sending a command to its effect [s]."""
    rise: tuple[float, float] = (0.0, 0.0)
    """How much the floor rises towards +x and +y of the room: sine of the angle [-]."""
    payload: float = 0.0
    """Mass of a box on board [kg]."""
    payload_at: tuple[float, float, float] = (0.12, 0.14, 0.3)
    """Middle of the box, from the drive axle [m]."""
    play: float = 0.0
    """Half of the free angle between rotor and wheel [rad]."""

    def on_day(self, random: np.random.Generator) -> Chair:
        """The same chair on another day: gains, mass, friction and wheel damping differ by a few percent."""
        scale = np.exp(0.02 * np.clip(random.standard_normal(8), -2.0, 2.0))
        return replace(
            self,
            kp=self.kp * scale[0],
            ki=self.ki * scale[1],
            mass=self.mass * scale[2],
            friction=self.friction * scale[3],
            damping=self.damping * scale[4] ** 3,  # bearings and tyres change most
            roller=self.roller * scale[5] ** 3,
            com=(self.com[0] * scale[6], self.com[1], self.com[2]),
            patch=self.patch * scale[7] ** 3,
        )


VEHICLES = {
    "chair": Chair(),
    "scooter": Chair(
        nominal=Nominal(0.165, 0.57, 0.62, 128.0), radius=(0.165, 0.165), track=0.57, mass=128.0,
        com=(0.2, 0.0, 0.26), gyration=(0.3, 0.36, 0.38), wheel_mass=4.5, armature=0.08, damping=0.45, friction=0.7,
        patch=0.004, roller_drag=9.0, kp=24.0, ki=45.0, torque_limit=42.0, delay=0.06, payload_at=(0.25, 0.2, 0.4),
    ),
    "robot": Chair(
        nominal=Nominal(0.098, 0.4, 0.3, 21.0), radius=(0.098, 0.098), track=0.4, mass=21.0, com=(0.09, 0.0, 0.12),
        gyration=(0.15, 0.16, 0.19), wheel_mass=0.8, armature=0.005, damping=0.05, friction=0.95, patch=0.001,
        roller_drag=1.2, kp=2.6, ki=2.0, torque_limit=3.5, delay=0.04, payload_at=(0.1, 0.12, 0.25),
    ),
}
"""The chair that reference data are of; a heavy scooter with its rider; a small indoor robot."""


def build(chair: Chair, contact: Contact = SLOW) -> mujoco.MjModel:
    """The chair's model: free chassis, two driven wheels, pivoting front beam; rotors only where there is play."""
    frame_mass = chair.mass - 2 * chair.wheel_mass - 1.0
    inertia = [frame_mass * radius**2 for radius in chair.gyration]
    gravity = [-GRAVITY * rise for rise in chair.rise]
    gravity.append(-GRAVITY * float(np.sqrt(1.0 - sum(rise**2 for rise in chair.rise))))
    wheels = "".join(_wheel(chair, side) for side in (0, 1))
    box = "" if not chair.payload else (
        f'<body name="payload" pos="{_numbers(chair.payload_at)}"><inertial pos="0 0 0" mass="{chair.payload}" '
        f'diaginertia="{_numbers([chair.payload * 0.012] * 3)}"/></body>'
    )  # fmt: skip
    drive_pair = f'condim="4" friction="{_numbers([chair.friction] * 2 + [chair.patch, 1e-4, 1e-4])}"'
    front_pair = f'condim="3" friction="{_numbers([chair.roller] * 2 + [0, 0, 0])}"'
    solver = f'solref="0.01 1" solreffriction="{contact.friction_time:g} 1" solimp="0.95 0.99 0.001"'
    xml = f"""
<mujoco>
  <option timestep="{contact.timestep:g}" integrator="implicitfast" cone="elliptic" impratio="100"
    gravity="{_numbers(gravity)}">
    <flag autoreset="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0" mass="0"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="chassis" pos="0 0 {chair.nominal.radius}">
      <freejoint/>
      <inertial pos="{_numbers(chair.com)}" mass="{frame_mass}" diaginertia="{_numbers(inertia)}"/>
      {wheels}
      {box}
      <body name="beam" pos="{chair.nominal.wheelbase} 0 {FRONT_RADIUS - chair.nominal.radius}">
        <joint name="pivot" axis="1 0 0" damping="0.5"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.03 0.005 0.03"/>
        <geom name="front_left" type="sphere" size="{FRONT_RADIUS}" pos="0 {FRONT_Y} 0"/>
        <geom name="front_right" type="sphere" size="{FRONT_RADIUS}" pos="0 {-FRONT_Y} 0"/>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair geom1="floor" geom2="tyre_left" {drive_pair} {solver}/>
    <pair geom1="floor" geom2="tyre_right" {drive_pair} {solver}/>
    <pair geom1="floor" geom2="front_left" {front_pair} {solver}/>
    <pair geom1="floor" geom2="front_right" {front_pair} {solver}/>
  </contact>
  {_plays(chair)}
</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def _wheel(chair: Chair, side: int) -> str:
    """One driven wheel; with play its rotor is a joint of its own, which carries the armature."""
    name, y, radius = ("left", "right")[side], (0.5 - side) * chair.track, chair.radius[side]
    inertia = [share * chair.wheel_mass * radius**2 for share in (0.3, 0.5, 0.3)]
    armature = 1e-4 if chair.play else chair.armature
    rotor = "" if not chair.play else (
        f'<body name="rotor_{name}" pos="0 {y} 0"><joint name="rotor_{name}" axis="0 1 0" armature="{chair.armature}"/>'
        '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-5 1e-5 1e-5"/></body>'
    )  # fmt: skip
    return f"""
      <body name="wheel_{name}" pos="0 {y} 0">
        <joint name="wheel_{name}" axis="0 1 0" damping="{chair.damping}" armature="{armature}"/>
        <inertial pos="0 0 0" mass="{chair.wheel_mass}" diaginertia="{_numbers(inertia)}"/>
        <geom name="tyre_{name}" type="ellipsoid" size="{radius} 0.03 {radius}"/>
      </body>{rotor}"""


def _plays(chair: Chair) -> str:
    """Tendons that let rotor and wheel differ by no more than the play."""
    if not chair.play:
        return ""
    tendons = "".join(
        f'<fixed name="play_{name}" limited="true" range="{-chair.play} {chair.play}" solreflimit="0.008 1">'
        f'<joint joint="rotor_{name}" coef="1"/><joint joint="wheel_{name}" coef="-1"/></fixed>'
        for name in ("left", "right")
    )
    return f"<tendon>{tendons}</tendon>"


def _numbers(values) -> str:
    return " ".join(f"{value:.9g}" for value in values)
