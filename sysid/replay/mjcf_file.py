"""The file of a differential drive: what of it drives, where its parameters stand, and how it is written back."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from sysid.replay.robot_files import read_robot
from sysid.replay.wheels import wheel_joints
from whill_mjx.io.fields import Field, check
from whill_mjx.logs.dataset import write_text
from whill_mjx.vehicle.model import import_mjx

TIMESTEP = Field("option timestep", "s", 1e-5, 0.1, remedy="Give the model an option timestep such as 0.002.")
ROUND = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE)
STIFF = 10.0  # of its friction over that of its contacts (impratio): wheels creep by 0.05 %, with 1 by 0.4 %
SETTLE = 1.0  # s in which the model comes to rest on the ground before it is driven
SERVO_TIME = 0.005  # s in which the servos that a model without actuators gets follow a change of speed
SLIDING = 0.05  # friction of what a URDF lets slide on the floor: mostly the ball of a caster, without its bearing
FIRM_TIME, FIRM, ALONE = [0.01, 1.0], [0.99, 0.99, 0.001, 0.5, 2.0], 1e3
"""solref, solimp and solmix of wheels that a file says nothing of. With MuJoCo's own, one of 33 mm sinks by 0.4 mm, and
rolls as if its radius were 0.6 % smaller."""
URDF_STEP = 0.0025  # s; a URDF states none
WATER = 1000.0  # kg/m^3, of a link without a mass, as MuJoCo has it
DEEP = 0.2  # of the wheel radius below the driven wheels: no caster stands there
LEVEL = 0.01  # of its distance from the axle by which a support is raised where others stand on the other side
SKID_SHARE = 1.0
"""The same where wheels skid in every turn: heavy ones hold their speed while their contacts find how they slide."""
ROTOR_SHARE = 0.25
"""Of the inertia that it speeds up, which a wheel with such a servo has at least by itself: geared motors have as much.
MuJoCo finds contact forces as if wheels turned freely. With a servo that is integrated implicitly it then moves a
vehicle up to 90 ms ahead of its wheels, so the servo's torque is explicit, and a wheel that slips must be heavy."""
LAGGING = 10.0  # 1/s^2, integral gain over the load of a wheel with which a controller starts: it takes half a second
STRONG = 30.0  # m/s^2, acceleration at the limit of a drive whose limit is not known
REST_SPEED = 1.0  # m/s; a model that is faster after SETTLE falls, rolls away or shakes
FIELDS = {  # KIND, FIELD -> array of the model, column, unit
    ("body", "mass"): ("body_mass", None, "kg"),
    **{("body", f"com_{axis}"): ("body_ipos", i, "m") for i, axis in enumerate("xyz")},
    **{("body", f"inertia_{axis}"): ("body_inertia", i, "kg m^2") for i, axis in enumerate("xyz")},
    **{("geom", name): ("geom_friction", i, unit) for i, (name, unit) in enumerate(
        (("friction", "-"), ("friction_torsional", "m"), ("friction_rolling", "m")))},
    ("geom", "radius"): ("geom_size", 0, "m"),
    ("joint", "damping"): ("dof_damping", None, "N m s/rad"),
    ("joint", "armature"): ("dof_armature", None, "kg m^2"),
    ("joint", "frictionloss"): ("dof_frictionloss", None, "N m"),
    ("joint", "stiffness"): ("jnt_stiffness", None, "N m/rad"),
    ("joint", "force_limit"): ("jnt_actfrcrange", 1, "N m"),
    ("actuator", "gain"): ("actuator_gainprm", 0, "-"),
    ("actuator", "force_limit"): ("actuator_forcerange", 1, "N m"),
}
KINDS = {"body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM, "joint": mujoco.mjtObj.mjOBJ_JOINT,
         "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR}


PREFIXES = {"body": "body", "geom": "geom", "dof": "joint", "jnt": "joint", "actuator": "actuator"}
"""Of arrays, and the KIND of what their rows are."""
LIMITS = ("actuator_forcerange", "jnt_actfrcrange")  # the same either way


@dataclass(frozen=True)
class Entry:
    """Where a parameter stands in the model."""

    path: str
    array: str
    rows: tuple[int, ...]
    column: int | None
    unit: str
    ids: tuple[int, ...]
    """Of the elements that the path names."""
    servo: tuple[int, ...] = ()
    """Columns of actuator_biasprm with which a servo pulls back what its gain pulls."""

    @property
    def kind(self) -> str:
        """KIND of what it changes."""
        return PREFIXES[self.array.partition("_")[0]]

    def read(self, model: Any) -> float:
        """Its value, of the first element."""
        values = np.asarray(getattr(model, self.array))
        return float(values[self.rows[0]] if self.column is None else values[self.rows[0], self.column])

    def changes(self, model: Any, value: Any) -> dict[str, Any]:
        """Arrays of a model, of NumPy or JAX, with the value put in."""
        rows = np.array(self.rows)

        def put(array: Any, column: int | None, value: Any) -> Any:
            index: Any = rows if column is None else (rows, column)
            if isinstance(array, jax.Array):
                return array.at[index].set(value)
            array = np.array(array)
            array[index] = value
            return array

        found = {self.array: put(getattr(model, self.array), self.column, value)}
        if self.array == "body_mass":
            scale = (value / model.body_mass[rows])[:, None]
            found["body_inertia"] = put(model.body_inertia, None, model.body_inertia[rows] * scale)
        if self.array == "body_inertia" and self.path.endswith(".inertia"):
            scale = (value / model.body_inertia[rows, self.column])[:, None]
            found[self.array] = put(model.body_inertia, None, model.body_inertia[rows] * scale)
        if self.array in LIMITS:
            found[self.array] = put(found[self.array], 0, -value)
        for column in self.servo:
            found["actuator_biasprm"] = put(found.get("actuator_biasprm", model.actuator_biasprm), column, -value)
        return found


@dataclass(frozen=True, eq=False)
class Size:
    """A true size of the driven wheels, which the file only believes: of their round geoms and places."""

    path: str
    """`wheels.radius` or `wheels.track` [m], `wheels.difference` [-], left radius less right one over their mean."""
    unit: str
    nominal: float
    """What the file says."""
    geoms: tuple[tuple[int, ...], ...]
    """Of each wheel, those on the left first."""
    bodies: tuple[int, ...]
    rolling: float
    """Radius on which a wheel rolls over that of its geom: contacts are soft, and wheels sink [-]."""
    along: tuple[np.ndarray, ...]
    """(3,) in the frames of the wheels' parents: a wheel that grows rises, a track that grows moves it outwards."""

    def changes(self, model: Any, value: Any) -> dict[str, Any]:
        """Arrays of a model, of NumPy or JAX, with the value put in; what rolls on the floor stays on it."""
        half = (value - self.nominal) / 2
        signs = np.repeat([1, -1], len(self.bodies) // 2)
        move = {"wheels.track": half, "wheels.radius": 2 * half}.get(self.path, half * self._radius(model))
        place = model.body_pos
        for body, sign, along in zip(self.bodies, signs, self.along, strict=True):
            place = _added(place, body, move * along * (sign if self.path == "wheels.difference" else 1))
        if self.path == "wheels.track":
            return {"body_pos": place}
        size, reach = model.geom_size, model.geom_rbound  # beyond its reach a geom meets nothing
        for sign, geoms in zip(signs, self.geoms, strict=True):
            factor = value / self.nominal / self.rolling if self.path == "wheels.radius" else 1 + sign * half
            for geom in geoms:
                reach = _added(reach, geom, abs(factor - 1) * size[geom, 0])
                size = _added(size, (geom, 0), (factor - 1) * size[geom, 0])
        return {"body_pos": place, "geom_size": size, "geom_rbound": reach}

    def _radius(self, model: Any) -> Any:
        return model.geom_size[self.geoms[0][0], 0]

    def read(self, model: Any) -> float:
        """What the file says."""
        return self.nominal


def _added(array: Any, index: Any, change: Any) -> Any:
    if isinstance(array, jax.Array):
        return array.at[index].add(change)
    array = np.array(array)
    array[index] += change
    return array


@dataclass(frozen=True)
class Robot:
    """A compiled differential drive and where its parts are."""

    path: Path
    spec: Any
    """The editable mujoco.MjSpec."""
    host: mujoco.MjModel
    root: int
    """Address of the free joint in qpos."""
    speed: int
    """Address of the free joint in qvel."""
    wheels: tuple[int, ...]
    """Addresses of the driven wheels in qvel: one to three on the left, then as many on the right."""
    actuators: tuple[int, ...]
    sign: tuple[float, ...]
    """1 where a positive speed of the joint drives forwards."""
    motors: bool
    """The actuators take a torque, and not a speed."""
    drive_gain: tuple[float, float]
    """Gain of a speed controller before motors, and the highest stable one [N m s/rad over the motor's gain]."""
    point: np.ndarray  # (3,) middle between the driven wheels, root's frame
    forward: np.ndarray  # (3,) root's frame
    wheel_radius: float
    track: float
    rest: np.ndarray  # qpos after SETTLE
    added: tuple[int, ...] = ()
    """Actuators that the file does not have."""
    sliding: tuple[int, ...] = ()
    """Geoms that stand on the floor and neither turn nor swivel."""
    distance: float = 0.0
    """Between the driven wheels, as the file says [m]."""
    notes: tuple[str, ...] = ()
    """What was left out of the file."""
    integrals: tuple[int, ...] = ()
    """Actuators that take the same targets and pull by how far their wheels lag behind; none, or one for each wheel."""
    spin: float = 0.0
    """Inertia of a driven wheel, motor included [kg m^2]."""
    load: float = 0.0
    """Inertia that it speeds up, its share of the vehicle's included [kg m^2]."""

    @property
    def joints(self) -> tuple[int, ...]:
        """Those of the driven wheels."""
        return tuple(int(self.host.dof_jntid[wheel]) for wheel in self.wheels)

    @property
    def activation(self) -> np.ndarray:
        """(na,) of actuators with a memory, at rest: no wheel lags behind."""
        found = np.zeros(self.host.na)
        for one, joint in zip(self.integrals, self.joints, strict=False):
            found[self.host.actuator_actadr[one]] = self.rest[self.host.jnt_qposadr[joint]]
        return found

    @property
    def sides(self) -> np.ndarray:
        """(W,) 0 for each driven wheel on the left, then 1 for each on the right."""
        return np.repeat([0, 1], len(self.wheels) // 2)


def load_robot(
    path: Path, wheels: Sequence[str] = (), wheel_radius: float | None = None, track: float | None = None,
    timestep: float | None = None, regulated: bool = False,
) -> Robot:
    """Read, complete and compile a differential drive; errors as of `sysid.replay.mjcf.mjcf_model`.

    `regulated`: its wheels are driven as by the controller of a usual robot, with an integral part and a limit.
    """
    try:
        spec, replaced, stated = read_robot(path, wheels, wheel_radius)
        joints = wheel_joints(path, spec, wheels)
        if stated is not None:
            if len(joints) == 2:  # the file has none
                spec.option.impratio, spec.option.cone = STIFF, mujoco.mjtCone.mjCONE_ELLIPTIC
            replaced += _as_in_gazebo(path, spec, joints)
            spec.option.timestep = URDF_STEP
        _complete(path, spec, joints)
        if timestep is not None:
            spec.option.timestep = timestep
        check(str(path), TIMESTEP, float(spec.option.timestep))
        host = spec.compile()
        data = mujoco.MjData(host)
        mujoco.mj_kinematics(host, data)
        ids = [host.joint(name).id for name in joints]
        bodies = [int(host.jnt_bodyid[one]) for one in ids]
        radius = _wheel_radius(path, host, bodies[0]) if wheel_radius is None else wheel_radius
        inertias = [_wheel_inertias(host, one, radius, len(ids)) for one in ids]
        bare = _add_servos(spec, joints, inertias)
        if regulated and _is_stable(host, joints, inertias):
            spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if regulated:
            _regulate(spec, host, joints, inertias, float(radius))
        if bare or regulated:
            host = spec.compile()
            data = mujoco.MjData(host)
            mujoco.mj_kinematics(host, data)
        if not (host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)).any():
            bottom = float(data.xpos[bodies[0], 2]) - _wheel_radius(path, host, bodies[0], radius)
            spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, bottom],
                                    friction=[0, 0, 0])  # MuJoCo takes the larger one of two geoms
            host = spec.compile()
            data = mujoco.MjData(host)
            mujoco.mj_kinematics(host, data)
        if stated is not None and (low := _below_wheels(path, host, data, bodies, radius)):
            for name in low:
                spec.geom(name).conaffinity = 0
            replaced += list(low.values())
            host = spec.compile()
        notes = _leave_out_contacts(path, spec, host)
        if notes:
            host = spec.compile()
            data = mujoco.MjData(host)
            mujoco.mj_kinematics(host, data)
    except (ValueError, KeyError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        text = str(error).strip()
        raise ValueError(text if text.startswith(str(path)) else f"{path}: MuJoCo cannot use it: {text}. Correct the "
                         "model.") from None
    half = len(ids) // 2
    left = data.xanchor[ids[:half]].mean(0) - data.xanchor[ids[half:]].mean(0)
    distance = float(np.linalg.norm(left))
    left = left / distance
    forward = np.cross(left, [0.0, 0.0, 1.0])
    free = int(host.body_jntadr[host.body_rootid[bodies[0]]])
    rotation = data.xmat[host.body_rootid[bodies[0]]].reshape(3, 3).copy()  # the data moves on
    middle = data.xanchor[ids].mean(0) - data.xpos[host.body_rootid[bodies[0]]]
    sign = tuple(float(np.sign(data.xaxis[one] @ left)) for one in ids)
    actuators = tuple(int(np.flatnonzero(host.actuator_trnid[:, 0] == one)[0]) for one in ids)
    root, speed, turning = int(host.jnt_qposadr[free]), int(host.jnt_dofadr[free]), _numbers(host.jnt_dofadr[ids])
    _settle(path, host, data, speed, turning, float(radius))
    sliding = _sliding(host, data, int(host.body_rootid[bodies[0]]))
    if stated is not None:
        raised = _raise_supports(path, host, data, spec, sliding, bodies)
        if raised:
            replaced += raised
            mujoco.mj_resetData(host, data)
            _settle(path, host, data, speed, turning, float(radius))
            sliding = _sliding(host, data, int(host.body_rootid[bodies[0]]))
    inertias = [_wheel_inertias(host, one, float(radius), len(ids)) for one in ids]
    if stated is not None:
        for geom in sliding:
            friction = min(stated.get(host.body(host.geom_bodyid[geom]).name, SLIDING), 1.0)
            host.geom_friction[geom, 0] = friction
            spec.geom(host.geom(geom).name).friction[0] = friction
    return Robot(path, spec, host, root, speed, turning, actuators, sign,
                 _are_motors(path, host, actuators), _drive_gain(host, actuators, inertias), rotation.T @ middle,
                 rotation.T @ forward, float(radius), distance if track is None else track, data.qpos.copy(),
                 tuple(actuators[one] for one in bare), sliding, distance, (*replaced, *notes),
                 _integrals(host, ids), *(float(one) for one in np.mean(inertias, axis=0)))


def _sliding(host: mujoco.MjModel, data: mujoco.MjData, root: int) -> tuple[int, ...]:
    """Geoms fixed to the vehicle's main body that touch the world at rest."""
    pairs = [(int(one.geom1), int(one.geom2)) for one in data.contact[: data.ncon]]
    touching = {geom for pair in pairs for geom in pair if any(host.geom_bodyid[other] == 0 for other in pair)}
    return tuple(sorted(geom for geom in touching if host.body_weldid[host.geom_bodyid[geom]] == root))


def _raise_supports(
    path: Path, host: mujoco.MjModel, data: mujoco.MjData, spec: Any, sliding: Sequence[int], bodies: Sequence[int],
) -> list[str]:  # fmt: skip
    """Raise what slides before and behind the axle: at one height with the driven wheels it would share their load as
    the stiffness of the contacts has it, where a real vehicle has springs or a gap. A note where it was done."""
    axle = data.xpos[list(bodies)].mean(0)
    place = (data.geom_xpos[list(sliding)] - axle).reshape(-1, 3)
    ahead = place @ data.xmat[host.body_rootid[bodies[0]]].reshape(3, 3)[:, 0]
    if not (ahead > 0).any() or not (ahead < 0).any():
        return []
    for geom, distance in zip(sliding, np.abs(ahead), strict=True):
        up = data.xmat[host.geom_bodyid[geom]].reshape(3, 3).T @ np.array([0.0, 0.0, LEVEL * distance])
        host.geom_pos[geom] += up
        host.geom_sameframe[geom] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        spec.geom(host.geom(geom).name).pos = host.geom_pos[geom]
    return [f"{path.name}: {', '.join(host.geom(one).name for one in sliding)} are raised by up to "
            f"{1000 * LEVEL * np.abs(ahead).max():.2g} mm: they stand before and behind the axle, at the height of the "
            "driven wheels"]


def _settle(path: Path, host: mujoco.MjModel, data: Any, speed: int, wheels: tuple[int, ...], radius: float) -> None:
    """Let the model come to rest on its floor, without a command; ValueError where it does not."""
    remedy = "Check its contacts, the gains and inertias of its wheels, and its timestep."
    faults = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    steps = round(SETTLE / host.opt.timestep)
    fastest = 0.0
    for step in range(steps):
        mujoco.mj_step(host, data)
        if any(data.warning[int(fault)].number for fault in faults) or not np.isfinite(data.qpos).all():
            raise ValueError(f"{path}: the model explodes while it settles on its floor, after "
                             f"{(step + 1) * host.opt.timestep:.3f} s (a position, speed or acceleration is not "
                             f"finite or huge). {remedy}")
        if step >= 0.8 * steps:  # a wheel that shakes passes through 0
            rims = np.abs(data.qvel[list(wheels)]) * radius
            fastest = max(fastest, float(np.linalg.norm(data.qvel[speed : speed + 3])), *map(float, rims))
    if fastest > REST_SPEED:
        raise ValueError(f"{path}: after {SETTLE:g} s on its floor, without a command, the model still moves at "
                         f"{fastest:.3g} m/s (at most {REST_SPEED:g}): it falls, rolls away or shakes. {remedy}")


SIZES = ("wheels.radius", "wheels.difference", "wheels.track")


def sizes_of(robot: Robot, rolling: float = 1.0) -> dict[str, Size]:
    """The true sizes that may be fitted; none where a wheel rolls on something that is not round.

    `rolling` is the radius on which wheels roll over that of their geoms.
    """
    host, data = robot.host, mujoco.MjData(robot.host)
    mujoco.mj_kinematics(host, data)
    joints = [int(np.flatnonzero(host.jnt_dofadr == wheel)[0]) for wheel in robot.wheels]
    bodies = [int(host.jnt_bodyid[joint]) for joint in joints]
    touching = [[int(one) for one in _parts(host, body) if _touches_ground(host, int(one))] for body in bodies]
    kinds = [int(one) for one in ROUND]
    if not all(geoms and all(int(host.geom_type[one]) in kinds for one in geoms) for geoms in touching):
        return {}
    geoms, half = tuple(tuple(one) for one in touching), len(joints) // 2
    out = data.xanchor[joints[:half]].mean(0) - data.xanchor[joints[half:]].mean(0)
    out, up = out / np.linalg.norm(out), np.array([0.0, 0.0, 1.0])
    frames = [data.xmat[host.body_parentid[body]].reshape(3, 3).T for body in bodies]
    raised = tuple(frame @ up for frame in frames)
    apart = tuple(frame @ out * (1 - 2 * side) for frame, side in zip(frames, robot.sides, strict=True))
    radius = max(float(host.geom_size[one, 0]) for one in geoms[0])
    known = (("wheels.radius", "m", radius, raised), ("wheels.difference", "-", 0.0, raised),
             ("wheels.track", "m", robot.distance, apart))
    return {path: Size(path, unit, value, geoms, _numbers(bodies), rolling, along)
            for path, unit, value, along in known}


def resolve(robot: Robot, path: str) -> Entry:
    """Where a dotted path leads; ValueError names what is known."""
    kind, _, rest = path.partition(".")
    host = robot.host
    parts = rest.split(".")
    if kind not in KINDS or len(parts) < 2:
        raise ValueError(f"{robot.path}: parameter {path!r} is not KIND.NAME.FIELD with KIND one of "
                         f"{', '.join(KINDS)}; write for example body.base.mass.")
    numbered = parts[-1].isdigit() and len(parts) > 2
    pattern, field = ".".join(parts[: -2 if numbered else -1]), parts[-2 if numbered else -1]
    known = names_of(host, kind)
    ids = [number for name, number in known.items()
           if any(name == one or fnmatchcase(name, one) for one in (pattern, *pattern.split("|")))]
    if not ids:
        raise ValueError(f"{robot.path}: no {kind} {pattern!r} (known: {', '.join(known)}). Correct {path!r}.")
    array, column, unit = FIELDS.get((kind, field), (f"{kind}_{field}", None, "-"))
    if (kind, field) not in FIELDS:
        values = getattr(host, array, None)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
            fields = [name for one, name in FIELDS if one == kind]
            raise ValueError(f"{robot.path}: {kind} has no field {field!r} (known: {', '.join(fields)}, or an array "
                             f"{kind}_NAME of mjx.Model). Correct {path!r}.")
        column = int(parts[-1]) if numbered else 0 if values.ndim > 1 else None
        if (kind, field) == ("body", "inertia") and not numbered:
            column, unit = _upright(robot, ids[0]), "kg m^2"
    rows = [int(host.jnt_dofadr[one]) for one in ids] if array.startswith("dof_") else ids
    servo: tuple[int, ...] = ()
    if array == "actuator_gainprm" and column == 0:
        servo = tuple(one for one in (1, 2) if (host.actuator_biasprm[ids, one] != 0).all())
    entry = Entry(path, array, tuple(rows), column, unit, tuple(ids), servo)
    if array == "dof_frictionloss" and (host.dof_frictionloss[rows] <= 0).any():
        raise ValueError(f"{robot.path}: {path} is 0 in the file, and MJX then leaves dry friction out. Give the joint "
                         "a small frictionloss.")
    if array == "actuator_forcerange" and not host.actuator_forcelimited[list(ids)].all():
        raise ValueError(f"{robot.path}: {path} has no limit in the file. Give the actuator a forcerange.")
    return entry


def _upright(robot: Robot, body: int) -> int:
    """Principal axis of a body that is the most upright at rest."""
    data = mujoco.MjData(robot.host)
    data.qpos[:] = robot.rest
    mujoco.mj_kinematics(robot.host, data)
    return int(np.abs(data.ximat[body].reshape(3, 3)[2]).argmax())


def turning_inertia(robot: Robot) -> str:
    """Path of the inertia of the vehicle's heaviest body: robot files often have a placeholder there, and the rest of
    its controller's lag shows in turns."""
    host = robot.host
    root = host.body_rootid[host.jnt_bodyid[robot.joints[0]]]
    heaviest = int(np.where(host.body_rootid == root, host.body_mass, 0.0).argmax())
    return f"body.{host.body(heaviest).name}.inertia"


def names_of(host: mujoco.MjModel, kind: str) -> dict[str, int]:
    """Elements of a kind by name."""
    count = {"body": host.nbody, "geom": host.ngeom, "joint": host.njnt, "actuator": host.nu}[kind]
    found = {mujoco.mj_id2name(host, KINDS[kind], i): i for i in range(count)}
    return {name: i for name, i in found.items() if name and name != "world"}


def write_mjcf(robot: Robot, values: Mapping[Entry | Size, float], path: Path) -> Path:
    """Write the completed model with values put in, whole or not at all."""
    host, spec = robot.host, robot.spec.copy()
    arrays: dict[str, np.ndarray] = {}
    for entry, value in values.items():
        view: Any = Overlaid(host, arrays)
        arrays.update(entry.changes(view, value))
    for entry in values:
        if isinstance(entry, Size):
            _put_size(spec, entry, Overlaid(host, arrays))
            continue
        for number in entry.ids:
            _put(spec, entry, number, Overlaid(host, arrays))
    spec.compile()
    write_text(path, spec.to_xml())
    return path


class Overlaid:
    """A model with some of its arrays replaced."""

    def __init__(self, host: mujoco.MjModel, arrays: dict[str, np.ndarray]):
        self._host, self._arrays = host, arrays

    def __getattr__(self, name: str) -> Any:
        return self._arrays.get(name, getattr(self._host, name))


def _put_size(spec: Any, entry: Size, model: Any) -> None:
    for body in entry.bodies:
        spec.body(mujoco.mj_id2name(model._host, KINDS["body"], body)).pos = model.body_pos[body]
    for geom in (one for geoms in entry.geoms for one in geoms):
        spec.geom(mujoco.mj_id2name(model._host, KINDS["geom"], geom)).size[0] = model.geom_size[geom, 0]


def _put(spec: Any, entry: Entry, number: int, model: Any) -> None:
    """Set one element of the editable model to what the compiled one says."""
    kind = entry.kind
    name = mujoco.mj_id2name(model._host, KINDS[kind], number)
    element = {"body": spec.body, "geom": spec.geom, "joint": spec.joint, "actuator": spec.actuator}[kind](name)
    if kind == "body" and entry.array in ("body_mass", "body_ipos", "body_inertia"):
        element.explicitinertial = True
        element.mass = float(model.body_mass[number])
        element.ipos, element.iquat = model.body_ipos[number], model.body_iquat[number]
        element.inertia = model.body_inertia[number]
        element.fullinertia = np.full(6, np.nan)
        return
    arrays = (entry.array, "actuator_biasprm") if entry.array == "actuator_gainprm" else (entry.array,)
    for array in arrays:
        row = entry.rows[entry.ids.index(number)]
        values, field = np.asarray(getattr(model, array))[row], array.partition("_")[2]
        held = getattr(element, field)
        if isinstance(held, np.ndarray):
            held[: values.size] = values.reshape(-1)[: held.size]
        else:
            setattr(element, field, float(values))


def _complete(path: Path, spec: Any, joints: Sequence[str]) -> None:
    """Give the model a free joint and names to its bodies and geoms, where it has none."""
    spec.compiler.fusestatic = False
    named = {body.name for body in spec.bodies}
    for k, body in enumerate(spec.bodies):
        if not body.name:
            body.name = next(name for name in (f"body_{k}", f"body_{k}_unnamed") if name not in named)
    top = next(body for body in spec.bodies if any(joint.name == joints[0] for joint in body.joints))
    while top.parent.name != "world":
        top = top.parent
    if not len(top.joints):
        top.add_freejoint()
    elif top.joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError(f"{path}: body {top.name!r} hangs on joint {top.joints[0].name!r}; a vehicle moves freely. "
                         "Give it a freejoint, or no joint.")
    for body in spec.bodies:
        taken = {geom.name for geom in spec.geoms}
        for k, geom in enumerate(body.geoms):
            plain = body.name if k == 0 else f"{body.name}_{k}"
            if not geom.name and plain and plain not in taken:
                geom.name = plain


def _below_wheels(
    path: Path, host: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int], radius: float,
) -> dict[str, str]:  # fmt: skip
    """Geoms that reach so far below the driven wheels that these would hang in the air, with a note for each: mostly
    boxes that stand in for meshes."""
    floor = min(float(data.xpos[body, 2]) for body in bodies) - radius
    wheels = {int(host.body_weldid[body]) for body in bodies}
    found = {}
    for geom in range(host.ngeom):
        if host.geom_bodyid[geom] == 0 or int(host.body_weldid[host.geom_bodyid[geom]]) in wheels or not (
                host.geom_contype[geom] | host.geom_conaffinity[geom]):
            continue
        turn, reach = data.geom_xmat[geom].reshape(3, 3), host.geom_aabb[geom, 3:]
        round_one = int(host.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_SPHERE)
        down = float(reach[0] if round_one else np.abs(turn[2]) @ reach)
        low = floor - (float(data.geom_xpos[geom, 2] + turn[2] @ host.geom_aabb[geom, :3]) - down)
        if low > DEEP * radius:
            name = host.geom(geom).name
            found[name] = (f"{path.name}: {name} reaches {low:.3g} m below the driven wheels: its contacts are left "
                           "out")
    return found


