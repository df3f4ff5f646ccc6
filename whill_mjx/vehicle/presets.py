"""Vehicles ready to use: a spec and its parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp

from whill_mjx.effects import command_expiry, command_quantisation, encoder_resolution, gyro_range, state_rate
from whill_mjx.effects.acceleration_limit import AccelerationLimit
from whill_mjx.effects.air_drag import AirDrag
from whill_mjx.effects.caster_kick import CasterKick
from whill_mjx.effects.command_delay import CommandDelay
from whill_mjx.effects.command_expiry import CommandExpiry
from whill_mjx.effects.command_quantisation import CommandQuantisation
from whill_mjx.effects.encoder_resolution import EncoderResolution
from whill_mjx.effects.gyro_range import GyroRange
from whill_mjx.effects.lateral_damping import LateralDamping
from whill_mjx.effects.odometry_lag import OdometryLag
from whill_mjx.effects.pid_drive import ForwardSlip, PidDrive, RollingContact
from whill_mjx.effects.rolling_resistance import RollingResistance
from whill_mjx.effects.slip_traction import SlipTraction
from whill_mjx.effects.state_rate import StateRate
from whill_mjx.effects.suspension import Suspension
from whill_mjx.effects.torque_drive import TorqueDrive
from whill_mjx.effects.yaw_scrub import YawScrub
from whill_mjx.vehicle.model import box_inertia
from whill_mjx.vehicle.specs import GRAVITY, SPECS, VehicleSpec, find_spec
from whill_mjx.vehicle.types import Body, VehicleParams, as_number

SAG = 0.005 / 0.1325  # of a wheel's radius, under the weight at rest: the chair's
SPARE = 1.5  # torque of a skid drive over that at which its wheels slide sideways (estimate)


def preset(name: str) -> tuple[VehicleSpec, VehicleParams]:
    """Spec and parameters of a built-in vehicle.

    "whill_cr" has the paper's initial values, "whill_cr_paper" its optimised ones, "whill_cr_ramp" these with the ramp
    on commands that the maker documents, "whill_cr_physical" the physical base model,
    "whill_cr_documented" that with everything the maker documents of the drive, "whill_cr_castored" a chair of the same
    size on swivelling casters instead of omni-wheels; "husky", "warthog" and "create"
    are the paper's model on another spec.
    """
    whill = {
        "whill_cr_paper": paper_optimised, "whill_cr_ramp": paper_ramp, "whill_cr_physical": physical,
        "whill_cr_documented": documented, "whill_cr_castored": castored,
    }  # fmt: skip
    if name in whill:
        spec = find_spec("whill_cr")
        if name == "whill_cr_documented":
            limits: Any = {key: command_quantisation.MAKER[key] for key in ("v_min", "v_max", "omega_max")}
            spec = replace(spec, **limits)
        return spec, whill[name](spec)
    if name not in SPECS:
        known = ", ".join(sorted({*whill, *SPECS}))
        raise ValueError(f"unknown vehicle {name!r} (known: {known}). Use one of them or a vehicle file.")
    spec = SPECS[name]
    return spec, preset_params(spec, "paper")


def preset_params(spec: VehicleSpec, kind: str = "paper") -> VehicleParams:
    """Parameters of a base model on any spec; ValueError names the known kinds."""
    kinds = {"paper": paper_initial, "paper_optimised": paper_optimised, "physical": physical}
    if kind not in kinds:
        raise ValueError(f"unknown base model {kind!r} (known: {', '.join(kinds)}).")
    return kinds[kind](spec)


def paper_initial(spec: VehicleSpec) -> VehicleParams:
    """The paper's base model at its initial values (reference paper, Table II)."""
    return VehicleParams(
        default_body(spec),
        (
            with_values(PidDrive, kp=10.0, ki=0.0, kd=0.0, integral_limit=0.5),
            with_values(ForwardSlip, eta=1.0),
            with_values(RollingContact, grip=1.0),
            with_values(LateralDamping, c_rear=1.0, c_front=0.1),
            with_values(RollingResistance, mu_r=0.002),
            with_values(AirDrag, c_d=0.2, area=0.8),
        ),
    )


def paper_optimised(spec: VehicleSpec) -> VehicleParams:
    """The paper's base model at its optimised values (reference paper, Table II)."""
    com = {"com_x": -0.2654, "com_y": 0.0044, "com_z": 0.1215}
    body = with_values(Body, mass=spec.mass, yaw_inertia=box_inertia(spec)[2], **com)
    return VehicleParams(
        body,
        (
            with_values(PidDrive, kp=27.70, ki=0.4025, kd=0.7384, integral_limit=1.431),
            with_values(ForwardSlip, eta=0.84),
            with_values(RollingContact, grip=1.0),
            with_values(LateralDamping, c_rear=34.79, c_front=0.4056),
            with_values(RollingResistance, mu_r=0.0033),
            with_values(AirDrag, c_d=1.132, area=1.062),
        ),
    )


