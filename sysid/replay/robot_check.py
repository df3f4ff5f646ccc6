"""What a robot file is understood as, and whether it drives as commanded: for people to look at before a fit."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sysid.replay.robot import Robot
from sysid.replay.robot_contacts import radius_of
from sysid.replay.robot_drive import SECONDS, SPIN, from_rest
from sysid.replay.robot_rest import FALLS

DRAGS = 0.3  # friction of what slides on the floor: a ball or a skid of plastic has less
STRAIGHT = 0.1  # share by which the speed may differ from the command
TURNS = 0.75  # share of the commanded rate on the spot, below which something keeps a robot from turning
DENSE = 20_000.0  # kg/m^3, of the box around a robot: gold
ALIKE = 0.01  # share by which radii of wheels may differ
LIGHT = 0.02  # share of the weight below which what touches the floor is not listed


@dataclass(frozen=True)
class Check:
    """A robot at rest and in two drives of `SECONDS`."""

    loads: dict[str, float]  # share of the weight that each geom on the floor carries
    command: tuple[float, float]  # speed [m/s] and yaw rate [rad/s] that were asked for, one drive each
    speed: float  # along the vehicle where it should drive straight [m/s]
    drift: float  # yaw rate there [rad/s]
    rate: float  # yaw rate where it should turn on the spot [rad/s]
    explodes: bool = False  # whether a speed or place is no longer finite in one of both drives

    @property
    def drives_straight(self) -> bool:
        """Whether it drives within a tenth of the commanded speed, and hardly turns meanwhile."""
        v = self.command[0]
        return not self.explodes and abs(self.speed - v) <= STRAIGHT * v and abs(self.drift) * (SECONDS - 1) < 0.2


def check_robot(robot: Robot) -> Check:
    """Drive a robot straight on and on the spot, each from rest."""
    v = SPIN * robot.wheel_radius
    omega = 2 * v / robot.track / (1 if len(robot.wheels) == 2 else 2)
    second = round(1 / robot.host.opt.timestep)
    seen = from_rest(robot, np.array([[v, 0.0], [0.0, omega]]))
    straight, spot = seen
    yaw = np.unwrap(straight[:, 2])
    step = np.diff(straight[second:, :2], axis=0)
    forward = (step[:, 0] * np.cos(yaw[second:-1]) + step[:, 1] * np.sin(yaw[second:-1])).sum()
    turned = np.unwrap(spot[:, 2])
    took = SECONDS - 1
    return Check(_loads(robot), (v, omega), float(forward / took), float((yaw[-1] - yaw[second]) / took),
                 float((turned[-1] - turned[second]) / took), bool(seen[..., 5].any()))


def _loads(robot: Robot) -> dict[str, float]:
    """Share of the weight on each geom that touches the floor at rest, the largest first."""
    host, data = robot.host, robot.resting
    found: dict[str, float] = {}
    force = np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        ours = [int(geom) for geom in (contact.geom1, contact.geom2) if host.geom_bodyid[geom] != 0]
        if len(ours) != 1 or host.body_rootid[host.geom_bodyid[ours[0]]] != robot.base:
            continue
        mujoco.mj_contactForce(host, data, number, force)
        name = host.geom(ours[0]).name or f"geom {ours[0]}"
        found[name] = found.get(name, 0.0) + float(force[0] * abs(contact.frame[2]))
    total = sum(found.values()) or 1.0
    return dict(sorted(((name, value / total) for name, value in found.items()), key=lambda one: -one[1]))


def describe_robot(robot: Robot, check: Check) -> list[str]:
    """What was understood, as lines of text."""
    host = robot.host
    count, half = len(robot.wheels), len(robot.wheels) // 2
    kind = "differential drive, two driven wheels" if count == 2 else f"skid-steered, {count} driven wheels"
    lines = [f"{robot.path.name}: {kind}, {float(host.body_subtreemass[robot.base]):.4g} kg",
             f"  wheel radius {robot.wheel_radius:.4g} m, track {robot.distance:.4g} m"]
    if count > 2:
        lines[-1] += f", wheelbase {np.ptp(robot.resting.xanchor[list(robot.joints)] @ robot.axes[0]):.4g} m"
    names = [host.joint(joint).name for joint in robot.joints]
    lines += [f"  left: {', '.join(names[:half])}; right: {', '.join(names[half:])}; front: {_front(robot)}",
              f"  driven by {_drive(robot)}"]
    lines += ["", "On the floor, at rest"]
    lines += [f"  {name}: {share:.0%} of the weight" for name, share in check.loads.items() if share >= LIGHT]
    lines += ["", "Trial drives in C MuJoCo",
              f"  straight on at {check.command[0]:.3g} m/s: {check.speed / check.command[0]:.1%} of the commanded "
              f"speed, turning {np.degrees(check.drift):+.2f} degrees/s",
              f"  on the spot at {check.command[1]:.3g} rad/s: {check.rate / check.command[1]:.1%} of the commanded "
              "rate"]
    if count > 2:
        lines.append("  How far it turns follows from how its wheels slide: a fit takes a vehicle of the simulator in "
                     "place of these contacts.")
    missing = [*robot.notes, *_missing(robot, check)]
    return [*lines, "", "Missing, replaced or odd", *(f"  {one}" for one in missing or ["nothing"])]


def _drive(robot: Robot) -> str:
    if robot.added:
        return "velocity servos that were added"
    return "motors with an added speed controller" if robot.motors else "the file's velocity servos"


def _missing(robot: Robot, check: Check) -> list[str]:
    found = []
    host, wheels = robot.host, set(robot.host.jnt_bodyid[list(robot.joints)].tolist())
    carried = sum(share for name, share in check.loads.items()
                  if int(host.body_weldid[host.geom_bodyid[host.geom(name).id]]) in
                  {int(host.body_weldid[body]) for body in wheels})
    if (density := _density(robot)) > DENSE:
        found.append(f"it is as heavy as {density:.2g} kg in each cubic metre around it: masses are in kg, not in "
                     "grams")
    if carried < 0.3:
        found.append(f"the driven wheels carry {carried:.0%} of the weight: they may spin. Check the heights of "
                     "casters and wheels, and the centre of mass")
    if check.explodes:
        found.append("it explodes in a trial drive: a servo is too stiff for its wheel where it slips, or a contact "
                     "is. Take a smaller timestep or gain, or the integrator implicitfast")
    elif robot.falls:
        found.append(f"{FALLS}. No fit takes it so")
    elif check.speed < -STRAIGHT * check.command[0]:
        found.append("it drives backwards: what turns its wheels pulls against the command. Check the signs of gear "
                     "and gain of the actuators, and couplings of their joints")
    elif not check.drives_straight:
        found.append("it does not drive straight on within a tenth of the commanded speed: " + (
            "; ".join((*_limits(robot, check.command[0]), *_drags(robot))) or "check axes of the wheels and friction"))
    if len(robot.wheels) == 2 and check.drives_straight and check.rate < TURNS * check.command[1]:
        names = [name for name in check.loads if int(host.geom_bodyid[host.geom(name).id]) not in wheels]
        cause = _coupled(robot) or (f"{', '.join(names)} drag sideways. A caster must swivel or slide" if names else
                                    "check the friction of the wheels")
        found.append(f"on the spot it reaches only {check.rate / check.command[1]:.0%} of the commanded rate: {cause}")
    return found


def _density(robot: Robot) -> float:
    """Mass over the volume of the box around a robot's geoms [kg/m^3]."""
    host = robot.host
    mine = host.body_rootid[host.geom_bodyid] == robot.base
    place, size = robot.resting.geom_xpos[mine], host.geom_rbound[mine, None]
    volume = float(np.prod((place + size).max(0) - (place - size).min(0)))
    return float(host.body_subtreemass[robot.base]) / max(volume, 1e-12)


