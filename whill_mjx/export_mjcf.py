"""Export a vehicle to C MuJoCo: an MJCF file of its rigid bodies, and a callback that evaluates its forces.

    python -m whill_mjx.export_mjcf VEHICLE --out DIR

writes DIR/vehicle.xml, DIR/vehicle.toml and DIR/drive.py, an example. In MuJoCo:

    model = mujoco.MjModel.from_xml_path("vehicle.xml")
    data = mujoco.MjData(model)
    forces = load_forces("vehicle.toml", model)
    forces.place(data)
    mujoco.set_mjcb_control(forces)  # or call forces(model, data) before each mj_step
    data.ctrl[:] = 0.5, 0.3          # v [m/s], omega [rad/s]
    mujoco.mj_step(model, data)

The callback does what `whill_mjx.vehicle.dynamics.forces` does, with the same code compiled for the processor: the
command in data.ctrl passes the effects, drive and ground give a wrench and wheel torques, and they are written to
data.qfrc_applied of the vehicle's own joints. It keeps the memory of the effects (delays, integrals), once per step of
data.time, and the odometry. Two vehicles in one scene need two callbacks, and names of their own.

MuJoCo moves positions with the speed at the end of a step, the simulator with the mean of both ends: paths differ
by about half a step's change of speed. The file's integrator and timestep are part of the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from whill_mjx.io.command_line import PHYSICS_DT, listen, refusing, run, starts

if starts(__name__):
    listen()

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from whill_mjx.effects.base import apply_chain
from whill_mjx.io.folders import new_folder
from whill_mjx.logs.manoeuvres import Scenario, command_table
from whill_mjx.vehicle.config import VehicleConfig
from whill_mjx.vehicle.dynamics import advance_odometry, forces, mass_distribution, nominal_world, place, substep
from whill_mjx.vehicle.kinematics import reference_pose, rotation_from_quaternion
from whill_mjx.vehicle.model import ASSET, VehicleModel, build_model, mujoco_model
from whill_mjx.vehicle.specs import WHILL_CR, VehicleSpec
from whill_mjx.vehicle.types import Odometry, VehicleParams, VehicleState
from whill_mjx.vehicle.vehicle_file import load_vehicle, save_vehicle

TIPPED = 0.8  # rad of tilt from which no vehicle comes back on its wheels
FILES = ("vehicle.xml", "vehicle.toml", "drive.py")
EXAMPLE = '''"""Drives the vehicle in C MuJoCo for ten seconds; prints where it is and where it thinks it is."""

from pathlib import Path

import mujoco

from whill_mjx.export_mjcf import load_forces

FOLDER = Path(__file__).parent

model = mujoco.MjModel.from_xml_path(str(FOLDER / "vehicle.xml"))
data = mujoco.MjData(model)
forces = load_forces(FOLDER / "vehicle.toml", model)
forces.place(data, x=0.0, y=0.0, yaw=0.0)
mujoco.set_mjcb_control(forces)
data.ctrl[:] = 0.5, 0.3  # v [m/s], omega [rad/s]
while data.time < 10.0:
    mujoco.mj_step(model, data)
mujoco.set_mjcb_control(None)
print("x, y [m], yaw [rad]:", *forces.pose(data).round(3))
print("odometry:", forces.odometry)
'''


class VehicleForces:
    """The forces of one vehicle as a control callback of MuJoCo, with the memory of its effects."""

    def __init__(self, spec: VehicleSpec, params: VehicleParams, model: mujoco.MjModel, prefix: str = ""):
        """Look the vehicle up in a compiled model.

        Args:
            spec, params: the vehicle that `vehicle.xml` was exported from.
            model: that file, or a scene that it is part of.
            prefix: of the vehicle's names in the scene.

        Raises:
            ValueError: the model has no such vehicle, or another integrator or timestep than the simulator.
        """
        if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            raise ValueError("the model's integrator is not Euler; the vehicle's controller and delays count steps. "
                             'Set integrator="Euler".')
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
            raise ValueError("the model disables actuation, and MuJoCo then leaves control callbacks out. Remove the "
                             "flag.")
        dt = float(model.opt.timestep)
        self._static = build_model(spec, VehicleConfig(control_dt=dt, physics_dt=dt))
        self._params = params
        try:
            joints = [model.joint(prefix + name) for name in ("root", "left_wheel", "right_wheel")]
            self._ctrl = np.array([model.actuator(prefix + name).id for name in ("v", "omega")])
        except KeyError as error:
            raise ValueError(f"the model has no vehicle of prefix {prefix!r}: {error.args[0]} Export it with "
                             "`python -m whill_mjx.export_mjcf`.") from None
        root, left, right = joints
        self._qpos = np.r_[root.qposadr[0] : root.qposadr[0] + 7, left.qposadr, right.qposadr]
        self._qvel = np.r_[root.dofadr[0] : root.dofadr[0] + 6, left.dofadr, right.dofadr]
        self._advance = jax.jit(_advance, static_argnums=0)
        self._time, self._moved = math.inf, False
        self._before: dict[str, Any] = {}
        self._after: dict[str, Any] = {}

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write the forces of the present state and command into data.qfrc_applied of the vehicle's joints.

        Called again at the same data.time, it repeats itself; when time has gone back, the vehicle starts afresh.
        """
        if data.time < self._time:
            self._before, self._moved = _start(self._static, self._params, data.qvel[self._qvel]), False
        elif data.time > self._time:
            self._before, self._moved = self._after, True
        self._time = data.time
        call = _Call(data.qpos[self._qpos], data.qvel[self._qvel], data.ctrl[self._ctrl], self._moved)
        state, force = self._advance(self._static, self._params, self._before, call)
        self._after = state
        data.qfrc_applied[self._qvel] = np.asarray(force)

    def place(self, data: mujoco.MjData, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, v: float = 0.0,
              omega: float = 0.0) -> None:  # fmt: skip
        """Put the vehicle's reference point at a pose [m, rad], driving at v [m/s] and omega [rad/s], as if new."""
        state = place(self._static, self._params, x, y, yaw, (v, omega))
        data.qpos[self._qpos], data.qvel[self._qvel] = np.asarray(state.qpos), np.asarray(state.qvel)
        self._time = math.inf

    def pose(self, data: mujoco.MjData) -> np.ndarray:
        """x, y [m] and yaw [rad] of the reference point."""
        return np.array(reference_pose(self._static, jnp.asarray(data.qpos[self._qpos])), float)

    @property
    def odometry(self) -> dict[str, float]:
        """What the vehicle reports: x, y [m], yaw [rad], v [m/s], omega [rad/s], gyro [rad/s]."""
        reading = self._after.get("reading")
        return {name: float(getattr(reading, name, 0.0)) for name in ("x", "y", "yaw", "v", "omega", "gyro")}


