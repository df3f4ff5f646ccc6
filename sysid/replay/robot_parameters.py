"""Parameters of a robot by dotted paths: where they stand in its model, and how they are written back; and the true
sizes of its driven wheels, which its file only believes."""

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

from sysid.replay.arrays import added
from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import ROUND, parts, touches_ground, tyre_places
from sysid.replay.robot_servos import LAGGING
from whill_mjx.logs.dataset import write_text

SIZES = ("wheels.radius", "wheels.difference", "wheels.track")


@dataclass(frozen=True, eq=False)
class Size:
    """A true size of the driven wheels, which the file only believes: of their round geoms and places."""

    path: str
    """`wheels.radius` or `wheels.track` [m], `wheels.difference` [-], left radius less right one over their mean."""
    unit: str
    nominal: float  # what the file says
    geoms: tuple[tuple[int, ...], ...]  # of each wheel, those on the left first
    bodies: tuple[int, ...]
    rolling: float  # radius on which a wheel rolls over that of its geom: contacts are soft, and wheels sink [-]
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


def sizes_of(robot: Robot, rolling: float = 1.0) -> dict[str, Size]:
    """The true sizes that may be fitted, of round wheels; `rolling`: radius rolled on over that of geoms."""
    host, data = robot.host, mujoco.MjData(robot.host)
    mujoco.mj_kinematics(host, data)
    joints = robot.joints
    bodies = [int(host.jnt_bodyid[joint]) for joint in joints]
    touching = [[int(one) for one in parts(host, body) if touches_ground(host, int(one))] for body in bodies]
    kinds = [int(one) for one in ROUND]
    if not all(geoms and all(int(host.geom_type[one]) in kinds for one in geoms) for geoms in touching):
        return {}
    geoms, half = tuple(tuple(one) for one in touching), len(joints) // 2
    tyres = tyre_places(host, data, joints)
    out = tyres[:half].mean(0) - tyres[half:].mean(0)
    out, up = out / np.linalg.norm(out), np.array([0.0, 0.0, 1.0])
    frames = [data.xmat[host.body_parentid[body]].reshape(3, 3).T for body in bodies]
    raised = tuple(frame @ up for frame in frames)
    apart = tuple(frame @ out * (1 - 2 * side) for frame, side in zip(frames, robot.sides, strict=True))
    radius = max(float(host.geom_size[one, 0]) for one in geoms[0])
    known = (("wheels.radius", "m", radius, raised), ("wheels.difference", "-", 0.0, raised),
             ("wheels.track", "m", robot.distance, apart))
    return {path: Size(path, unit, value, geoms, tuple(map(int, bodies)), rolling, along)
            for path, unit, value, along in known}


def _added(array: Any, index: Any, change: Any) -> Any:
    """As `added`, with NumPy's array left as it is."""
    return added(array if isinstance(array, jax.Array) else np.array(array), index, change)


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
    path: str
    array: str
    rows: tuple[int, ...]
    column: int | None
    unit: str
    ids: tuple[int, ...]  # of the elements that the path names
    servo: tuple[int, ...] = ()  # columns of actuator_biasprm with which a servo pulls back what its gain pulls

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
            ratio = model.actuator_biasprm[rows, column] / model.actuator_gainprm[rows, 0]  # -1, but for <general>
            bias = found.get("actuator_biasprm", model.actuator_biasprm)
            found["actuator_biasprm"] = put(bias, column, value * ratio)
        return found


class Overlaid:
    """A model with some of its arrays replaced."""

    def __init__(self, host: mujoco.MjModel, arrays: dict[str, np.ndarray]):
        self._host, self._arrays = host, arrays

    def __getattr__(self, name: str) -> Any:
        return self._arrays.get(name, getattr(self._host, name))


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
            upright = np.abs(robot.resting.ximat[ids[0]].reshape(3, 3)[2])  # of its principal axes, at rest
            column, unit = int(upright.argmax()), "kg m^2"
    rows = [int(host.jnt_dofadr[one]) for one in ids] if array.startswith("dof_") else ids
    servo: tuple[int, ...] = ()
    if array == "actuator_gainprm" and column == 0:
        pulls = (host.actuator_gainprm[ids, 0] != 0).all()
        servo = tuple(one for one in (1, 2) if pulls and (host.actuator_biasprm[ids, one] != 0).all())
    entry = Entry(path, array, tuple(rows), column, unit, tuple(ids), servo)
    if array == "dof_frictionloss" and (host.dof_frictionloss[rows] <= 0).any():
        raise ValueError(f"{robot.path}: {path} is 0 in the file, and MJX then leaves dry friction out. Give the joint "
                         "a small frictionloss.")
    if array == "actuator_forcerange" and not host.actuator_forcelimited[list(ids)].all():
        raise ValueError(f"{robot.path}: {path} has no limit in the file. Give the actuator a forcerange.")
    return entry


def names_of(host: mujoco.MjModel, kind: str) -> dict[str, int]:
    count = {"body": host.nbody, "geom": host.ngeom, "joint": host.njnt, "actuator": host.nu}[kind]
    found = {mujoco.mj_id2name(host, KINDS[kind], i): i for i in range(count)}
    return {name: i for name, i in found.items() if name and name != "world"}


def default_paths(robot: Robot) -> tuple[str, ...]:
    """Gain and damping of the driven wheels and friction of their tyres, each pair as one pattern where one fits."""
    host = robot.host
    joints = list(robot.joints)
    bodies = host.jnt_bodyid[joints]
    geoms = [max((int(one) for one in parts(host, body) if touches_ground(host, int(one))),
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


def turning_inertia(robot: Robot) -> str:
    """Path of the inertia of the heaviest body: often a placeholder, with the rest of the controller's lag in it."""
    host = robot.host
    heaviest = int(np.where(host.body_rootid == robot.base, host.body_mass, 0.0).argmax())
    return f"body.{host.body(heaviest).name}.inertia"


def drive_entries(robot: Robot) -> dict[str, tuple[Entry, float, float, float]]:
    """Parameters of the controller that a regulated robot got, each with its start and bounds, by the inertia it speeds
    up: lags of up to a second, oscillations of up to 7 Hz, accelerations of up to 30 m/s^2."""
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
