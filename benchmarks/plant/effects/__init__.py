"""The table of effects: what acts, its base size, its unit and its functional form.

The form of each is the first line of its class. `known` says whether the vehicle model's catalogue has an effect of
that name; `other_form` whether it is written there with another law than here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.plant.base import Effect
from benchmarks.plant.chair import Chair
from benchmarks.plant.effects import actuation, command, force, outside, sensing, world


@dataclass(frozen=True)
class Entry:
    """One effect of the table."""

    make: type[Effect]
    base: float
    """A plausible small size; tests and studies use multiples of it."""
    unit: str
    other_form: bool = True
    """Another law than in the catalogue, or not in it."""
    known: bool = True
    """The catalogue has an effect of this name."""
    covered: str = ""
    """Where it has none of this name: its effect that does the same by another law, so that naming it is right."""
    signed: bool = False
    """Sizes below zero make sense."""
    most: float = math.inf
    """Size beyond which the chair no longer drives its manoeuvres: stalled motors, ice, a play that shakes it."""

    @property
    def can_be_named(self) -> bool:
        """Whether the catalogue has it, by this name or another one."""
        return self.known or bool(self.covered)

    @property
    def form(self) -> str:
        """Functional form in words and symbols; s is the size."""
        return (self.make.__doc__ or "").split("\n")[0].replace(" Not catalogued.", "")


EFFECTS: dict[str, Entry] = {
    "command_delay": Entry(command.CommandDelay, 0.06, "s"),
    "command_dead_zone": Entry(command.CommandDeadZone, 0.06, "m/s"),
    "acceleration_limit": Entry(command.AccelerationLimit, 0.5, "s^2/m"),
    "jerk_limit": Entry(command.JerkLimit, 0.15, "s"),
    "command_scale": Entry(command.CommandScale, 0.02, "-", other_form=False, signed=True),
    "actuator_lag": Entry(actuation.ActuatorLag, 0.04, "s"),
    "torque_saturation": Entry(actuation.TorqueSaturation, 2.0, "N m", most=3.5),
    "supply_sag": Entry(actuation.SupplySag, 0.15, "-", most=0.4),
    "drive_gain_difference": Entry(actuation.DriveGainDifference, 0.06, "-", other_form=False, signed=True),
    "dry_friction": Entry(force.DryFriction, 1.0, "N m"),
    "wheel_radius_difference": Entry(world.WheelRadiusDifference, 0.006, "-", other_form=False, signed=True),
    "track_width": Entry(world.TrackWidth, 0.02, "-", other_form=False, signed=True),
    "payload_shift": Entry(world.PayloadShift, 15.0, "kg"),
    "yaw_scrub": Entry(force.YawScrub, 0.008, "m"),
    "omni_roller_friction": Entry(force.OmniRollerFriction, 0.03, "-"),
    "caster_kick": Entry(force.CasterKick, 10.0, "N", most=30.0),
    "traction_limit": Entry(world.TractionLimit, 0.2, "-", most=0.5),
    "rolling_resistance_speed": Entry(force.RollingResistanceSpeed, 0.02, "(s/m)^1.5"),
    "quadratic_drag": Entry(force.QuadraticDrag, 12.0, "N s^2/m^2", other_form=False, most=40.0),
    "side_force": Entry(force.SideForce, 10.0, "N", other_form=False, signed=True),
    "slope": Entry(world.Slope, 0.02, "rad", other_form=False, signed=True),
    "wind": Entry(force.Wind, 8.0, "N", signed=True),
    "backlash": Entry(actuation.Backlash, 0.01, "rad", most=0.02),
    "odometry_scale": Entry(sensing.OdometryScale, 0.01, "-", other_form=False, signed=True),
    "sensor_delay": Entry(sensing.SensorDelay, 0.04, "s"),
    "clock_offset": Entry(sensing.ClockOffset, 0.04, "s", signed=True),
    "wheel_ripple": Entry(outside.WheelRipple, 1.0, "N m", known=False),
    "soft_patch": Entry(outside.SoftPatch, 12.0, "N", known=False),
    "warm_up": Entry(outside.WarmUp, 2.0, "N m", known=False),
    "gain_fade": Entry(actuation.GainFade, 0.2, "-", known=False, covered="supply_sag", most=0.7),
    "rest_friction": Entry(outside.RestFriction, 1.5, "N m", known=False),
    "command_coupling": Entry(command.CommandCoupling, 0.04, "-", known=False),
    "command_dropouts": Entry(command.CommandDropouts, 0.08, "-", known=False),
    "carpet_nap": Entry(outside.CarpetNap, 15.0, "N", known=False),
}


def in_proportion(name: str, size: float, chair: Chair) -> float:
    """A size of an effect on the usual chair, for a vehicle of another mass and other drives."""
    usual = Chair()
    mass, torque = chair.nominal.mass / usual.nominal.mass, chair.torque_limit / usual.torque_limit
    return size * {"N": mass, "kg": mass, "N s^2/m^2": mass, "N m": torque}.get(EFFECTS[name].unit, 1.0)