def _as_in_gazebo(path: Path, spec: Any, joints: Sequence[str]) -> list[str]:
    """What a URDF leaves to its simulator, a note for each change.

    Wheels roll on the middle of their width, as spheres: a stiff cylinder stands on its two edges, scrubs in every turn
    and turns as if the outer edges were its track. Parts of one robot do not touch each other. Joints with an end, of
    arms, heads and suspensions, are held: their motors and springs are not in the file. A driven wheel is held at its
    speed, whatever its bearing.
    """
    notes = []
    driven = {joint.parent.name for joint in spec.joints if joint.name in joints}
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = 0, 1
        if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER and geom.parent.name in driven:
            if not geom.parent.explicitinertial:
                geom.mass = WATER * 2 * np.pi * geom.size[0] ** 2 * geom.size[1]
            geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [geom.size[0], 0.0, 0.0]
            geom.solref, geom.solimp, geom.solmix = FIRM_TIME, FIRM, ALONE
    for joint in list(spec.joints):
        if joint.name in joints:
            if np.any(joint.frictionloss) or np.any(joint.damping):
                notes.append(f"{path.name}: friction and damping of joint {joint.name} are left out: an added servo "
                             "would make up for them")
            joint.frictionloss = 0.0
            joint.damping = np.zeros_like(joint.damping)
        elif joint.type == mujoco.mjtJoint.mjJNT_SLIDE or (
                joint.type == mujoco.mjtJoint.mjJNT_HINGE and np.ptp(joint.range)):
            notes.append(f"{path.name}: joint {joint.name} is held at 0: the file has no motor or spring for it")
            spec.delete(joint)
    return notes