def load_forces(path: str | Path, model: mujoco.MjModel, prefix: str = "") -> VehicleForces:
    """The callback for a vehicle file; errors as of `load_vehicle` and `VehicleForces`."""
    spec, params, _ = load_vehicle(path)
    return VehicleForces(spec, params, model, prefix)


def vehicle_mjcf(spec: VehicleSpec, params: VehicleParams, physics_dt: float = 0.005) -> str:
    """MJCF of a vehicle: its bodies with their fitted mass distribution, on a floor, with `v` and `omega` as controls.

    Payload and gravity are those of its effects. The controls have no force of their own: the callback reads them.
    The vehicle's shapes touch nothing; contacts of other bodies are on.
    """
    config = VehicleConfig(control_dt=physics_dt, physics_dt=physics_dt)
    model = build_model(spec, config)
    memory = tuple(effect.init() for effect in params.effects)
    _, world = apply_chain(params.effects, memory, "world", nominal_world(model))
    mass, inertia, com = (np.asarray(value, float) for value in mass_distribution(model, params, world))
    host = mujoco_model(spec, config, params.body)
    editable = mujoco.MjSpec.from_file(str(ASSET))
    editable.modelname = spec.name
    editable.option.timestep = physics_dt
    editable.option.gravity = np.asarray(world.gravity, float)
    editable.option.disableflags = 0
    chassis = editable.body("chassis")
    chassis.pos, chassis.mass, chassis.inertia, chassis.ipos = host.body("chassis").pos, float(mass), inertia, com
    for name in ("left_wheel", "right_wheel"):
        editable.body(name).pos = host.body(name).pos
        for geom in editable.body(name).geoms:
            geom.size = [spec.wheel_radius, geom.size[1], 0.0]
        joint = editable.joint(name)
        joint.armature = spec.wheel_inertia * float(world.wheel_inertia)
        limits = (spec.v_min, spec.v_max) if name == "left_wheel" else (-spec.omega_max, spec.omega_max)
        control = editable.add_actuator(name="v" if name == "left_wheel" else "omega", target=name,
                                        trntype=mujoco.mjtTrn.mjTRN_JOINT)
        control.gainprm[0] = 0.0
        control.ctrlrange, control.ctrllimited = limits, True
    editable.compile()
    return str(editable.to_xml())


