"""What of a robot touches what: wheels and floor, and contacts that are left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from whill_mjx.vehicle.model import import_mjx

ROUND = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE)
FIRM_TIME, FIRM, ALONE = [0.01, 1.0], [0.99, 0.99, 0.001, 0.5, 2.0], 1e3
"""solref, solimp and solmix of wheels that a file says nothing of. With MuJoCo's own, one of 33 mm sinks by 0.4 mm, and
rolls as if its radius were 0.6 % smaller."""
WATER = 1000.0  # kg/m^3, of a link without a mass, as MuJoCo has it
ROLLED = 1.02  # between two radii of a wheel, beyond which only the larger one touches the floor
DEEP = 0.2  # of the wheel radius below the driven wheels: no caster stands there


def parts(host: mujoco.MjModel, body: int) -> np.ndarray:
    """Geoms of a body and of all that is fixed to it."""
    return np.flatnonzero(host.body_weldid[host.geom_bodyid] == host.body_weldid[body])


def touches_ground(host: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom may touch a plane of the world, or any geom where there is none: a visual one does not."""
    ground = np.flatnonzero((host.geom_bodyid == 0) & (host.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)))
    if not len(ground):
        return bool(host.geom_contype[geom] | host.geom_conaffinity[geom])
    masks = host.geom_contype[geom] & host.geom_conaffinity[ground]
    return bool((masks | host.geom_contype[ground] & host.geom_conaffinity[geom]).any())


def radius_of(path: Path, host: mujoco.MjModel, body: int, known: float | None = None) -> float:
    """Radius of the largest round geom of a wheel that may touch the ground; else how far its shapes reach."""
    round_ones = [int(one) for one in parts(host, body) if int(host.geom_type[one]) in map(int, ROUND)]
    touching = [one for one in round_ones if touches_ground(host, one)]
    sizes = [float(host.geom_size[one, 0]) for one in touching or round_ones]
    if sizes or known is not None:
        return max(sizes) if sizes else float(known or 0.0)
    reach = reach_of(host, body)
    if reach == 0.0:
        raise ValueError(f"{path}: wheel {host.body(body).name} has no shape that gives its radius. Give it a cylinder "
                         "or a sphere, or wheel_radius.")
    return reach


def reach_of(host: mujoco.MjModel, body: int) -> float:
    """How far the shapes of a wheel, and of rollers on it, reach from its axle [m]; 0 without any."""
    data = mujoco.MjData(host)
    mujoco.mj_kinematics(host, data)
    return float(_outline(host, data, int(host.body_jntadr[body]), _shapes(host, body))[:, 1].max(initial=0.0))


def tyre_places(host: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[int]) -> np.ndarray:
    """Where wheels (W, 3) touch the floor along their axles: the middle of what reaches as far as any, on the axle.

    CAD programs put a joint at the chassis's side as often as in the wheel's middle.
    """
    places = np.array(data.xanchor[list(joints)])
    for place, joint in zip(places, joints, strict=True):
        shapes = _shapes(host, int(host.jnt_bodyid[joint]))
        touching = [one for one in shapes if touches_ground(host, one)]
        along, reach = _outline(host, data, joint, touching or shapes).T
        if len(along):
            outermost = along[ROLLED * reach >= reach.max()]
            place += (outermost.min() + outermost.max()) / 2 * data.xaxis[joint]
    return places


def _shapes(host: mujoco.MjModel, body: int) -> list[int]:
    """Geoms of a body and of all that hangs on it."""
    found = []
    for geom in range(host.ngeom):
        over = int(host.geom_bodyid[geom])
        while over not in (0, body):
            over = int(host.body_parentid[over])
        if over == body:
            found.append(geom)
    return found


def _outline(host: mujoco.MjModel, data: mujoco.MjData, joint: int, geoms: Sequence[int]) -> np.ndarray:
    """Points (K, 2) of geoms: where they are along a joint's axle, from its anchor, and how far they reach from it."""
    found, axis = [np.zeros((0, 2))], data.xaxis[joint]
    for geom in geoms:
        away = data.geom_xpos[geom] + corners(host, geom) @ data.geom_xmat[geom].reshape(3, 3).T - data.xanchor[joint]
        along = away @ axis
        margin = float(host.geom_size[geom, 0]) if int(host.geom_type[geom]) in map(int, ROUND) else 0.0
        found.append(np.column_stack([along, np.linalg.norm(away - np.outer(along, axis), axis=1) + margin]))
    return np.concatenate(found)


