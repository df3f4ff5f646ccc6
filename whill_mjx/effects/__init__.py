"""The effects: one physical effect per file. `EFFECTS` finds them by their canonical names."""

from __future__ import annotations

from whill_mjx.effects.acceleration_limit import AccelerationLimit
from whill_mjx.effects.air_drag import AirDrag
from whill_mjx.effects.base import Effect
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.effects.lateral_damping import LateralDamping
from whill_mjx.effects.odometry_lag import OdometryLag
from whill_mjx.effects.pid_drive import ForwardSlip, PidDrive, RollingContact
from whill_mjx.effects.rolling_resistance import RollingResistance
from whill_mjx.effects.slip_traction import SlipTraction
from whill_mjx.effects.torque_drive import TorqueDrive
from whill_mjx.effects.yaw_scrub import YawScrub

EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        AccelerationLimit,
        AirDrag,
        CommandDelay,
        ForwardSlip,
        LateralDamping,
        OdometryLag,
        PidDrive,
        RollingContact,
        RollingResistance,
        SlipTraction,
        TorqueDrive,
        YawScrub,
    )
}