def export(spec: VehicleSpec, params: VehicleParams, out: Path, physics_dt: float = 0.005) -> Path:
    """Write the folder `out`, whole or not at all; it must not exist."""
    with new_folder(out) as partial:
        (partial / "vehicle.xml").write_text(vehicle_mjcf(spec, params, physics_dt))
        save_vehicle(partial / "vehicle.toml", spec, params, provenance={"made_by": "whill_mjx.export_mjcf"})
        (partial / "drive.py").write_text(EXAMPLE)
    return out


@dataclass(frozen=True)
class Replay:
    """The same drive in C MuJoCo and in the simulator, at every physics step."""

    mujoco: np.ndarray  # (T, 3) x, y [m], yaw [rad] of the reference point
    simulator: np.ndarray  # (T, 3)
    tilt: np.ndarray
    """(T,) of the vehicle against the vertical, the larger of both [rad]."""

    @property
    def upright(self) -> int:
        """Steps until it tips over; all where it does not."""
        fallen = np.flatnonzero(self.tilt > TIPPED)
        return int(fallen[0]) if len(fallen) else len(self.tilt)

    @property
    def distance(self) -> float:
        """Largest distance between the two while the vehicle stands on its wheels [m]."""
        apart = (self.mujoco - self.simulator)[: self.upright, :2]
        return float(np.linalg.norm(apart, axis=1).max(initial=0.0))

    @property
    def turn(self) -> float:
        """Largest difference of the yaw meanwhile [rad]."""
        apart = (self.mujoco - self.simulator)[: self.upright, 2]
        return float(np.abs(np.angle(np.exp(1j * apart))).max(initial=0.0))


def replay(folder: Path, commands: np.ndarray) -> Replay:
    """Drive an exported folder in C MuJoCo and its vehicle in the simulator.

    Args:
        commands: (T, 2) v [m/s] and omega [rad/s] in force in each physics step.
    """
    host = mujoco.MjModel.from_xml_path(str(folder / "vehicle.xml"))
    data = mujoco.MjData(host)
    spec, params, _ = load_vehicle(folder / "vehicle.toml")
    callback = VehicleForces(spec, params, host)
    callback.place(data)
    driven = []
    mujoco.set_mjcb_control(callback)
    try:
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(host, data)
            driven.append(data.qpos.copy())
    finally:
        mujoco.set_mjcb_control(None)
    dt = float(host.opt.timestep)
    model = build_model(spec, VehicleConfig(control_dt=dt, physics_dt=dt))

    def seen(qpos: jax.Array) -> jax.Array:
        """x, y, yaw and tilt."""
        upward = rotation_from_quaternion(qpos[3:7])[2, 2]
        return jnp.stack([*reference_pose(model, qpos), jnp.arccos(jnp.clip(upward, -1.0, 1.0))])

    def one(state: VehicleState, command: jax.Array) -> tuple[VehicleState, jax.Array]:
        state = substep(model, params, state, command)
        return state, seen(state.qpos)

    dtype = jnp.result_type(float)
    limits = host.actuator_ctrlrange  # MuJoCo clips what it is given
    clipped = jnp.asarray(np.clip(commands, limits[:, 0], limits[:, 1]), dtype)
    simulated = jax.jit(lambda c: jax.lax.scan(one, place(model, params, 0.0, 0.0, 0.0), c)[1])(clipped)
    ours, theirs = (np.asarray(one, float) for one in (
        simulated, jax.jit(jax.vmap(seen))(jnp.asarray(np.stack(driven), dtype))))
    return Replay(theirs[:, :3], ours[:, :3], np.maximum(ours[:, 3], theirs[:, 3]))