def _limits(robot: Robot, v: float) -> list[str]:
    """What of the driven wheels' joints and actuators may keep a robot from a speed [m/s]."""
    host, joints = robot.host, robot.joints
    found = [f"the axis of joint {name} does not lie across the vehicle (URDF's default is 1 0 0)"
             for name in robot.askew]
    radii = [radius_of(robot.path, host, int(host.jnt_bodyid[one]), robot.wheel_radius) for one in joints]
    if max(radii) > (1 + ALIKE) * min(radii):
        found.append("the radii of its wheels differ: " + ", ".join(
            f"{host.joint(one).name} {radius:.4g} m" for one, radius in zip(joints, radii, strict=True)))
    for joint in joints:
        if host.jnt_actfrclimited[joint]:
            found.append(f"joint {host.joint(joint).name} gives at most {host.jnt_actfrcrange[joint, 1]:.3g} N m "
                         "(effort, or actuatorfrcrange)")
    of_file = zip(robot.actuators, joints, robot.units, strict=True) if not robot.motors and not robot.added else ()
    for one, joint, unit in of_file:
        called = host.actuator(one).name
        gain, damping = -host.actuator_biasprm[one, 2] * host.actuator_gear[one, 0] ** 2, host.dof_damping[
            host.jnt_dofadr[joint]]
        if damping > STRAIGHT * gain:
            found.append(f"actuator {called} (kv {gain:.3g} N m s/rad) is held back by a damping of "
                         f"{damping:.3g} of joint {host.joint(joint).name}: it reaches {gain / (gain + damping):.0%} "
                         "of its speed")
        most = float(np.abs(host.actuator_ctrlrange[one] / unit).max())
        if host.actuator_ctrllimited[one] and most * robot.wheel_radius < v:
            found.append(f"actuator {called} takes at most {most:.3g} rad/s of its wheel (ctrlrange), which is "
                         f"{most * robot.wheel_radius:.3g} m/s")
    return found


def _drags(robot: Robot) -> list[str]:
    """What slides on the floor with so much friction that wheels pull against it."""
    host, data = robot.host, robot.resting
    friction: dict[int, float] = {}
    for contact in data.contact[: data.ncon]:
        for geom in {int(contact.geom1), int(contact.geom2)} & set(robot.sliding):
            friction[geom] = float(contact.friction[0]) if contact.dim > 1 else 0.0
    return [f"{host.geom(geom).name} slides on the floor with a friction of {value:.2g} (of two geoms that touch the "
            'larger one counts, unless one has a higher priority: give it priority="1")'
            for geom, value in friction.items() if value > DRAGS]


def _coupled(robot: Robot) -> str:
    """A sentence on driven wheels of both sides that a mimic joint lets turn only together; else empty."""
    host, joints = robot.host, robot.joints
    for number in range(host.neq):
        ends = {int(host.eq_obj1id[number]), int(host.eq_obj2id[number])}
        if host.eq_type[number] == mujoco.mjtEq.mjEQ_JOINT and ends == set(joints):
            names = " and ".join(host.joint(joint).name for joint in joints)
            return f"joints {names} are coupled (mimic). Leave the coupling out"
    return ""


def _front(robot: Robot) -> str:
    """Which way it drives by its file, in the axes of the body that moves freely."""
    axis = int(np.abs(robot.forward).argmax())
    return ("+" if robot.forward[axis] > 0 else "-") + "xyz"[axis]
