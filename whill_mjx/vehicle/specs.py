"""Measured constants of the vehicles, each with its source.

Lengths in m, masses in kg, speeds in m/s and rad/s. The chassis frame (the paper's model origin) lies at the middle of
the overall length, at wheel-centre height: x forward, y left, z up. It is not the rear axle: the paper's centre of mass
at x = -0.265 m would lie behind that axle and tip the chair.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from whill_mjx.io import fields

GRAVITY = 9.81
"""Standard gravity [m/s^2]."""


@dataclass(frozen=True)
class CameraMount:
    """Pinhole camera fixed to the chassis."""

    x: float = 0.35
    """Ahead of the chassis origin [m]."""
    z: float = 0.55
    """Above the chassis origin [m]."""
    pitch: float = 0.15
    """Tilt downwards [rad]."""
    fov_y: float = 1.2
    """Vertical field of view [rad]."""
    y: float = 0.0
    """To the left of the chassis origin [m]."""
    roll: float = 0.0
    """Clockwise turn about the line of sight, seen from behind the camera [rad]."""
    yaw: float = 0.0
    """Turn of the line of sight to the left [rad]."""


def check_mount(where: str, mount: Any) -> None:
    """Raise ValueError unless it is a mount with sensible numbers."""
    if not isinstance(mount, CameraMount):
        raise ValueError(f"{where}: is {fields.shown(mount)}; it must be a CameraMount. Give one, such as "
                         "CameraMount(x=0.3, z=0.5).")
    fields.check_fields(where, fields.CAMERA, mount)


@dataclass(frozen=True)
class VehicleSpec:
    """Nominal geometry, mass and limits of one vehicle. Hashable: a static argument of compiled functions."""

    name: str
    """How vehicle files, reports and runs call it."""
    wheel_radius: float
    """Radius of the driven wheels [m]."""
    track: float
    """Distance between left and right driven wheels [m]."""
    wheelbase: float
    """Distance between rear and front axle [m]."""
    mass: float
    """Total mass [kg]."""
    drive: str = "differential"
    """"differential" (one driven axle, free front wheels) or "skid" (all wheels driven per side)."""
    driven_axle: str = "rear"
    """"rear" or "front": where the driven wheels, and so the reference point, are (differential drive only)."""
    rear_axle_x: float | None = None
    """Position of the rear axle in the chassis frame [m]; None puts the origin midway between the axles."""
    wheel_inertia: float = 0.02
    """Spin inertia of the driven wheels of one side, motor included [kg m^2]."""
    body_length: float = 0.985
    """Overall length [m]."""
    body_width: float = 0.554
    """Overall width [m]."""
    body_height: float = 0.9
    """Overall height [m]."""
    v_min: float = -1.0
    """Lowest forward speed [m/s]; the vehicle cuts every command to its limits."""
    v_max: float = 1.0
    """Highest forward speed [m/s]."""
    omega_max: float = 1.0
    """Highest yaw rate in both directions [rad/s]."""
    camera: CameraMount = CameraMount()
    """Where its camera sits."""

    def __post_init__(self) -> None:
        fields.check_fields(f"vehicle {fields.shown(self.name)}", fields.SPEC, self)
        check_mount(f"camera of vehicle {fields.shown(self.name)}", self.camera)

    @property
    def rear_x(self) -> float:
        """Position of the rear axle in the chassis frame [m]."""
        return -self.wheelbase / 2 if self.rear_axle_x is None else self.rear_axle_x

    @property
    def front_x(self) -> float:
        """Position of the front axle in the chassis frame [m]."""
        return self.rear_x + self.wheelbase

    @property
    def reference_x(self) -> float:
        """Position of the reference point (driven-axle centre; middle of a skid drive) in the chassis frame [m]."""
        if self.drive == "skid":
            return (self.rear_x + self.front_x) / 2
        return self.rear_x if self.driven_axle == "rear" else self.front_x


# Wheel radius and track: WHILL/ros_whill WHILL.h (0.1325, 0.496). Wheelbase: modelc.xacro (0.60, crude model).
# Mass with battery about 52 kg and the overall size: recalled from the maker's sheet, not verified; fit or weigh.
# Rear axle 0.36 m behind the middle of the overall length: an assumption (0.13 m of the chair lie behind the axle).
# Limits: the paper's +-1 m/s and +-1 rad/s, which its course is driven with. The chair itself accepts -0.556 to
# 1.667 m/s and +-1.68 rad/s: those are the limits of the preset "whill_cr_documented".
WHILL_CR = VehicleSpec(
    name="whill_cr", wheel_radius=0.1325, track=0.496, wheelbase=0.60, mass=52.0, rear_axle_x=-0.36,
    body_length=0.985, body_width=0.554, body_height=0.9,
)
# Clearpath Husky A200: radius and track from its run configuration (0.165, 0.55); 50 kg and 0.99 x 0.67 m from the
# data sheet.
HUSKY = VehicleSpec(
    name="husky", wheel_radius=0.165, track=0.55, wheelbase=0.512, mass=50.0, drive="skid", wheel_inertia=0.1,
    body_length=0.99, body_width=0.67, body_height=0.39, v_min=-1.0, v_max=1.0, omega_max=2.0,
    camera=CameraMount(x=0.40, z=0.30, pitch=0.10),
)
# Clearpath Warthog on wheels: radius and track from its run configuration (0.30, 1.08); 280 kg and size from the
# data sheet.
WARTHOG = VehicleSpec(
    name="warthog", wheel_radius=0.30, track=1.08, wheelbase=0.914, mass=280.0, drive="skid", wheel_inertia=1.5,
    body_length=1.52, body_width=1.38, body_height=0.83, v_min=-5.0, v_max=5.0, omega_max=4.0,
    camera=CameraMount(x=0.70, z=0.65, pitch=0.15),
)
# iRobot Create: wheel separation 0.258 m and radius 0.033 m from the Open Interface manual; about 3.6 kg with its
# battery.
CREATE = VehicleSpec(
    name="create", wheel_radius=0.033, track=0.258, wheelbase=0.26, mass=3.6, wheel_inertia=2e-4,
    body_length=0.34, body_width=0.34, body_height=0.10, v_min=-0.5, v_max=0.5, omega_max=4.0,
    camera=CameraMount(x=0.12, z=0.09, pitch=0.0),
)
# The cameras of the last three are assumptions: at the front of the body, a hand above it.
SPECS = {spec.name: spec for spec in (WHILL_CR, HUSKY, WARTHOG, CREATE)}


def in_proportion(
    base: VehicleSpec, name: str, wheel_radius: float, track: float, wheelbase: float | None = None,
    mass: float | None = None,
) -> VehicleSpec:
    """The spec of a vehicle of which little but its size is known: all else is in proportion to `base` (an estimate).

    Lengths along the vehicle go with the wheelbase, those across it and its height with the track, and the inertia of
    its wheels with mass times the square of their radius.

    Args:
        name: what it is called.
        wheel_radius, track: of the vehicle [m].
        wheelbase: of the vehicle [m]; by default it goes with the track.
        mass: of the vehicle [kg]; by default it goes with the cube of the track.
    """
    across = track / base.track
    wheelbase = base.wheelbase * across if wheelbase is None else wheelbase
    mass = base.mass * across**3 if mass is None else mass
    along = wheelbase / base.wheelbase
    spin = mass * wheel_radius**2 / (base.mass * base.wheel_radius**2)
    camera = replace(base.camera, x=base.camera.x * along, z=base.camera.z * across)
    return replace(
        base, name=name, wheel_radius=wheel_radius, track=track, wheelbase=wheelbase, mass=mass, camera=camera,
        rear_axle_x=None if base.rear_axle_x is None else base.rear_axle_x * along,
        wheel_inertia=base.wheel_inertia * spin, body_length=base.body_length * along,
        body_width=base.body_width * across, body_height=base.body_height * across,
    )


def find_spec(name: str) -> VehicleSpec:
    """Spec of a built-in vehicle; ValueError names the known ones."""
    if name not in SPECS:
        known = ", ".join(sorted(SPECS))
        raise ValueError(f"unknown vehicle {name!r} (known: {known}). Use one of them or a vehicle file.")
    return SPECS[name]