def held(table: np.ndarray, dt: float) -> np.ndarray:
    """Commands (S, 2) in force in the middle of each step, of a table (T, 3) of t, v, omega."""
    t = (np.arange(math.ceil(table[-1, 0] / dt)) + 0.5) * dt
    return np.asarray(table[np.searchsorted(table[:, 0], t, side="right") - 1, 1:], float)


def _start(model: VehicleModel, params: VehicleParams, qvel: np.ndarray) -> dict[str, Any]:
    """Memory of a vehicle that was never driven, its wheels turning with `qvel` (8,)."""
    zero = jnp.zeros(())
    blank = Odometry(*(zero,) * 6)
    encoder = replace(advance_odometry(blank, jnp.asarray(qvel[6:8], zero.dtype), model), x=zero, y=zero, yaw=zero)
    encoder = replace(encoder, gyro=jnp.asarray(qvel[5], zero.dtype))
    state = place(model, params, 0.0, 0.0, 0.0)
    _, _, motion = forces(model, params, state, jnp.zeros(2))
    memory = tuple(effect.init() for effect in params.effects)
    return {"memory": memory, "encoder": encoder, "reading": encoder, "motion": motion}


class _Call(NamedTuple):
    """What MuJoCo holds when it calls."""

    qpos: jax.Array
    qvel: jax.Array
    command: jax.Array
    moved: bool
    """A step has passed since the call before."""


def _advance(
    model: VehicleModel, params: VehicleParams, before: dict[str, Any], call: _Call
) -> tuple[dict[str, Any], jax.Array]:
    """State after the present call, and qfrc_applied (8,)."""
    dtype, moved = before["encoder"].x.dtype, call.moved
    qpos, qvel, command = (jnp.asarray(value, dtype) for value in call[:3])
    encoder = replace(advance_odometry(before["encoder"], qvel[6:8], model), gyro=qvel[5])
    sensed, reading = apply_chain(params.effects, before["memory"], "sensing", encoder, before["motion"])
    memory, encoder, reading = jax.tree.map(
        lambda new, old: jnp.where(moved, new, old), (sensed, encoder, reading),
        (before["memory"], before["encoder"], before["reading"]))
    state = VehicleState(qpos, qvel, memory, encoder, reading, jnp.zeros((), bool))
    memory, force, motion = forces(model, params, state, command)
    return {"memory": memory, "encoder": encoder, "reading": reading, "motion": motion}, force


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    vehicle: str
    """Vehicle file, or a built-in vehicle."""
    out: Path = Path("runs/mujoco")
    """Folder to write; it must not exist."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]; part of the vehicle, since its controller counts steps."""
    check: bool = True
    """Then drive a figure-eight in C MuJoCo and in the simulator and print how far apart they are."""


def main(options: Options) -> None:
    """Export, check and say what was written."""
    with refusing():
        spec, params, _ = load_vehicle(options.vehicle)
    folder = export(spec, params, options.out, options.physics_dt)
    print(f"wrote {', '.join(str(folder / name) for name in FILES)}")
    if options.check:
        found = replay(folder, held(command_table("figure_eight", in_proportion(spec)), options.physics_dt))
        print(f"figure-eight of {len(found.mujoco) * options.physics_dt:.0f} s: C MuJoCo and the simulator at most "
              f"{1e3 * found.distance:.2f} mm and {1e3 * found.turn:.2f} mrad apart")
        if found.upright < len(found.tilt):
            print(f"the vehicle tips over {found.upright * options.physics_dt:.1f} s into this drive, and both are "
                  "compared until then. Its drives speed up and brake too hard for its size: drive it slowly, or give "
                  "it an acceleration_limit or a lower torque_drive.limit")


def in_proportion(spec: VehicleSpec) -> Scenario:
    """How hard a vehicle of this size is driven: a small one tips over as easily as a large one (Froude number)."""
    slower = math.sqrt(spec.track / WHILL_CR.track)
    usual = Scenario()
    return Scenario(v=min(usual.v * slower, spec.v_max), omega=min(usual.omega / slower, spec.omega_max))


def cli() -> None:
    """Command line."""
    run(Options, main, __doc__)


if __name__ == "__main__":
    cli()