def _leave_out_contacts(path: Path, spec: Any, host: mujoco.MjModel) -> tuple[str, ...]:
    """Exclude contacts that MJX lacks between parts of one robot, a note for each; ValueError for others."""
    import_mjx()
    from mujoco.mjx._src.collision_driver import geom_pairs, has_collision_fn

    left_out: dict[tuple[str, str], str] = {}
    for one, other, declared in geom_pairs(host):
        kinds = [int(host.geom_type[geom]) for geom in (one, other)]
        if has_collision_fn(*kinds):  # type: ignore[arg-type]
            continue
        shapes = [mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds]
        geoms = " and ".join(f"geom {mujoco.mj_id2name(host, KINDS['geom'], int(geom)) or geom!r} ({shape})"
                             for geom, shape in zip((one, other), shapes, strict=True))
        bodies = [int(host.geom_bodyid[geom]) for geom in (one, other)]
        if declared >= 0 or 0 in bodies or host.body_rootid[bodies[0]] != host.body_rootid[bodies[1]]:
            raise ValueError(f"{path}: MJX has no contact between {geoms}. Replace one by a sphere, capsule or box, or "
                             "let their contype and conaffinity keep them apart.")
        names = sorted(mujoco.mj_id2name(host, KINDS["body"], body) for body in bodies)
        left_out.setdefault((names[0], names[1]), f"{path.name}: MJX has no contact between {geoms}; contacts between "
                            f"their bodies {names[0]} and {names[1]} are left out")
    for first, second in left_out:
        spec.add_exclude(name=f"{first}_{second}_left_out", bodyname1=first, bodyname2=second)
    return tuple(left_out.values())