def paper_ramp(spec: VehicleSpec) -> VehicleParams:
    """The paper's optimised vehicle behind the maker's ramp of 1.7 m/s^2 on v, and as much at the wheels on omega."""
    params = paper_optimised(spec)
    ramp = with_values(AccelerationLimit, linear=1.7, angular=1.7 / (spec.track / 2))
    return VehicleParams(params.body, (ramp, *params.effects))


def physical(spec: VehicleSpec) -> VehicleParams:
    """The physical base model: torque control of wheel spin, friction-limited slip, scrub, delay, odometry low-pass.

    Gains scale with the vehicle: kp and ki give a speed loop of 15 1/s and 20 1/s^2 on the whole mass, the torque limit
    an acceleration of 4 m/s^2. On a differential drive the centre of mass lies 0.2 wheelbases from the middle towards
    the driven axle, which so carries 70 % of the weight, as in powered chairs (estimate).
    """
    load = spec.mass / 2 * spec.wheel_radius**2 + spec.wheel_inertia  # inertia that one side's motor sees [kg m^2]
    skid = spec.drive == "skid"
    middle = (spec.rear_x + spec.front_x) / 2
    com_x = middle if skid else middle + 0.4 * (spec.reference_x - middle)
    return VehicleParams(
        replace(default_body(spec), com_x=as_number(com_x)),
        (
            with_values(CommandDelay, delay=0.02),
            with_values(
                TorqueDrive, kp=15.0 * load, ki=20.0 * load, limit=4.0 * load / spec.wheel_radius, windup=0.5, kff=0.0,
                period=0.0
            ),
            with_values(SlipTraction, mu=0.8, slip_speed=0.02, side_slip_speed=0.05, mu_free=0.0 if skid else 0.02),
            with_values(YawScrub, torque=0.01 * spec.mass * spec.track),
            with_values(RollingResistance, mu_r=0.01),
            with_values(OdometryLag, time_constant=0.03),
        ),
    )


def in_short(spec: VehicleSpec, kind: str) -> VehicleParams:
    """The base model of a vehicle of which only a short file is known.

    The physical one stands on tyres that give way in proportion to their radius: with the chair's 5 mm a robot of 10 cm
    wheelbase would lean by 2 degrees. The motors of a skid drive can turn its wheels against their friction.
    """
    params = preset_params(spec, kind)
    if kind != "physical":
        return params
    found = {effect.name: effect for effect in params.effects}
    drive, slip = found["torque_drive"], found["slip_traction"]
    if spec.drive == "skid":
        sliding = slip.mu * spec.mass / 2 * GRAVITY * spec.wheel_radius  # N m, of one side
        drive = replace(drive, limit=jnp.maximum(drive.limit, SPARE * sliding))
    tyres = with_values(Suspension, sag=SAG * spec.wheel_radius, damping=0.5)
    effects = (*(drive if effect.name == "torque_drive" else effect for effect in params.effects), tyres)
    return VehicleParams(params.body, effects)


def documented(spec: VehicleSpec) -> VehicleParams:
    """The physical model with the drive as the maker documents it; each effect can be taken out of the tuple.

    Commands lapse after 200 ms, come in words and are ramped; state and gyro come in steps and at a rate.
    """
    params = physical(spec)
    before = (
        with_values(CommandExpiry, **command_expiry.MAKER, loss=0.0),
        with_values(CommandQuantisation, **command_quantisation.MAKER),
    )
    ramp = with_values(AccelerationLimit, linear=1.7, angular=1.7 / (spec.track / 2))
    behind = (
        with_values(EncoderResolution, **encoder_resolution.MAKER),
        with_values(StateRate, **state_rate.MAKER),
        with_values(GyroRange, **gyro_range.MAKER),
    )
    delay, *rest = params.effects
    return VehicleParams(params.body, (*before, delay, ramp, *rest, *behind))


def castored(spec: VehicleSpec) -> VehicleParams:
    """The physical model on casters: they push across until they trail, and roll freely then (estimates)."""
    params = physical(spec)
    slip = with_values(SlipTraction, mu=0.8, slip_speed=0.02, side_slip_speed=0.05, mu_free=0.0)
    kick = with_values(CasterKick, force_limit=20.0, trail=0.15, start_angle=0.0)
    effects = tuple(slip if effect.name == "slip_traction" else effect for effect in params.effects)
    return VehicleParams(params.body, (*effects, kick))


def default_body(spec: VehicleSpec) -> Body:
    """Nominal mass, the yaw inertia of a box of the vehicle's size, centre of mass at the chassis origin."""
    return with_values(Body, mass=spec.mass, yaw_inertia=box_inertia(spec)[2], com_x=0.0, com_y=0.0, com_z=0.0)


def with_values(kind: type, **values: float) -> Any:
    """A `kind` (an effect or the body) with these values as arrays of the default float type."""
    return kind(**{name: as_number(value) for name, value in values.items()})
