"""A robot as a vehicle of the simulator, where its kind has one.

Two driven wheels and supports that slide: what a fit of the robot knows goes over value by value, namely mass
distribution, true sizes of wheels, controller, friction, and all effects around it. What a contact solver has no number
for, such as how a tyre creeps, is taken for stiff.

Skid-steered: the vehicle is fitted in place of the robot. Rigid wheels on a rigid frame chatter in MuJoCo's contacts
while they slide, so that a change of 0.01 % of a size turns the robot otherwise by 5 % of a quarter turn, and how far
it turns follows from the rotors' inertia, which is not that of a real tyre. The vehicle's tyres have a law of sliding
whose grip along and across is fitted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from sysid.replay.models import Parameters, Twin, describe_parameters, with_effects
from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import parts, tyre_places
from sysid.replay.robot_parameters import Entry, Overlaid, Size
from sysid.replay.robot_servos import ROTOR_SHARE
from whill_mjx.vehicle.parameters import set_values
from whill_mjx.vehicle.presets import in_short, preset_params
from whill_mjx.vehicle.specs import VehicleSpec
from whill_mjx.vehicle.types import VehicleParams

CREEP, SIDE_CREEP = 0.002, 0.005  # m/s, sliding speeds of a stiff tyre along and across
SAG = 0.01  # of the wheel radius, of hard tyres; with a chair's 5 mm a robot of 6 cm wheelbase tips over when it brakes
DRIVE = {"drive.kp": "torque_drive.kp", "drive.ki": "torque_drive.ki", "drive.limit": "torque_drive.limit"}
FRICTION = ".friction"
SIZES = ("body_length", "body_width", "body_height")
ROUNDED = 1e-3
"""Shares of the weight up to this are of axles that a file places with few digits."""


def vehicle_of(
    robot: Robot, entries: dict[str, Entry | Size], params: Parameters, spec: VehicleSpec,
) -> Twin | str:  # fmt: skip
    """The vehicle that drives as the robot, or the reason why there is none.

    `entries`: where its parameters stand; `params`: fitted ones; `spec`: of the log, with stated sizes and limits.
    """
    values = {name: float(value) for name, value in params.values.items()}
    if len(robot.wheels) != 2:
        return "what was fitted of a skid-steered robot are parameters of its contacts, which a vehicle does not have"
    if not set(DRIVE) <= set(values) or "wheels.radius" not in values:
        return "sizes and controller were not fitted"
    if not robot.sliding:
        return "its casters turn or swivel"
    arrays: dict[str, np.ndarray] = {}
    for name, entry in entries.items():
        arrays.update(entry.changes(Overlaid(robot.host, arrays), values[name]))
    mass, com, yaw_inertia = _mass_of(robot, arrays)
    ahead = _ahead(robot, robot.resting.geom_xpos[list(robot.sliding)])
    if ahead.min() < 0 < ahead.max():
        return "it stands on supports before and behind its axle"
    support = float(ahead.mean())
    share = float(np.clip(com[0] / support, 0.0, 1.0))  # of the weight, that the supports carry
    middle, body = outline_of(robot)
    spec = replace(spec, mass=mass, drive="differential", driven_axle="rear" if support > 0 else "front",
                   wheelbase=abs(support), rear_axle_x=min(support, 0.0) - middle, wheel_inertia=robot.spin, **body)
    (tyre, wheels), (ball, balls) = (
        _friction(robot, entries, values, geoms) for geoms in (
            tuple(parts(robot.host, robot.host.jnt_bodyid[robot.joints[0]]).tolist()), robot.sliding))
    host, motor = robot.host, robot.actuators[0]
    gain = float(abs(host.actuator_gear[motor, 0] * host.actuator_gainprm[motor, 0])) if robot.motors else 1.0
    found = {
        "body.mass": mass, "body.yaw_inertia": yaw_inertia, "body.com_x": spec.reference_x + com[0],
        "body.com_y": com[1], "body.com_z": com[2],
        **{name: values[ours] * (gain if ours == "drive.kp" else 1.0) for ours, name in DRIVE.items()},
        "torque_drive.windup": 1.0, "slip_traction.mu": wheels, "slip_traction.slip_speed": CREEP,
        "slip_traction.side_slip_speed": SIDE_CREEP, "slip_traction.mu_free": balls, "yaw_scrub.torque": 0.0,
        "rolling_resistance.mu_r": balls * share, "command_delay.delay": 0.0, "odometry_lag.time_constant": 0.0,
        "wheel_radius_difference.common": values["wheels.radius"] / spec.wheel_radius - 1,
        "suspension.sag": SAG * spec.wheel_radius,
        "wheel_radius_difference.difference": values.get("wheels.difference", 0.0),
        "track_width.error": values.get("wheels.track", spec.track) / spec.track - 1}
    around = {effect.name: effect for effect in params.effects}
    own = ("wheel_radius_difference", "track_width", "suspension")
    base = with_effects(preset_params(spec, "physical"), (*own, *around))
    vehicle = set_values(base, list(found), jnp.asarray(list(found.values()), jnp.result_type(float)))
    shared = {
        **{ours: (name, gain if ours == "drive.kp" else 1.0, 0.0) for ours, name in DRIVE.items()},
        **{name: (theirs, 1.0, 0.0) for name, theirs in ((tyre, "slip_traction.mu"), (ball, "slip_traction.mu_free"))},
        "wheels.radius": ("wheel_radius_difference.common", 1 / spec.wheel_radius, -1.0),
        "wheels.difference": ("wheel_radius_difference.difference", 1.0, 0.0),
        "wheels.track": ("track_width.error", 1 / spec.track, -1.0),
        **{name: (name, 1.0, 0.0) for name in describe_parameters(params) if name.partition(".")[0] in around}}
    effects = tuple(around.get(effect.name, effect) for effect in vehicle.effects)
    return Twin(spec, VehicleParams(vehicle.body, effects), shared)


def skid_vehicle(robot: Robot, spec: VehicleSpec) -> Twin:
    """The vehicle of the simulator that a skid-steered robot's file describes, where a fit begins.

    Wheels between the outer axles are taken to stand in the middle of these (`middle_wheels`): as large a share of the
    weight as gives all wheels their mean square distance from there.

    `spec`: of the log, with stated sizes and limits.
    """
    host = robot.host
    axles = _ahead(robot, robot.resting.xanchor[list(robot.joints)])
    half, middle = float(np.ptp(axles)) / 2, float(axles.max() + axles.min()) / 2
    share = 1 - float(np.mean((axles - middle) ** 2)) / half**2 if len(axles) > 4 and half > 0 else 0.0
    half = round(half, 6)
    mass, com, yaw_inertia = _mass_of(robot, {})
    centre, body = outline_of(robot)
    bare = robot.spin - float(np.mean(host.dof_armature[list(robot.wheels)]) if robot.added else 0.0)
    wheels = len(robot.wheels) // 2
    spin = max(bare, ROTOR_SHARE * mass * robot.wheel_radius**2 / len(robot.wheels))
    spec = replace(spec, mass=mass, drive="skid", wheelbase=2 * half, rear_axle_x=-half - centre,
                   wheel_inertia=wheels * spin, **body)
    found = {"body.mass": mass, "body.yaw_inertia": yaw_inertia, "body.com_x": spec.reference_x + com[0],
             "body.com_y": com[1], "body.com_z": com[2], **({"middle_wheels.share": share} if share > ROUNDED else {})}
    params = with_effects(in_short(spec, "physical"), ("middle_wheels",) if share > ROUNDED else ())
    return Twin(spec, set_values(params, list(found), jnp.asarray(list(found.values()), jnp.result_type(float))), {})


def _ahead(robot: Robot, places: np.ndarray) -> np.ndarray:
    """How far places (K, 3) in the room are ahead of the middle of the driven wheels, at rest [m]."""
    return (places - tyre_places(robot.host, robot.resting, robot.joints).mean(0)) @ robot.axes[0]


def _mass_of(robot: Robot, arrays: dict[str, np.ndarray]) -> tuple[float, np.ndarray, float]:
    """Mass, its centre (3,) from the middle of the driven wheels, and yaw inertia about it; `arrays` of the model are
    replaced."""
    host, data = robot.host, robot.resting
    model: Any = Overlaid(host, arrays)
    bodies = np.flatnonzero(host.body_rootid == robot.base)
    middle = tyre_places(host, data, robot.joints).mean(0)
    masses, places = model.body_mass[bodies], (data.xipos[bodies] - middle) @ robot.axes.T
    mass = float(masses.sum())
    centre = masses @ places / mass
    upright = np.square(data.ximat[bodies].reshape(-1, 3, 3)[:, 2])
    inertia = (upright * model.body_inertia[bodies]).sum() + masses @ np.square(places - centre)[:, :2].sum(1)
    return mass, centre, float(inertia)


def outline_of(robot: Robot) -> tuple[float, dict[str, Any]]:
    """How far the middle of the box around its geoms is ahead of the driven axle at rest, and the box's sizes, by their
    names in a spec [m]."""
    host, data, axes = robot.host, robot.resting, robot.axes
    geoms = np.flatnonzero(host.body_rootid[host.geom_bodyid] == robot.base)
    turns = data.geom_xmat[geoms].reshape(-1, 3, 3)
    middle = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", turns, host.geom_aabb[geoms, :3])
    middle = (middle - tyre_places(host, data, robot.joints).mean(0)) @ axes.T
    reach = np.einsum("gij,gj->gi", np.abs(axes @ turns), host.geom_aabb[geoms, 3:])
    low, high = (middle - reach).min(0), (middle + reach).max(0)
    return float(low[0] + high[0]) / 2, dict(zip(SIZES, (high - low).tolist(), strict=True))


def _friction(
    robot: Robot, entries: dict[str, Entry | Size], values: dict[str, float], geoms: tuple[int, ...],
) -> tuple[str, float]:  # fmt: skip
    """Parameter and fitted value of the sliding friction of geoms; no name and that of the file where it is fixed."""
    for name, entry in entries.items():
        if name.endswith(FRICTION) and isinstance(entry, Entry) and set(entry.ids) & set(geoms):
            return name, values[name]
    return "", float(robot.host.geom_friction[list(geoms), 0].max())
