"""The effects: one physical effect per file. `EFFECTS` finds them by name; docs/effects.md lists them."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from whill_mjx.effects.acceleration_limit import AccelerationLimit
from whill_mjx.effects.actuator_lag import ActuatorLag
from whill_mjx.effects.air_drag import AirDrag
from whill_mjx.effects.axle_pivot import AxlePivot
from whill_mjx.effects.backlash import Backlash
from whill_mjx.effects.base import Effect
from whill_mjx.effects.bump import Bump
from whill_mjx.effects.caster_kick import CasterKick
from whill_mjx.effects.clock_offset import ClockOffset
from whill_mjx.effects.command_dead_zone import CommandDeadZone
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.effects.command_expiry import CommandExpiry
from whill_mjx.effects.command_quantisation import CommandQuantisation
from whill_mjx.effects.command_scale import CommandScale
from whill_mjx.effects.drive_gain_difference import DriveGainDifference
from whill_mjx.effects.dry_friction import DryFriction
from whill_mjx.effects.encoder_resolution import EncoderResolution
from whill_mjx.effects.gyro_bias import GyroBias
from whill_mjx.effects.gyro_range import GyroRange
from whill_mjx.effects.incline import Incline
from whill_mjx.effects.jerk_limit import JerkLimit
from whill_mjx.effects.lateral_damping import LateralDamping
from whill_mjx.effects.odometry_lag import OdometryLag
from whill_mjx.effects.odometry_scale import OdometryScale
from whill_mjx.effects.omni_roller_friction import OmniRollerFriction
from whill_mjx.effects.payload_shift import PayloadShift
from whill_mjx.effects.pid_drive import ForwardSlip, PidDrive, RollingContact
from whill_mjx.effects.pose_delay import PoseDelay
from whill_mjx.effects.quadratic_drag import QuadraticDrag
from whill_mjx.effects.ramp import Ramp
from whill_mjx.effects.rolling_resistance import RollingResistance
from whill_mjx.effects.rolling_resistance_speed import RollingResistanceSpeed
from whill_mjx.effects.sensor_delay import SensorDelay
from whill_mjx.effects.side_force import SideForce
from whill_mjx.effects.slip_traction import SlipTraction
from whill_mjx.effects.slope import Slope
from whill_mjx.effects.state_rate import StateRate
from whill_mjx.effects.supply_sag import SupplySag
from whill_mjx.effects.suspension import Suspension
from whill_mjx.effects.torque_drive import TorqueDrive
from whill_mjx.effects.torque_saturation import TorqueSaturation
from whill_mjx.effects.track_width import TrackWidth
from whill_mjx.effects.traction_limit import TractionLimit
from whill_mjx.effects.turn_efficiency import TurnEfficiency
from whill_mjx.effects.unnamed import Unnamed
from whill_mjx.effects.wheel_damping import WheelDamping
from whill_mjx.effects.wheel_inertia import WheelInertia
from whill_mjx.effects.wheel_radius_difference import WheelRadiusDifference
from whill_mjx.effects.wind import Wind
from whill_mjx.effects.yaw_scrub import YawScrub
from whill_mjx.vehicle.types import parameters_of

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        AccelerationLimit,
        ActuatorLag,
        AirDrag,
        AxlePivot,
        Backlash,
        Bump,
        CasterKick,
        ClockOffset,
        CommandDeadZone,
        CommandDelay,
        CommandExpiry,
        CommandQuantisation,
        CommandScale,
        DriveGainDifference,
        DryFriction,
        EncoderResolution,
        ForwardSlip,
        GyroBias,
        GyroRange,
        Incline,
        JerkLimit,
        LateralDamping,
        OdometryLag,
        OdometryScale,
        OmniRollerFriction,
        PayloadShift,
        PidDrive,
        PoseDelay,
        QuadraticDrag,
        Ramp,
        RollingContact,
        RollingResistance,
        RollingResistanceSpeed,
        SensorDelay,
        SideForce,
        SlipTraction,
        Slope,
        StateRate,
        SupplySag,
        Suspension,
        TorqueDrive,
        TorqueSaturation,
        TrackWidth,
        TractionLimit,
        TurnEfficiency,
        Unnamed,
        WheelDamping,
        WheelInertia,
        WheelRadiusDifference,
        Wind,
        YawScrub,
    )
}


def make_effect(name: str, **values: float) -> Effect:
    """The effect of this name with arrays as leaves; parameters that are not given are neutral.

    Raises:
        ValueError: no such effect, or no such parameter; names the known ones.
    """
    if name not in EFFECTS:
        raise ValueError(f"unknown effect {name!r} (known: {', '.join(sorted(EFFECTS))}). Correct the name.")
    known = parameters_of(EFFECTS[name])
    for field in values:
        if field not in known:
            raise ValueError(f"effect {name!r} has no parameter {field!r} (known: {', '.join(known)}). Correct it.")
    effect = EFFECTS[name](**values)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.result_type(float)), effect)
