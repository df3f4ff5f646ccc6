"""A user's MJCF or URDF differential drive, stepped by MJX, as a model that the fit can drive.

Parameters are dotted paths KIND.NAME.FIELD into the model; NAME may be a pattern, and then all that it matches share
one value:

    body.base.mass              kg; the body's inertia scales with it
    body.base.com_x, .inertia_z m in the body's frame, kg m^2 about a principal axis
    geom.*_tyre.friction        sliding friction; MuJoCo takes the larger one of two geoms, or that of higher priority
    joint.left.damping          also armature, frictionloss, stiffness
    actuator.*.gain             of a motor; of a velocity servo its kv, with both of its entries
    actuator.*.force_limit      either way [N m]
    drive.kp                    N m s/rad, of the speed controller that is put before motors (torque actuators)
    geom.floor.solref.0         any other array of mjx.Model, as KIND.NAME.ARRAY.COLUMN

The constants that MuJoCo derives from masses to soften contacts keep their nominal values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from sysid.replay.arrays import quaternion_product, rotated
from sysid.replay.models import Bounds, Model, Parameters, Twin, make_parameters, with_surroundings
from sysid.replay.records import Plant
from sysid.replay.robot import Robot
from sysid.replay.robot_drive import RobotDrive, rolling_ratio
from sysid.replay.robot_loading import load_robot
from sysid.replay.robot_parameters import (
    SIZES,
    Entry,
    Size,
    default_paths,
    drive_entries,
    resolve,
    sizes_of,
    turning_inertia,
    write_mjcf,
)
from sysid.replay.robot_rest import FALLS
from sysid.replay.robot_vehicle import skid_vehicle, vehicle_of
from whill_mjx.processor import shares_results
from whill_mjx.vehicle.model import import_mjx
from whill_mjx.vehicle.specs import VehicleSpec

FACTOR = 5.0  # bounds of a parameter of which only the path is given: its value over and times this
AROUND_ROBOT = ("command_delay", "acceleration_limit", "odometry_lag", "sensor_delay", "odometry_scale", "pose_mount")
"""Effects of the catalogue that every robot may have around it."""
NEAR = 0.15  # share by which a true radius or track may differ from the file's


@struct.dataclass
class Motion:
    """What MJX carries from step to step."""

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warm: jax.Array  # where the contact solver starts


def mjcf_model(
    path: str | Path, parameters: Mapping[str, tuple[float, float]] | Sequence[str] | None = None, *,
    wheels: Sequence[str] = (), wheel_radius: float | None = None, track: float | None = None,
    timestep: float | None = None, effects: Sequence[str] = (), room_fixed: bool | None = None,
    calibrate: bool = False,
) -> Model:
    """A differential drive from an MJCF or URDF file; a free joint, a floor or actuators on its wheels are added where
    missing.

    Commands become wheel speeds, and wheel speeds odometry, with the nominal radius and track.

    Args:
        path: of the file; meshes are looked for beside it.
        parameters: dotted path -> (lowest, highest), or paths alone (a fifth to five times the file's value); by
            default gain, damping and friction of the driven wheels.
        wheels: joints or actuators of the driven wheels, left and right; by default the two that have "left" and
            "right" in their names, or the two or three of each side of a skid-steered robot.
        wheel_radius, track: nominal, of controller and odometry [m]; by default those of the file.
        timestep: physics step [s]; by default the file's.
        effects: of the catalogue, around the model; for example command_delay.
        calibrate: also fit true radii and track (`wheels.radius`, `wheels.difference`, `wheels.track`), and delays,
            scales and the tracked point around the model, where a log shows them. Of a skid-steered robot a fit takes
            the vehicle of the simulator in its place (`sysid.replay.robot_vehicle`).
        room_fixed: it matters where in the room it starts; by default where the world has more than planes in it.

    FileNotFoundError or ValueError names the file, the rule and the remedy.
    """
    robot = load_robot(Path(path), wheels, wheel_radius, track, timestep, regulated=calibrate)
    if robot.falls:
        raise ValueError(f"{path}: {FALLS}.")
    if robot.askew:
        raise ValueError(f"{path}: the axis of {', '.join(robot.askew)} does not lie across the vehicle, so its wheels "
                         "do not roll ahead. Correct the axis in the file, or name the wheels that drive with "
                         "--wheels.")
    host = robot.host
    bounds, entries = _searched(robot, parameters, calibrate)
    # A mass scales its inertia: before an inertia is set by itself.
    entries = dict(sorted(entries.items(), key=lambda one: getattr(one[1], "array", "") != "body_mass"))
    if room_fixed is None:
        world = host.geom_bodyid == 0
        room_fixed = bool((host.geom_type[world] != int(mujoco.mjtGeom.mjGEOM_PLANE)).any())
    params = make_parameters(bounds, room_fixed=room_fixed)
    bare = Stepped(robot, entries).plant()
    plant = with_surroundings(bare, robot.wheel_radius, robot.track, RobotDrive(robot, entries))

    def write(folder: Path, params: Parameters) -> Path:
        return write_mjcf(robot, {entries[name]: float(value) for name, value in params.values.items()
                                  if name in entries}, Path(folder) / "model.xml")

    around = AROUND_ROBOT if calibrate else ()
    def vehicle(params: Parameters, spec: VehicleSpec) -> Twin | str:
        return vehicle_of(robot, entries, params, spec)

    skids = calibrate and len(robot.wheels) > 2
    return Model(robot.path.name, plant, params, write, robot.notes, around, vehicle,
                 partial(skid_vehicle, robot) if skids else None, (Path(path).resolve(),)).with_effects(effects)


def _searched(
    robot: Robot, parameters: Mapping[str, tuple[float, float]] | Sequence[str] | None, calibrate: bool
) -> tuple[dict[str, Bounds], dict[str, Entry | Size]]:
    """Bounds of what is fitted, and its places in the model; arguments as of `mjcf_model`."""
    host, names = robot.host, default_paths(robot) if parameters is None else tuple(parameters)
    bounds: dict[str, Bounds] = {}
    entries: dict[str, Entry | Size] = {}
    sizes = sizes_of(robot, rolling_ratio(robot) if calibrate else 1.0)
    drive = dict[str, tuple[Entry, float, float, float]]()
    if calibrate:
        # Where wheels slip in every turn, the track has no part of its own.
        drive = drive_entries(robot)
        names = (*(one for one in names if not ((robot.added or robot.motors) and one.startswith("actuator."))),
                 *drive, turning_inertia(robot),
                 *(f"geom.{host.geom(geom).name}.friction" for geom in robot.sliding if host.geom_friction[geom, 0]),
                 *(name for name in sizes if len(robot.wheels) == 2 or name != "wheels.track"))
    if robot.motors:
        gain, high = robot.drive_gain
        bounds["drive.kp"] = (gain, gain / 100, high, "N m s/rad")
    for name in names:
        given = parameters[name] if isinstance(parameters, Mapping) else None
        if name == "drive.kp" and robot.motors:
            low, high = given or bounds[name][1:3]
            bounds[name] = ((low * high) ** 0.5, low, high, "N m s/rad")
            continue
        if name in drive:
            entries[name], value, low, high = drive[name]
            bounds[name] = (value, low, high, entries[name].unit)
            continue
        if name in sizes:
            entries[name] = size = sizes[name]
            value = size.nominal
            usual = ((1 - NEAR) * value, (1 + NEAR) * value) if value else (-NEAR, NEAR)
            low, high = given or usual
            bounds[name] = (float(np.clip(value, low, high)), low, high, size.unit)
            continue
        if name in SIZES:
            raise ValueError(f"{robot.path}: {name} cannot be fitted: a driven wheel rolls on something that is no "
                             "sphere, cylinder or capsule. Give it one, or leave this parameter out.")
        entries[name] = entry = resolve(robot, name)
        value = entry.read(host)
        if given is None and value == 0:
            raise ValueError(f"{robot.path}: {name} is 0 in the file, so that its bounds cannot be guessed. Give them: "
                             f"parameters={{{name!r}: (lowest, highest)}}.")
        low, high = sorted((value / FACTOR, value * FACTOR)) if given is None else given
        bounds[name] = (float(np.clip(value, low, high)), low, high, entry.unit)
    return bounds, entries


class Stepped:
    """A robot stepped by MJX, as functions of one instance: what `with_surroundings` takes."""

    def __init__(self, robot: Robot, entries: Mapping[str, Entry | Size]):
        self.robot, self.entries, self.mjx = robot, entries, import_mjx()
        try:
            self.nominal = self.mjx.put_model(robot.host)
        except NotImplementedError as error:
            raise ValueError(f"{robot.path}: MJX cannot step it: {error} Change or remove this in the file.") from None
        self.blank = self.mjx.make_data(self.nominal)
        self.float_type = jnp.result_type(float)
        self.point, self.ahead, self.rest, self.activation, self.sign, self.units = (
            jnp.asarray(one, self.float_type)
            for one in (robot.point, robot.forward, robot.rest, robot.activation, robot.sign, robot.units))
        self.wheels = np.array(robot.wheels)

    def plant(self) -> Plant:
        return Plant(self.place, self.substep, self.observe, float(self.robot.host.opt.timestep), self.move)

    def place(self, params: Parameters, start: jax.Array) -> Motion:
        """The robot at rest on its wheels, moved to a start (5,) and driving."""
        root, speed = self.robot.root, self.robot.speed
        qpos, qvel = self._at(self.rest, jnp.zeros(self.robot.host.nv, self.float_type), start)
        v, omega = start[3], start[4]
        where, heading = self._pose(qpos)
        arm = qpos[root : root + 3] - where
        velocity = jnp.stack([v * jnp.cos(heading) - omega * arm[1], v * jnp.sin(heading) + omega * arm[0], 0 * v])
        inverse = qpos[root + 3 : root + 7] * jnp.array([1.0, -1.0, -1.0, -1.0])
        rate = rotated(inverse, jnp.stack([0 * v, 0 * v, omega]))
        qvel = qvel.at[speed : speed + 3].set(velocity).at[speed + 3 : speed + 6].set(rate)
        qvel = qvel.at[self.wheels].set(self.sign * self._wheel_speeds(v, omega))
        return Motion(qpos, qvel, self.activation, jnp.zeros(self.robot.host.nv, self.float_type))

    def substep(self, params: Parameters, state: Motion, command: jax.Array) -> Motion:
        """The state after one physics step."""
        robot = self.robot
        if shares_results() and _may_abort(robot.host):
            raise ValueError(f"{robot.path}: XLA aborts on contacts of cylinders, boxes and meshes after "
                             "whill_mjx.share_results(). Leave this call out where an own robot is stepped.")
        target = self.sign * self._wheel_speeds(command[0], command[1])
        if robot.motors:
            target = params.values["drive.kp"] * (target - state.qvel[self.wheels])
        ctrl = jnp.zeros(robot.host.nu, self.float_type).at[np.array(robot.actuators)].set(self.units * target)
        if robot.integrals:
            ctrl = ctrl.at[np.array(robot.integrals)].set(self.sign * self._wheel_speeds(command[0], command[1]))
        data = self.blank.replace(qpos=state.qpos, qvel=state.qvel, act=state.act, qacc_warmstart=state.warm, ctrl=ctrl)
        data = self.mjx.step(self._with_values(params), data)
        return Motion(data.qpos, data.qvel, data.act, data.qacc_warmstart)

    def observe(self, state: Motion) -> jax.Array:
        """(5,) x, y, yaw of the reference point, v and omega that the wheels report."""
        where, heading = self._pose(state.qpos)
        left, right = (self.sign * state.qvel[self.wheels] * self.robot.wheel_radius).reshape(2, -1).mean(1)
        return jnp.stack([where[0], where[1], heading, (left + right) / 2, (right - left) / self.robot.track])

    def move(self, state: Motion, start: jax.Array) -> Motion:
        """The same motion at the pose of a start (5,)."""
        qpos, qvel = self._at(state.qpos, state.qvel, start)
        return state.replace(qpos=qpos, qvel=qvel, warm=jnp.zeros_like(state.warm))  # type: ignore[attr-defined]

    def _with_values(self, params: Parameters) -> Any:
        model = self.nominal
        for name, entry in self.entries.items():
            model = model.replace(**entry.changes(model, params.values[name]))
        return model

    def _wheel_speeds(self, v: jax.Array, omega: jax.Array) -> jax.Array:
        half = omega * self.robot.track / 2
        return jnp.stack([v - half, v + half])[self.robot.sides] / self.robot.wheel_radius

    def _pose(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Reference point (3,) and heading ()."""
        root = self.robot.root
        quaternion = qpos[root + 3 : root + 7]
        forward = rotated(quaternion, self.ahead)
        return qpos[root : root + 3] + rotated(quaternion, self.point), jnp.arctan2(forward[1], forward[0])

    def _at(self, qpos: jax.Array, qvel: jax.Array, start: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The motion turned and moved so that the reference point is at the start."""
        root, speed = self.robot.root, self.robot.speed
        where, heading = self._pose(qpos)
        turn = start[2] - heading
        spin = jnp.stack([jnp.cos(turn / 2), 0 * turn, 0 * turn, jnp.sin(turn / 2)])
        arm = rotated(spin, qpos[root : root + 3] - where)
        origin = jnp.stack([start[0] + arm[0], start[1] + arm[1], qpos[root + 2]])
        attitude = quaternion_product(spin, qpos[root + 3 : root + 7])
        qpos = qpos.at[root : root + 3].set(origin).at[root + 3 : root + 7].set(attitude)
        return qpos, qvel.at[speed : speed + 3].set(rotated(spin, qvel[speed : speed + 3]))


def _may_abort(host: mujoco.MjModel) -> bool:
    """Whether XLA aborts on a model's contacts where it shares results: those of cylinders, boxes and meshes."""
    kinds = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH
    touching = (host.geom_contype | host.geom_conaffinity) > 0
    return bool(np.isin(host.geom_type[touching], [int(kind) for kind in kinds]).any())
