"""The hypotheses of the closed loop: which parameters each effect of the catalogue frees, and how large it may be.

Every hypothesis has coordinates q with q = 0 where the effect is absent and |q| = 1 for a size that is small but worth
knowing on a vehicle of this mass and track. The same coordinates serve effects that vanish at 0, at 1 and at infinity,
and base parameters that may lie outside their day-to-day spread.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from whill_mjx.effects import EFFECTS, make_effect
from whill_mjx.effects.base import PLACES, place_of
from whill_mjx.vehicle.parameters import describe, get_values
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams

ROUND = 200.0  # s of the session that a round of manoeuvres counts as, with its pauses: logs do not say

GRAVITY = 9.81  # m/s^2
LEVELS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Sizes at which one-sided effects are tried; smooth two-sided ones are tried at -1 and 1."""


@dataclass(frozen=True)
class Axis:
    """One coordinate q of a hypothesis and the parameter it moves."""

    parameter: str
    unit: float
    """Change of the parameter at q = 1; for `inverse` its value there."""
    signed: bool = False
    form: str = "add"
    """add: value = neutral + unit q.  inverse: unit / q.  factor: base value x exp(unit q).  moment: unit q / mass.
    along: neutral + unit q q_0, with q_0 that of the first axis."""
    limit: float = 12.0
    """Largest |q| that a refit may reach."""
    open: tuple[float, float] = (1.0, 1.0)
    """Factors on the size, least and largest, that drives cannot separate from what the effect leaves open."""
    dependent: bool = False
    """Whether it does nothing by itself, but changes what the other axes do."""


@dataclass(frozen=True)
class Hypothesis:
    """One effect with some of its parameters freed."""

    effect: str
    """Canonical name."""
    axes: tuple[Axis, ...]
    variant: str = ""
    """Tells the hypotheses of one effect apart."""
    kind: str = "effect"
    """"parameter_shift" where the axes are base parameters of the vehicle."""
    constants: tuple[tuple[str, float], ...] = ()
    """Other parameters and the values they take."""
    @property
    def key(self) -> str:
        return f"{self.effect}/{self.variant}" if self.variant else self.effect

    @property
    def signed(self) -> bool:
        return all(axis.signed for axis in self.axes)

    @property
    def main(self) -> list[int]:
        """Axes that do something by themselves."""
        return [i for i, axis in enumerate(self.axes) if not axis.dependent]

    def values(self, q: np.ndarray, base: Mapping[str, float]) -> dict[str, float]:
        """Parameter values at coordinates q (k,), given the base values of all parameters."""
        found = dict(self.constants)
        for axis, size in zip(self.axes, np.asarray(q, float), strict=True):
            start = base[axis.parameter]
            if axis.form == "inverse":
                found[axis.parameter] = axis.unit / size if size > 1e-6 else float("inf")
            elif axis.form == "factor":
                found[axis.parameter] = start * float(np.exp(axis.unit * size))
            elif axis.form == "moment":
                mass = max(found["payload_shift.mass"], 1e-3)
                found[axis.parameter] = float(np.clip(axis.unit * size / mass, -0.6, 0.6))
            elif axis.form == "along":
                found[axis.parameter] = start + axis.unit * size * float(q[0])
            else:
                found[axis.parameter] = start + axis.unit * size
        return found


