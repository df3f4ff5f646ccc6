"""Drives one trial: controllers, disturbances, contact dynamics, encoders."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from benchmarks.plant.base import TICK, Effect, Load, Moment
from benchmarks.plant.chair import SLOW, Chair, Contact, Nominal, build

REPORT = 0.05  # s between rows of odometry and outside pose
ROLLING = 0.4  # rad/s, both wheels' speeds together: a slower chair feels less of the road, one at rest nothing
ENCODER = 2 * math.pi / 4096  # rad per tick


@dataclass(frozen=True)
class Noise:
    """Disturbances on the chair and noise of its sensors: standard deviations."""

    road_force: float = 1.5
    """Along the chair [N], first-order, `correlation`."""
    yaw_torque: float = 0.47
    """[N m], the same."""
    correlation: float = 0.35
    """[s]"""
    grip: float = 0.01
    """Of each tyre's friction from trial to trial, of its value: another stretch of floor [-]."""
    position: float = 0.003
    yaw: float = 0.003
    """White, of the outside pose [m, rad]."""
    v: float = 0.0039
    omega: float = 0.0043
    """White, of the reported speeds [m/s, rad/s]."""
    low_pass: float = 0.042
    """Time constant of the reported speeds [s]."""

    def of(self, chair: Chair) -> Noise:
        """The same accelerations for a vehicle of another mass and size."""
        mass, track = chair.nominal.mass / Nominal.mass, chair.nominal.track / Nominal.track
        return replace(self, road_force=self.road_force * mass, yaw_torque=self.yaw_torque * mass * track)

    def scaled(self, noise: float) -> Noise:
        """All standard deviations times `noise`."""
        names = ("road_force", "yaw_torque", "grip", "position", "yaw", "v", "omega")
        return replace(self, **{name: noise * getattr(self, name) for name in names})


@dataclass(frozen=True)
class Drive:
    """What was true in one trial, at every tick (K)."""

    chair: Chair
    t: np.ndarray
    """(K,) [s]"""
    pose: np.ndarray
    """(K, 3) x, y, yaw of the drive-axle centre in the room, yaw continuous."""
    speed: np.ndarray
    """(K, 3) forward, to the left, yaw rate."""
    encoder: np.ndarray
    """(K, 2) angles of the wheels, where the encoders sit [rad]."""
    torque: np.ndarray
    """(K, 2) drive torques [N m]."""


@dataclass
class Trial:
    """One trial on its way: what acts on it, and what was true at its ticks so far."""

    effects: list[Effect]
    session: float
    """Time since the dataset began, at its start [s]."""
    target: np.ndarray
    """(K, 2) wanted wheel speeds [rad/s]; those of the ticks to come may still change."""
    force: np.ndarray
    twist: np.ndarray
    """(K,) of the road: along the chair [N], about its yaw axis [N m]."""
    qpos: np.ndarray
    qvel: np.ndarray
    """(K, nq), (K, nv) states of the model."""
    torque: np.ndarray
    """(K, 2) drive torques [N m]."""
    ticks: int = 0
    """Ticks that are driven."""
    integral: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Of the controllers' errors [rad]."""
    moment: Moment = field(default_factory=Moment)

    def record(self, plant: Plant) -> Drive:
        """What was true so far."""
        n = self.ticks
        return _record(
            plant.chair, np.arange(n) * TICK, self.qpos[:n], self.qvel[:n], self.torque[:n], plant.wheel_q
        )  # fmt: skip