def _add_servos(spec: Any, joints: Sequence[str], inertias: Sequence[tuple[float, float]]) -> list[int]:
    """Give velocity servos to wheels without actuators; numbers of these wheels.

    Their gain follows from the inertia that a wheel has to speed up, its share of the vehicle's included, so that all
    vehicles follow within the same time. MuJoCo softens a contact with the inverse inertia of what touches: a wheel
    without a motor's rotor would creep.
    """
    bare = [k for k, joint in enumerate(joints) if not any(one.target == joint for one in spec.actuators)]
    share = ROTOR_SHARE if len(joints) == 2 else SKID_SHARE
    time = max(SERVO_TIME, spec.option.timestep / share)
    for k in bare:
        actuator = spec.add_actuator(name=joints[k], target=joints[k], trntype=mujoco.mjtTrn.mjTRN_JOINT)
        wheel, total = inertias[k]
        actuator.set_to_velocity(kv=total / time)
        joint = spec.joint(joints[k])
        joint.armature += max(share * total - wheel, 0.0)
    if bare:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return bare


def _regulate(
    spec: Any, host: mujoco.MjModel, joints: Sequence[str], inertias: Sequence[tuple[float, float]], radius: float,
) -> None:  # fmt: skip
    """Give wheels without one an integral part beside their servo or motor, and a limit of what both pull together.

    The integral part takes the same targets: torque = ki (integral of the target - angle of the wheel). A usual
    controller of a robot's wheels is of this kind. Its gain starts where it hardly acts.
    """
    for name, (_, total) in zip(joints, inertias, strict=True):
        joint = spec.joint(name)
        mine = [one for one in spec.actuators if one.target == name]
        if not any(one.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR for one in mine):
            actuator = spec.add_actuator(name=f"{name}_integral", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_intvelocity(kp=total * LAGGING)
            actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if not host.jnt_actfrclimited[host.joint(name).id]:
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
            limit = min(_motor_limit(host, host.joint(name).id), total * STRONG / radius)
            joint.actfrcrange = [-limit, limit]


def _is_stable(host: mujoco.MjModel, joints: Sequence[str], inertias: Sequence[tuple[float, float]]) -> bool:
    """Whether wheels that slip are stable under the torques of their actuators at the start of a step."""
    gains = [float(-host.actuator_biasprm[host.actuator_trnid[:, 0] == host.joint(name).id, 2].min(initial=0.0))
             for name in joints]
    return all(gain * host.opt.timestep <= wheel for gain, (wheel, _) in zip(gains, inertias, strict=True))


def _motor_limit(host: mujoco.MjModel, joint: int) -> float:
    """Largest torque of the file's motor on a joint; infinite where it has none."""
    found = float("inf")
    for one in np.flatnonzero(host.actuator_trnid[:, 0] == joint):
        gear, gain = abs(host.actuator_gear[one, 0]), abs(host.actuator_gainprm[one, 0])
        if host.actuator_forcelimited[one]:
            found = min(found, gear * float(np.abs(host.actuator_forcerange[one]).max()))
        if host.actuator_ctrllimited[one] and host.actuator_biastype[one] == int(mujoco.mjtBias.mjBIAS_NONE):
            found = min(found, gear * gain * float(np.abs(host.actuator_ctrlrange[one]).max()))
    return found


def _integrals(host: mujoco.MjModel, joints: Sequence[int]) -> tuple[int, ...]:
    """Actuators with an integral part on these joints; none where one lacks it."""
    integrator = host.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
    found = [np.flatnonzero((host.actuator_trnid[:, 0] == joint) & integrator) for joint in joints]
    return tuple(int(one[0]) for one in found) if all(len(one) for one in found) else ()


def drive_entries(robot: Robot) -> dict[str, tuple[Entry, float, float, float]]:
    """Parameters of the controller that a regulated robot got, each with its start and bounds.

    All follow from the inertia that a wheel speeds up: lags of up to a second, oscillations of up to 7 Hz, and
    accelerations of up to 30 m/s^2.
    """
    host, load, both = robot.host, robot.load, robot.integrals
    found = {}
    if robot.added:
        ids = tuple(robot.added)
        kp = Entry("drive.kp", "actuator_gainprm", ids, 0, "N m s/rad", ids, (2,))
        high = robot.spin / host.opt.timestep  # a wheel that slips is stable
        found["drive.kp"] = (kp, min(load / 0.1, high / 2), load / 1.0, high)
    if both:
        ki = Entry("drive.ki", "actuator_gainprm", both, 0, "N m/rad", both, (1,))
        found["drive.ki"] = (ki, LAGGING * load, 0.3 * load, 2000.0 * load)
        limit = Entry("drive.limit", "jnt_actfrcrange", robot.joints, 1, "N m", robot.joints)
        high = limit.read(host)
        found["drive.limit"] = (limit, high, high / 100, high * 1.001)
    return found


def _wheel_inertias(host: mujoco.MjModel, joint: int, radius: float, count: int) -> tuple[float, float]:
    """Inertia about a wheel's axle [kg m^2]: of the wheel alone, and with its share of a vehicle on `count` wheels."""
    body = int(host.jnt_bodyid[joint])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, host.body_iquat[body])
    axis = turn.reshape(3, 3).T @ host.jnt_axis[joint]
    wheel = float(axis**2 @ host.body_inertia[body] + host.dof_armature[host.jnt_dofadr[joint]])
    return wheel, wheel + float(host.body_subtreemass[host.body_rootid[body]]) * radius**2 / count