def corners(host: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points (K, 3) of a geom in its frame: a mesh's vertices, a box's corners, a ball's middle, an ellipsoid's
    surface."""
    kind, mesh = int(host.geom_type[geom]), int(host.geom_dataid[geom])
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        first = int(host.mesh_vertadr[mesh])
        return np.asarray(host.mesh_vert[first : first + int(host.mesh_vertnum[mesh])], float)
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], float)
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        around, up = (one.ravel() for one in np.meshgrid(np.arange(0, 360, 10), np.arange(-90, 91, 10)))
        flat = np.cos(np.radians(up))
        signs = np.column_stack([flat * np.cos(np.radians(around)), flat * np.sin(np.radians(around)),
                                 np.sin(np.radians(up))])
    size = np.array(host.geom_size[geom], float)
    if kind in map(int, ROUND):
        size = np.array([0.0, 0.0, 0.0 if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE) else size[1]])
    return signs * size


def as_round_wheels(path: Path, spec: Any, host: mujoco.MjModel, bodies: Sequence[int]) -> list[str]:
    """Let wheels of a URDF that are meshes, boxes or rollers roll as spheres that reach as far, a note for each."""
    notes, data = [], mujoco.MjData(host)
    mujoco.mj_kinematics(host, data)
    for body in bodies:
        joint = int(host.body_jntadr[body])
        shapes = [int(host.geom_type[one]) for one in np.flatnonzero(host.geom_bodyid == body)]
        radius, one = reach_of(host, body), spec.body(host.body(body).name)
        solid = max((float(host.geom_size[geom, 0]) for geom in np.flatnonzero(host.geom_bodyid == body)
                     if int(host.geom_type[geom]) in map(int, ROUND)), default=0.0)
        rollers = radius > ROLLED * solid and any(joint.parent.name != one.name for joint in one.find_all("joint"))
        if solid > 0.0 and not rollers or radius == 0.0:
            continue
        if not one.explicitinertial:
            one.explicitinertial, one.mass, one.ipos = True, host.body_mass[body], host.body_ipos[body]
            one.iquat, one.inertia = host.body_iquat[body], host.body_inertia[body]
        along = float((tyre_places(host, data, [joint])[0] - data.xanchor[joint]) @ data.xaxis[joint])
        for geom in list(one.geoms):
            spec.delete(geom)
        for geom in one.find_all("geom"):
            geom.contype, geom.conaffinity = 0, 0
        place = host.jnt_pos[joint] + along * host.jnt_axis[joint]
        one.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0.0, 0.0], contype=0, conaffinity=1, mass=0.0,
                     pos=place, solref=FIRM_TIME, solimp=FIRM, solmix=ALONE, name=one.name)
        what = "has rollers, which are left out" if rollers else "is no cylinder or sphere" if shapes else (
            "has its shape on another link")
        notes.append(f"{path.name}: wheel {one.name} {what}: it rolls on the {radius:.4g} m by which it reaches from "
                     "its axle")
    return notes


def lowest(host: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height of the lowest point of a geom, or of the box around it [m]."""
    up, half = data.geom_xmat[geom].reshape(3, 3)[2], host.geom_aabb[geom, 3:]
    down = half[0] if int(host.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_SPHERE) else np.abs(up) @ half
    return float(data.geom_xpos[geom, 2] + up @ host.geom_aabb[geom, :3] - down)


def below_wheels(
    path: Path, host: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int], radius: float,
) -> dict[str, str]:  # fmt: skip
    """Geoms that reach so far below the driven wheels that these would hang in the air; a note for each."""
    floor = min(float(data.xpos[body, 2]) for body in bodies) - radius
    wheels = {int(host.body_weldid[body]) for body in bodies}
    found = {}
    for geom in range(host.ngeom):
        if host.geom_bodyid[geom] == 0 or int(host.body_weldid[host.geom_bodyid[geom]]) in wheels or not (
                host.geom_contype[geom] | host.geom_conaffinity[geom]):
            continue
        low = floor - lowest(host, data, geom)
        if low > DEEP * radius:
            name = host.geom(geom).name
            found[name] = (f"{path.name}: {name} reaches {low:.3g} m below the driven wheels: its contacts are left "
                           "out")
    return found


