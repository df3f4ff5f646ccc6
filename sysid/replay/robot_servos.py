"""What turns a robot's wheels: servos and motors of its file, and those that it gets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

SERVO_TIME = 0.005  # s in which the servos that a model without actuators gets follow a change of speed
SKID_SHARE = 1.0
"""As `ROTOR_SHARE`, where wheels skid in every turn: heavy ones hold their speed while contacts find how they slide."""
ROTOR_SHARE = 0.25
"""Of the inertia that it speeds up, which a wheel with such a servo has at least by itself: geared motors have as much.
MuJoCo finds contact forces as if wheels turned freely. With a servo that is integrated implicitly it then moves a
vehicle up to 90 ms ahead of its wheels, so the servo's torque is explicit, and a wheel that slips must be heavy."""
LAGGING = 10.0  # 1/s^2, integral gain over the load of a wheel with which a controller starts: it takes half a second
STRONG = 30.0  # m/s^2, acceleration at the limit of a drive whose limit is not known


def wheel_inertias(host: mujoco.MjModel, joint: int, radius: float, count: int) -> tuple[float, float]:
    """Inertia about a wheel's axle [kg m^2]: of the wheel alone, and with its share of a vehicle on `count` wheels."""
    body = int(host.jnt_bodyid[joint])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, host.body_iquat[body])
    axis = turn.reshape(3, 3).T @ host.jnt_axis[joint]
    wheel = float(axis**2 @ host.body_inertia[body] + host.dof_armature[host.jnt_dofadr[joint]])
    return wheel, wheel + float(host.body_subtreemass[host.body_rootid[body]]) * radius**2 / count


def drop_others(path: Path, spec: Any, joints: Sequence[str]) -> list[str]:
    """Remove the wheels' actuators that take neither torque nor speed or are on tendons, and sensors; with notes."""
    notes = []
    turned = {one.name for one in spec.tendons if any(wrap.target is not None and wrap.target.name in joints
                                                      for wrap in one.path)}
    for one in list(spec.actuators):
        on_tendon = one.trntype == mujoco.mjtTrn.mjTRN_TENDON
        motor = one.biastype == mujoco.mjtBias.mjBIAS_NONE
        speed = one.biasprm[1] == 0 and one.biasprm[2] < 0 or one.dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        lags = one.dyntype not in (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_INTEGRATOR)
        damps = one.gaintype != mujoco.mjtGain.mjGAIN_FIXED
        if on_tendon or (one.target in joints and (lags or damps or not motor and not speed)):
            what = (f"acts on tendon {one.target}" if on_tendon else "has a filter or a muscle" if lags else
                    "pulls by a law of its own" if damps else f"holds an angle of {one.target}")
            instead = "nothing" if on_tendon and one.target not in turned else "servos on the wheels"
            notes.append(f"{path.name}: actuator {_called(one)} {what}: {instead} stands in for it"
                         .replace("wheels stands", "wheels stand"))
            spec.delete(one)
    left = [one for one in spec.actuators if one.target in joints]
    plain = {one.target for one in left if one.dyntype != mujoco.mjtDyn.mjDYN_INTEGRATOR}
    if left and plain != set(joints):
        why = "sum up a speed" if not plain else "are not on all of the wheels"
        notes.append(f"{path.name}: actuators {', '.join(map(_called, left))} {why}: servos on the wheels stand in "
                     "for them")
        for one in left:
            spec.delete(one)
    remaining = {one.name for one in spec.actuators}
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname not in remaining:
            spec.delete(sensor)
    return notes


def _called(actuator: Any) -> str:
    """Name of an actuator, else of what it acts on."""
    what = "tendon" if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON else "joint"
    return actuator.name or f"of {what} {actuator.target}"


def add_servos(
    path: Path, spec: Any, joints: Sequence[str], inertias: Sequence[tuple[float, float]],
) -> tuple[list[int], list[str]]:  # fmt: skip
    """Give velocity servos to wheels without actuators; numbers of these wheels, and a note on each bearing left out.

    Gains follow from the inertia that a wheel has to speed up, so that all vehicles follow within the same time. A
    contact is softened by the inverse inertia of what touches: a wheel without a rotor would creep. A bearing's
    friction and damping would hold a servo below its target.
    """
    bare, notes = [k for k, joint in enumerate(joints) if not any(one.target == joint for one in spec.actuators)], []
    for joint in (spec.joint(joints[k]) for k in bare):
        if np.any(joint.frictionloss) or np.any(joint.damping):
            notes.append(f"{path.name}: friction and damping of joint {joint.name} are left out: an added servo would "
                         "make up for them")
        joint.frictionloss, joint.damping = 0.0, np.zeros_like(joint.damping)
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
    return bare, notes


def regulate(
    spec: Any, host: mujoco.MjModel, joints: Sequence[str], inertias: Sequence[tuple[float, float]], radius: float,
) -> None:  # fmt: skip
    """Give wheels without one an integral part beside their servo or motor, and a limit of what both pull together.

    As usual controllers have: torque = ki (integral of the target - angle of the wheel). It starts where it hardly
    acts.
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


def is_stable(host: mujoco.MjModel, joints: Sequence[str], inertias: Sequence[tuple[float, float]]) -> bool:
    """Whether wheels that slip are stable under the torques of their actuators at the start of a step."""
    stiff = -host.actuator_biasprm[:, 2] * host.actuator_gear[:, 0] ** 2  # at the joint
    gains = [float(stiff[host.actuator_trnid[:, 0] == host.joint(name).id].max(initial=0.0)) for name in joints]
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


def integrals(host: mujoco.MjModel, joints: Sequence[int]) -> tuple[int, ...]:
    """Actuators with an integral part on these joints; none where one lacks it."""
    integrator = host.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
    found = [np.flatnonzero((host.actuator_trnid[:, 0] == joint) & integrator) for joint in joints]
    return tuple(int(one[0]) for one in found) if all(len(one) for one in found) else ()


def drive_gain(
    host: mujoco.MjModel, actuators: Sequence[int], inertias: Sequence[tuple[float, float]],
) -> tuple[float, float]:  # fmt: skip
    """Gain of a speed controller before motors, and the highest with which a wheel in the air is stable: computed
    before a step, its torque may take away at most a wheel's whole speed in one."""
    wheel, total = (min(one) for one in zip(*inertias, strict=True))
    motor = max(abs(float(host.actuator_gear[one, 0] * host.actuator_gainprm[one, 0])) for one in actuators) or 1.0
    time = max(SERVO_TIME, 2 * host.opt.timestep)
    high = wheel / host.opt.timestep
    return min(total / time, high / 2) / motor, high / motor


def are_motors(path: Path, host: mujoco.MjModel, actuators: Sequence[int]) -> bool:
    """Whether the wheels' actuators take a torque; ValueError where they take neither that nor a speed."""
    ids = list(actuators)
    bias = host.actuator_biasprm[ids]
    if (host.actuator_biastype[ids] == int(mujoco.mjtBias.mjBIAS_NONE)).all():
        return True
    pulls = (host.actuator_gainprm[ids, 0] != 0).all()
    if pulls and (bias[:, 1] == 0).all() and (bias[:, 2] < 0).all() and (host.actuator_dyntype[ids] == 0).all():
        return False
    raise ValueError(f"{path}: the wheels' actuators are neither motors nor velocity servos. Use <motor> or "
                     "<velocity>.")