class Plant:
    """A chair ready to drive: its model is compiled and settled once."""

    build = staticmethod(build)
    """The model of a chair."""

    def __init__(self, chair: Chair, contact: Contact = SLOW) -> None:
        self.chair, self.model = chair, self.build(chair, contact)
        self.substeps = round(TICK / contact.timestep)
        self.data = mujoco.MjData(self.model)
        joint = {name: self.model.joint(name) for name in ("wheel_left", "wheel_right")}
        motor = [f"rotor_{side}" if chair.play else f"wheel_{side}" for side in ("left", "right")]
        self.wheel_q = [int(joint[name].qposadr[0]) for name in joint]
        self.wheel_v = [int(joint[name].dofadr[0]) for name in joint]
        self.motor_v = [int(self.model.joint(name).dofadr[0]) for name in motor]
        brake = min(20.0, 0.9 * float(self.model.dof_M0[self.wheel_v].min()) / contact.timestep)  # N m s/rad: stable
        for _ in range(round(1.0 / contact.timestep)):
            self.data.qfrc_applied[self.wheel_v] = -brake * self.data.qvel[self.wheel_v]  # brakes on
            mujoco.mj_step(self.model, self.data)
        self.rest = self.data.qpos.copy()

    def drive(
        self, messages: np.ndarray, start: tuple[float, float, float], effects: list[Effect], noise: Noise,
        random: np.random.Generator, session: float = 0.0,
    ) -> Drive:
        """One trial from rest.

        Args:
            messages: (T, 3) t, v, omega as sent.
            start: x, y, yaw in the room.
            effects: fresh ones.
            noise: disturbances of the drive; sensors are read by `sensors.py`.
            random: of the disturbances.
            session: time since the dataset began [s].
        """
        count = math.ceil((messages[-1, 0] + REPORT) / TICK - 1e-6) + 1
        target = wheel_targets(self.chair, messages, np.arange(count) * TICK, effects)
        trial = self.begin(count, start, effects, noise, random, session)
        trial.target[:] = target
        self.advance(trial, count)
        return trial.record(self)

    def begin(
        self, longest: int, start: tuple[float, float, float], effects: list[Effect], noise: Noise,
        random: np.random.Generator, session: float = 0.0,
    ) -> Trial:  # fmt: skip
        """Place the chair for a trial of at most so many ticks, with the arguments of `drive`."""
        force, twist = disturbances(noise, longest, random)
        grip = self.chair.friction * np.exp(noise.grip * random.standard_normal((2, 1)))
        self.model.pair_friction[:2, :2] = grip
        self._place(start)
        return Trial(
            effects, session, np.zeros((longest, 2)), force, twist, np.empty((longest, self.model.nq)),
            np.empty((longest, self.model.nv)), np.empty((longest, 2)),
        )  # fmt: skip

    def advance(self, trial: Trial, ticks: int) -> None:
        """Drive the next ticks of a trial, whose targets must be there."""
        chair, model, data = self.chair, self.model, self.data
        effects, target, force, twist, session = trial.effects, trial.target, trial.force, trial.twist, trial.session
        makers = [effect for effect in effects if type(effect).torque is not Effect.torque]
        loaders = [effect for effect in effects if type(effect).load is not Effect.load]
        (left_q, right_q), (left_v, right_v), (left_m, right_m) = self.wheel_q, self.wheel_v, self.motor_v
        applied, kp, ki, limit = data.qfrc_applied, chair.kp, chair.ki, chair.torque_limit
        qpos, qvel, torques = trial.qpos, trial.qvel, trial.torque
        origin, wheelbase = (self.rest[left_q], self.rest[right_q]), chair.nominal.wheelbase
        integral, moment = trial.integral, trial.moment
        for k in range(trial.ticks, trial.ticks + ticks):
            q, w = data.qpos.tolist(), data.qvel.tolist()
            qpos[k], qvel[k] = q, w
            yaw = math.atan2(2 * (q[3] * q[6] + q[4] * q[5]), 1 - 2 * (q[5] ** 2 + q[6] ** 2))
            cos, sin = math.cos(yaw), math.sin(yaw)
            errors = target[k, 0] - w[left_v], target[k, 1] - w[right_v]
            integral[0] += errors[0] * TICK
            integral[1] += errors[1] * TICK
            left = min(limit, max(-limit, kp * errors[0] + ki * integral[0]))
            right = min(limit, max(-limit, kp * errors[1] + ki * integral[1]))
            load = Load()
            rough = min(1.0, (abs(w[left_v]) + abs(w[right_v])) / ROLLING)
            side, omega = cos * w[1] - sin * w[0], w[5]
            rollers = -2 * chair.roller_drag * (side + wheelbase * omega)
            if makers or loaders:
                moment.t, moment.session = k * TICK, session + k * TICK
                moment.x, moment.y, moment.yaw = q[0], q[1], yaw
                moment.v, moment.side, moment.omega = cos * w[0] + sin * w[1], side, omega
                moment.spin, moment.angle = (w[left_v], w[right_v]), (q[left_q] - origin[0], q[right_q] - origin[1])
                for effect in makers:
                    left, right = effect.torque(moment, left, right)
                moment.torque = left, right
                for effect in loaders:
                    effect.load(moment, load)
            forward, left_force = load.forward + rough * force[k], load.left + rollers
            applied[0], applied[1] = cos * forward - sin * left_force, sin * forward + cos * left_force
            applied[3], applied[4] = load.roll, load.pitch
            applied[5] = load.yaw + rough * twist[k] + wheelbase * rollers
            applied[left_m] = applied[right_m] = 0.0
            applied[left_v], applied[right_v] = load.wheel
            applied[left_m] += left
            applied[right_m] += right
            torques[k] = left, right
            mujoco.mj_step(model, data, self.substeps)
        trial.ticks += ticks

    def _place(self, start: tuple[float, float, float]) -> None:
        """At rest, settled, at x, y, yaw: the settled attitude is turned with the heading."""
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = self.rest
        turn = np.array([math.cos(start[2] / 2), 0.0, 0.0, math.sin(start[2] / 2)])
        attitude = np.empty(4)
        mujoco.mju_mulQuat(attitude, turn, self.rest[3:7])
        data.qpos[:2], data.qpos[3:7] = start[:2], attitude