def as_in_gazebo(path: Path, spec: Any, joints: Sequence[str]) -> list[str]:
    """What a URDF leaves to its simulator, a note for each change.

    Wheels roll on the middle of their width, as spheres: a stiff cylinder stands on its two edges and scrubs in every
    turn. Parts of one robot do not touch each other. Joints with an end are held: their motors and springs are not in
    the file.
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
            continue
        if joint.type == mujoco.mjtJoint.mjJNT_SLIDE or (
                joint.type == mujoco.mjtJoint.mjJNT_HINGE and np.ptp(joint.range)):
            notes.append(f"{path.name}: joint {joint.name} is held at 0: the file has no motor or spring for it")
            spec.delete(joint)
    return notes


def leave_out_contacts(path: Path, spec: Any, host: mujoco.MjModel) -> tuple[str, ...]:
    """Exclude contacts that MJX lacks, of parts of one robot and of obstacles, with notes; ValueError for others."""
    import_mjx()
    from mujoco.mjx._src.collision_driver import geom_pairs, has_collision_fn

    left_out: dict[tuple[str, str], str] = {}
    for one, other, declared in geom_pairs(host):
        kinds = [int(host.geom_type[geom]) for geom in (one, other)]
        if has_collision_fn(*kinds):  # type: ignore[arg-type]
            continue
        shapes = [mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in kinds]
        geoms = " and ".join(f"geom {host.geom(int(geom)).name or geom!r} ({shape})"
                             for geom, shape in zip((one, other), shapes, strict=True))
        bodies = [int(host.geom_bodyid[geom]) for geom in (one, other)]
        if declared < 0 and 0 in bodies and not _under(host, obstacle := int((one, other)[bodies.index(0)]), bodies):
            spec.geom(host.geom(obstacle).name).contype = spec.geom(host.geom(obstacle).name).conaffinity = 0
            left_out[("", host.geom(obstacle).name)] = (
                f"{path.name}: MJX has no contact between {geoms}; the obstacle's contacts are left out")
            continue
        if declared >= 0 or 0 in bodies or host.body_rootid[bodies[0]] != host.body_rootid[bodies[1]]:
            raise ValueError(f"{path}: MJX has no contact between {geoms}. Replace one by a sphere, capsule or box, or "
                             "let their contype and conaffinity keep them apart.")
        names = sorted(host.body(body).name for body in bodies)
        left_out.setdefault((names[0], names[1]), f"{path.name}: MJX has no contact between {geoms}; contacts between "
                            f"their bodies {names[0]} and {names[1]} are left out")
    for first, second in filter(lambda names: names[0], left_out):
        spec.add_exclude(name=f"{first}_{second}_left_out", bodyname1=first, bodyname2=second)
    return tuple(left_out.values())


def _under(host: mujoco.MjModel, ground: int, bodies: Sequence[int]) -> bool:
    """Whether the vertical line through a robot's start meets the box around a geom of the world.

    The axes of a mesh are those of its inertia, of which any may be the vertical one.
    """
    data = mujoco.MjData(host)
    mujoco.mj_kinematics(host, data)
    root = max(int(host.body_rootid[body]) for body in bodies)
    turn, middle, half = data.geom_xmat[ground].reshape(3, 3), host.geom_aabb[ground, :3], host.geom_aabb[ground, 3:]
    place, up = (data.xpos[root] - data.geom_xpos[ground]) @ turn - middle, turn[2]
    up = np.where(np.abs(up) < 1e-9, 1e-9, up)
    ends = np.sort(np.stack([-half - place, half - place]) / up, axis=0)  # heights at which it enters and leaves
    return bool(ends[0].max() < ends[1].min())