def hypotheses(spec: VehicleSpec, params: VehicleParams) -> tuple[Hypothesis, ...]:
    """All hypotheses for a vehicle; sizes scale with its weight, track and speed.

    Args:
        params: the base model; hypotheses about parameters it does not have are left out.
    """
    weight, track = spec.mass * GRAVITY, spec.track
    speed = min(spec.v_max, 1.0) / 1.0
    force = 0.01 * weight  # a small force on the vehicle [N]

    def one(effect: str, *axes: Axis, **more: Any) -> Hypothesis:
        return Hypothesis(effect, axes, **more)

    def axis(parameter: str, unit: float, **more: Any) -> Axis:
        return Axis(parameter, unit, **more)

    base = describe(params)
    shift: dict[str, Any] = {"kind": "parameter_shift"}
    brakes = [axis(f"acceleration_limit.{way}", 0.25, form="factor", signed=True, dependent=True, limit=6.0)
              for way in ("slowing", "reversing", "turn_slowing")]
    release = axis("command_dead_zone.release", -0.1, dependent=True, limit=8.0)
    every = [
        one("command_delay", axis("command_delay.delay", 0.04, limit=10.0), **shift),
        one("command_dead_zone", axis("command_dead_zone.linear", 0.02 * speed, limit=16.0),
            axis("command_dead_zone.angular", 0.04, limit=16.0), release),
        one("command_dead_zone", axis("command_dead_zone.wheel", 0.02 * speed, limit=16.0), release, variant="wheel"),
        one("acceleration_limit", axis("acceleration_limit.linear", 1.5, form="inverse"), variant="linear"),
        one("acceleration_limit", axis("acceleration_limit.angular", 3.0, form="inverse"), variant="angular"),
        one("acceleration_limit", axis("acceleration_limit.linear", 1.5, form="inverse"),
            axis("acceleration_limit.angular", 3.0, form="inverse"), *brakes, variant="ramp"),
        one("acceleration_limit", axis("acceleration_limit.wheel", 1.5, form="inverse"), *brakes[:2], variant="wheel"),
        one("jerk_limit", axis("jerk_limit.linear", 20.0, form="inverse"),
            axis("jerk_limit.angular", 40.0, form="inverse")),
        one("command_scale", axis("command_scale.linear", 0.02, signed=True),
            axis("command_scale.angular", 0.03, signed=True)),
        one("actuator_lag", axis("actuator_lag.time_constant", 0.03, limit=10.0),
            axis("actuator_lag.cascade", 0.1, dependent=True, limit=5.0)),
        one("torque_saturation", axis("torque_drive.limit", -0.1, form="factor"), **shift)
        if "torque_drive.limit" in base else
        one("torque_saturation", axis("torque_saturation.limit", 0.2 * weight, form="inverse")),
        one("supply_sag", axis("supply_sag.per_second", 0.004), variant="time"),
        one("supply_sag", axis("supply_sag.drain", 0.0002), variant="session",
            constants=(("supply_sag.session", 1.5 * ROUND),)),
        one("supply_sag", axis("supply_sag.per_watt", 0.0006), variant="power"),
        one("supply_sag", axis("torque_drive.kp", -0.1, form="factor", signed=True), variant="gain", **shift),
        one("drive_gain_difference", axis("drive_gain_difference.difference", 0.05, signed=True)),
        one("dry_friction", axis("dry_friction.coulomb", force / 2)),
        one("wheel_radius_difference", axis("wheel_radius_difference.difference", 0.005, signed=True),
            axis("wheel_radius_difference.common", 0.005, signed=True)),
        one("track_width", axis("track_width.error", 0.01, signed=True)),
        one("payload_shift", axis("payload_shift.mass", 0.08 * spec.mass),
            axis("payload_shift.x", 0.01 * spec.mass * spec.wheelbase, form="moment", signed=True, dependent=True),
            axis("payload_shift.y", 0.01 * spec.mass * track, form="moment", signed=True, dependent=True),
            constants=(("payload_shift.z", 0.3),)),
        one("yaw_scrub", axis("yaw_scrub.torque", 0.008 * weight * track),
            axis("track_width.error", 0.005, form="along", dependent=True, limit=4.0), **shift),
        one("omni_roller_friction", axis("omni_roller_friction.mu_t", 0.02)),
        one("caster_kick", axis("caster_kick.force_limit", force),
            axis("caster_kick.trail", 0.3, form="factor", signed=True, dependent=True, limit=5.0),
            axis("caster_kick.sharpness", 2.0, dependent=True)),
        one("traction_limit", axis("slip_traction.mu", -0.15, form="factor"), **shift),
        one("rolling_resistance_speed", axis("rolling_resistance_speed.mu_1", 0.004 / speed, limit=25.0)),
        one("quadratic_drag", axis("quadratic_drag.coefficient", force / speed**2)),
        one("side_force", axis("side_force.sideways", force, signed=True, open=pushed_anywhere(spec))),
        one("slope", axis("slope.along_x", 0.005, signed=True), axis("slope.along_y", 0.005, signed=True)),
        one("wind", axis("wind.along_x", force / 2, signed=True), axis("wind.along_y", force / 2, signed=True)),
        one("backlash", axis("backlash.play", 0.007, limit=10.0)),
        one("odometry_scale", axis("odometry_scale.linear", 0.005, signed=True),
            axis("odometry_scale.angular", 0.01, signed=True)),
        one("sensor_delay", axis("sensor_delay.delay", 0.02)),
        one("clock_offset", axis("clock_offset.offset", 0.01, signed=True)),
    ]
    if spec.drive == "skid":
        every.append(one("turn_efficiency", axis("turn_efficiency.efficiency", 0.02, signed=True)))
    return tuple(one for one in every if one.kind == "effect" or all(one.axes[i].parameter in base for i in one.main))


def pushed_anywhere(spec: VehicleSpec) -> tuple[float, float]:
    """Least and largest force to the side, over one at the chassis origin, that turns the vehicle as much.

    Driven wheels hardly yield to the side: what shows is the torque about their axle. The force may act anywhere on
    the middle half of the wheelbase. Where the origin lies on the axle, or wheels of both axles are driven, the force
    itself is what shows.
    """
    arm = abs(spec.reference_x)
    if spec.drive == "skid" or arm < 1e-3:
        return 1.0, 1.0
    return min(arm / (0.75 * spec.wheelbase), 1.0), max(arm / (0.25 * spec.wheelbase), 1.0)


def with_catalogue(params: VehicleParams, found: tuple[Hypothesis, ...]) -> VehicleParams:
    """The vehicle with every effect of the hypotheses at its neutral values, which change no bit of its motion."""
    have = {effect.name for effect in params.effects}
    added = {axis.parameter.partition(".")[0] for one in found for axis in one.axes} - have - {"body"}
    effects = [make_effect(name) for name in added]
    order = sorted(effects, key=lambda effect: (PLACES.index(place_of(effect)), list(EFFECTS).index(effect.name)))
    return VehicleParams(params.body, (*params.effects, *order))


def base_values(params: VehicleParams) -> dict[str, float]:
    """Every parameter of a vehicle by name."""
    names = list(describe(params))
    return dict(zip(names, np.asarray(get_values(params, names), float).tolist(), strict=True))