def _drive_gain(
    host: mujoco.MjModel, actuators: Sequence[int], inertias: Sequence[tuple[float, float]],
) -> tuple[float, float]:  # fmt: skip
    """Gain of a speed controller before motors, and the highest with which a wheel in the air is stable.

    The controller's torque is computed before a step, so it may take away at most a wheel's whole speed in one.
    """
    wheel, total = (min(one) for one in zip(*inertias, strict=True))
    motor = max(abs(float(host.actuator_gear[one, 0] * host.actuator_gainprm[one, 0])) for one in actuators) or 1.0
    time = max(SERVO_TIME, 2 * host.opt.timestep)
    high = wheel / host.opt.timestep
    return min(total / time, high / 2) / motor, high / motor


def _wheel_radius(path: Path, host: mujoco.MjModel, body: int, known: float | None = None) -> float:
    """Radius of the largest round geom of a wheel, of those that may touch the ground if one is round."""
    round_ones = [int(one) for one in _parts(host, body) if int(host.geom_type[one]) in map(int, ROUND)]
    touching = [one for one in round_ones if _touches_ground(host, one)]
    sizes = [float(host.geom_size[one, 0]) for one in touching or round_ones]
    if not sizes and known is None:
        raise ValueError(f"{path}: the wheel has no sphere, cylinder or capsule to give its radius. Give wheel_radius.")
    return max(sizes) if sizes else float(known or 0.0)


