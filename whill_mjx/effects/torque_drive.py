"""The physical drive: torque control of each wheel's speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.effects.planar import by_mode, spin_response
from whill_mjx.vehicle.types import Drive, Motion, Yielding, parameter

TINY = 1e-6  # [N m] or [rad/s], keeps shares defined at constant torque or target


@struct.dataclass
class Last:
    """What the controller of each wheel did in the step before."""

    target: jax.Array  # (2,) [rad/s]
    before: jax.Array  # (2,) target of the step before that [rad/s]
    spin: jax.Array  # (2,) in the middle of the step [rad/s]
    earlier: jax.Array  # (2,) in the middle of the step before that [rad/s]
    error: jax.Array  # (2,) there [rad/s]
    wanted: jax.Array  # (2,) torque without its limit [N m]
    crossing: jax.Array  # (2,) by how much that torque changed within the step [N m]


@struct.dataclass
class DriveMemory:
    """State of the controller of each wheel."""

    integral: jax.Array  # (2,) of the speed error [rad]
    expected: jax.Array  # (2,) spin that the last torque alone would have led to [rad/s]
    begun: jax.Array  # () 0 before the first step, 1 after it
    last: Last


@struct.dataclass
class TorqueDrive(Effect):
    """T = clip(kp e + ki integral of e + kff v_target / r, +-limit) with e = v_target / r - spin.

    A controller that runs every `period` seconds and holds its torque in between sees a spin that is half a period old
    on average: kp acts on that old spin. Its integral counts every jump of the wanted speed half a period too long,
    which equals a feed-forward kff of ki period / 2. More kff can compensate bearings that resist with speed.

    e and its integral are those in the middle of the physics step: the controller acts all the time, not once in a
    step. They include the acceleration that this torque gives to rolling wheels under the load of the previous step. A
    wheel that slips accelerates differently; `Yielding` then corrects e.

    While the torque is at its limit the integral goes on at `windup` times its rate. 1 is a plain PI controller, which
    overshoots after a long acceleration; 0 stops integrating (anti-windup). A target that jumps within a step arrives
    as the mean of its values before and after. The torque follows that mean, but whether it reaches its limit does not.
    So the next step, which shows where the target went, corrects the integral to that of a jump. Without this the
    chair's path would not depend smoothly on the time of a command.
    """

    name = "torque_drive"
    typical = {"kp": (2.0, 20.0), "ki": (2.0, 30.0), "limit": (8.0, 30.0), "kff": (0.0, 0.2)}
    source = "estimate, for the chair"
    card = Card(drives=True)
    kp: jax.Array = parameter("N m s/rad", 0.1, 200.0, 0.0, "proportional gain")
    ki: jax.Array = parameter("N m/rad", 0.0, 500.0, 0.0, "integral gain")
    limit: jax.Array = parameter("N m", 1.0, 2000.0, float("inf"), "largest torque of one side")
    windup: jax.Array = parameter("-", 0.0, 1.0, 0.0, "rate of the integral while the torque is at its limit")

    kff: jax.Array = parameter("N m s/rad", 0.0, 50.0, 0.0, "feed-forward of the wanted speed")
    period: jax.Array = parameter("s", 0.0, 0.01, 0.0, "time between two runs of a sampled controller")

    def init(self) -> DriveMemory:
        none = jnp.zeros(2)
        return DriveMemory(none, none, jnp.zeros(()), Last(none, none, none, none, none, none, jnp.ones(2)))

    def actuation(self, memory: DriveMemory, drive: Drive, motion: Motion) -> tuple[DriveMemory, Drive]:
        """Adds the motor torque (2,) [N m]."""
        half = motion.dt / 2
        target = drive.target / motion.wheel_radius
        error = target - motion.spin
        response = spin_response(motion)
        last = memory.last
        # Half a period before the middle of this step the spin was between those in the middle of two recent steps.
        age = memory.begun * self.period / (2 * motion.dt)
        old, older = jnp.minimum(age, 1.0), jnp.clip(age - 1.0, 0.0, 1.0)
        before = last.spin + older * (last.earlier - last.spin)
        damping = 1 / (1 + (1 - old) * half * self.kp * response)
        gain_of_target = lambda change: by_mode((self.kp + half * self.ki + self.kff) * change, damping)  # noqa: E731
        integral = memory.integral + motion.dt * self.jump(last, target, gain_of_target)
        # What else than the torque changes the spin [rad/s^2]; bounded, as a wheel that spins up has little inertia.
        largest = self.limit * response.max()
        load = jnp.clip(memory.begun * (motion.spin - memory.expected) / motion.dt, -largest, largest)
        # T = kp (e - half (response T + load)) + ki (integral + half e) + kff target, solved for T.
        known = target - old * before - (1 - old) * (motion.spin + half * load)
        wanted = self.kp * known + self.ki * (integral + half * error) + self.kff * target
        wanted = by_mode(wanted, damping)
        torque = jnp.clip(wanted, -self.limit, self.limit)
        gain = by_mode(torque, response)
        acceleration = gain + load
        # The wanted torque crosses the limit at the rate kp * acceleration.
        crossing = jnp.maximum(self.kp * jnp.abs(acceleration) * motion.dt, TINY)
        spin = motion.spin + half * acceleration
        earlier = motion.spin + memory.begun * (last.spin - motion.spin)
        done = Last(target, last.target, spin, earlier, error - half * acceleration, wanted, crossing)
        rate = self.rate(done.error, wanted, crossing)
        after = DriveMemory(integral + rate * motion.dt, motion.spin + gain * motion.dt, jnp.ones(()), done)
        foreseen = motion.spin + motion.dt * (by_mode(wanted, response) + load)
        yielding = Yielding(foreseen, (1 - old) * self.kp / 2 * jnp.ones(2), wanted - torque, -self.limit - torque,
                            self.limit - torque, jnp.ones(2))
        return after, replace(drive, torque=drive.torque + torque, yielding=yielding)

    def rate(self, error: jax.Array, wanted: jax.Array, crossing: jax.Array) -> jax.Array:
        """(2,) of the integral [rad/s], by the share of a step in which the torque is within its limit."""
        share = jnp.clip(0.5 + (self.limit - jnp.abs(wanted)) / crossing, 0.0, 1.0)
        share = jnp.where(wanted * error < 0, 1.0, share)  # coming back
        return (self.windup + (1 - self.windup) * share) * error

    def jump(self, last: Last, target: jax.Array, torque_of: Callable[[jax.Array], jax.Array]) -> jax.Array:
        """(2,) to add to the rate of the step before [rad/s], if its target was the mean of a jump to `target`."""
        back, forth = last.target - last.before, target - last.target
        span = back + forth
        moved = jnp.abs(span) > TINY
        late = jnp.where(moved, jnp.clip(back / jnp.where(moved, span, 1.0), 0.0, 1.0), 0.0)  # share after the jump
        before = self.rate(last.error - back, last.wanted - torque_of(back), last.crossing)
        after = self.rate(last.error + forth, last.wanted + torque_of(forth), last.crossing)
        jumped = (1 - late) * before + late * after - self.rate(last.error, last.wanted, last.crossing)
        return jnp.where(back * forth > 0, jumped, 0.0)