def wheel_targets(chair: Chair, messages: np.ndarray, t: np.ndarray, effects: list[Effect]) -> np.ndarray:
    """Wanted wheel speeds (K, 2) [rad/s]: a message holds until the next one arrives."""
    messages = np.column_stack([messages[:, 0] + chair.delay, messages[:, 1:]])
    for effect in effects:
        messages = effect.messages(messages)
    latest = np.searchsorted(messages[:, 0], t + 1e-9, side="right") - 1
    command = np.where(latest[:, None] >= 0, messages[np.maximum(latest, 0), 1:], 0.0)
    for effect in effects:
        command = effect.command(command)
    half = chair.nominal.track / 2
    target = np.column_stack([command[:, 0] - half * command[:, 1], command[:, 0] + half * command[:, 1]])
    target /= chair.nominal.radius
    for effect in effects:
        target = effect.target(target)
    return target


def disturbances(noise: Noise, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Road force [N] and yaw torque [N m] (K,), first-order autoregressive."""
    force = noise.road_force * autoregressive(count, noise.correlation, random)
    return force, noise.yaw_torque * autoregressive(count, noise.correlation, random)


def autoregressive(count: int, correlation: float, random: np.random.Generator) -> np.ndarray:
    """Noise (K,) of unit variance at the ticks, correlated over `correlation` [s]."""
    from scipy.signal import lfilter

    rho = math.exp(-TICK / correlation)
    white = random.standard_normal(count)
    white[0] /= math.sqrt(1 - rho**2)  # stationary from the first tick
    return lfilter([math.sqrt(1 - rho**2)], [1.0, -rho], white)


def _record(
    chair: Chair, t: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, torque: np.ndarray, wheel_q: list[int]
) -> Drive:
    w, x, y, z = qpos[:, 3:7].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward, left = cos * qvel[:, 0] + sin * qvel[:, 1], cos * qvel[:, 1] - sin * qvel[:, 0]
    return Drive(
        chair=chair, t=t, pose=np.column_stack([qpos[:, :2], yaw]), speed=np.column_stack([forward, left, qvel[:, 5]]),
        encoder=qpos[:, wheel_q] - qpos[0, wheel_q], torque=torque,
    )  # fmt: skip