def _parts(host: mujoco.MjModel, body: int) -> np.ndarray:
    """Geoms of a body and of all that is fixed to it."""
    return np.flatnonzero(host.body_weldid[host.geom_bodyid] == host.body_weldid[body])


def _touches_ground(host: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom may touch a plane of the world, or any geom where there is none: a visual one does not."""
    ground = np.flatnonzero((host.geom_bodyid == 0) & (host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)))
    if not len(ground):
        return bool(host.geom_contype[geom] | host.geom_conaffinity[geom])
    masks = host.geom_contype[geom] & host.geom_conaffinity[ground]
    return bool((masks | host.geom_contype[ground] & host.geom_conaffinity[geom]).any())


def _are_motors(path: Path, host: mujoco.MjModel, actuators: Sequence[int]) -> bool:
    """Whether the wheels' actuators take a torque; ValueError where they take neither that nor a speed."""
    ids = list(actuators)
    bias = host.actuator_biasprm[ids]
    if (host.actuator_biastype[ids] == int(mujoco.mjtBias.mjBIAS_NONE)).all():
        return True
    if (bias[:, 1] == 0).all() and (bias[:, 2] < 0).all() and (host.actuator_dyntype[ids] == 0).all():
        return False
    raise ValueError(f"{path}: the wheels' actuators are neither motors nor velocity servos. Use <motor> or "
                     "<velocity>.")


def default_paths(robot: Robot) -> tuple[str, ...]:
    """Gain and damping of the driven wheels and friction of their tyres, each pair as one pattern where one fits."""
    host = robot.host
    joints = [int(np.flatnonzero(host.jnt_dofadr == wheel)[0]) for wheel in robot.wheels]
    bodies = host.jnt_bodyid[joints]
    geoms = [max((int(one) for one in _parts(host, body) if _touches_ground(host, int(one))),
                 key=lambda one: host.geom_rbound[one], default=None) for body in bodies]
    if any(one is None for one in geoms):
        raise ValueError(f"{robot.path}: a driven wheel has no geom that touches the ground (contype and conaffinity). "
                         "Give it one.")
    found = []
    for kind, ids, field in (("actuator", robot.actuators, "gain"), ("joint", joints, "damping"),
                             ("geom", geoms, "friction")):
        names = [mujoco.mj_id2name(host, KINDS[kind], one) for one in ids]
        pattern = _pattern(names, names_of(host, kind))
        together = ["|".join(names)] if len(names) > 2 else names  # all wheels of a skid drive share one value
        for name in together if pattern is None else [pattern]:
            path = f"{kind}.{name}.{field}"
            if resolve(robot, path).read(host) != 0:
                found.append(path)
    return tuple(found)


def _pattern(names: Sequence[str], known: Mapping[str, int]) -> str | None:
    """One pattern that matches these names and no other."""
    side = names[0].lower().find("left") if len(names) == 2 else -1
    start = names[0][:side] if side >= 0 else os.path.commonprefix(list(names))
    end = names[0][side + 4 :] if side >= 0 else os.path.commonprefix([name[len(start):][::-1] for name in names])[::-1]
    pattern = f"{start}*{end}"
    return pattern if {name for name in known if fnmatchcase(name, pattern)} == set(names) else None


def _numbers(values: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    return tuple(int(value) for value in values)
