"""A collision monitor: commands slowed down by what the scanners of a vehicle see, whatever its policy wants.

It is a function of one scan and one command, so a training has it in every step, and an exported policy in its file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env
from whill_mjx.sensors.lidar import Lidar
from whill_mjx.sensors.odometry import Odometry
from whill_mjx.tasks.terms import to_body

POSES = 8
"""Poses of the way ahead that are tested."""
SIDE = 0.05
"""Distance beside the way at which a thing lies in it [m]; scans have noise."""
NEIGHBOURS = 2
"""Rays to either side in which a thing may have been before: its edge, or a ray that was lost."""
SLOWEST, FASTEST = 0.3, 2.0
"""Speeds with which things come [m/s]: less is the noise of two scans, and more a thing that was hidden before."""
PLACE = "place"
"""Name of the vehicle's pose (3,) in its odometry at the scan before."""
SCAN = "scan_"
"""Put before the names of scanners, which people choose: none is then the one above."""


@dataclass(frozen=True)
class Monitor:
    """What a vehicle needs to know of itself to slow down in time. Hashable: a static part of a policy."""

    scanners: tuple[tuple[str, Lidar], ...]
    """By the names of their observations."""
    half_length: float
    """Of the vehicle [m], centred at the chassis origin."""
    half_width: float
    turns_at: float
    """Where it turns on the spot: the driven axle, ahead of the chassis origin [m]."""
    time: float
    """Time that it leaves until it would touch what lies on its way [s]."""
    margin: float
    """Distance at which it no longer nears that [m]."""
    seconds: float
    """From one scan to the next."""
    odometry: str | None
    """Name of the observation that tells where the vehicle is; None takes what the last command would have moved it."""

    def memory(self) -> dict[str, jax.Array]:
        """What is remembered at the start of an episode, all zeros: no scan of any scanner."""
        scans = {SCAN + name: jnp.zeros(one.rays) for name, one in self.scanners}
        return scans | ({PLACE: jnp.zeros(3)} if self.odometry else {})

    def slowed(self, command: jax.Array, last: jax.Array, seen: Mapping[str, jax.Array],
               memory: Mapping[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:  # fmt: skip
        """The nearest to the command (2,) of: the same curve more slowly; straight on; a turn on the spot. And the
        memory after it.

        The vehicle's border may near a thing that lies on the way or comes, at distance d and with speed w, by
        (d - margin) / time - w, and away from it as fast as it wants. A thing lies on the way where the vehicle would
        meet it within twice the `time`, if both went on like this.

        Args:
            command: (2,) speed [m/s] and yaw rate [rad/s] that are wanted.
            last: (2,) the command before.
            seen: observations by name; of each scanner the distances (rays,) [m].
            memory: after the scan before; zeros where there was none.
        """
        moved = self._moved(last, seen, memory)
        found = [self._points(one, seen[name], memory[SCAN + name], moved) for name, one in self.scanners]
        points, comes = (jnp.concatenate(parts) for parts in zip(*found, strict=True))
        ways = command * jnp.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
        allowed = jax.vmap(lambda way: way * self._share(way, points, comes))(ways)
        lost = jnp.sum(((allowed - command) * jnp.array([1.0, self.half_length])) ** 2, -1)
        after = {SCAN + name: seen[name] for name, _ in self.scanners}
        if self.odometry:
            after[PLACE] = seen[self.odometry][:3]
        other = jnp.where(lost[1] <= lost[2], allowed[1], allowed[2])
        least = jnp.where(lost[0] <= jnp.min(lost[1:]), allowed[0], other)
        return least, after

    def _moved(self, last: jax.Array, seen: Mapping[str, jax.Array], memory: Mapping[str, jax.Array]) -> jax.Array:
        """(3,) m, m, rad: how the axle has moved since the scan before, in the frame that it had then."""
        if self.odometry is None:
            return jnp.concatenate([_chord(last, self.seconds), last[1:] * self.seconds])
        was, now = memory[PLACE], seen[self.odometry][:3]
        return jnp.concatenate([to_body(was, now[:2]), now[2:] - was[2:]])

    def _share(self, command: jax.Array, points: jax.Array, comes: jax.Array) -> jax.Array:
        """() of a command (2,) that is left before points (N, 2) [m] with velocities (N, 2) [m/s]."""
        half = jnp.array([self.half_length, self.half_width])
        border = jnp.clip(points, -half, half)
        away = points - border
        apart = jnp.sqrt(jnp.sum(away**2, -1) + 1e-12)
        toward = -jnp.sum(comes * away, -1) / apart
        arm = border - jnp.array([self.turns_at, 0.0])
        speed = jnp.stack([command[0] - command[1] * arm[:, 1], command[1] * arm[:, 0]], -1)
        nears = jnp.sum(speed * away, -1) / apart
        allowed = jnp.maximum((apart - self.margin) / self.time - jnp.maximum(toward, 0.0), 0.0)
        slower = (self._on_the_way(command, points, comes) | (toward > SLOWEST)) & (nears > allowed)
        return jnp.min(jnp.where(slower, allowed / jnp.maximum(nears, 1e-6), 1.0))

    def _points(self, scanner: Lidar, distances: jax.Array, before: jax.Array,
                moved: jax.Array) -> tuple[jax.Array, jax.Array]:  # fmt: skip
        """(rays, 2) m from the chassis origin, where rays without a return end; and their velocities (rays, 2) [m/s].

        A thing has come nearer where the scan before went farther in its direction, and in those beside it.
        """
        angles, mount = scanner.angles(), np.array([scanner.x, scanner.y])
        ways = np.stack([np.cos(angles), np.sin(angles)], -1)
        points = jnp.asarray(mount) + distances[:, None] * ways
        axle = jnp.array([self.turns_at, 0.0])
        then = axle + _turned(points - axle, moved[2]) + moved[:2] - mount
        far = jnp.sqrt(jnp.sum(then**2, -1))
        near = then @ ways.T >= far[:, None] * np.cos((NEIGHBOURS + 0.5) * scanner.fov / scanner.rays)
        free = jnp.min(jnp.where(near, before, scanner.reach), -1)
        came = jnp.where(near.any(-1), free, 0.0) - far
        speed = jnp.clip(came / self.seconds, 0.0, FASTEST)
        return points, -speed[:, None] * ways

    def _on_the_way(self, command: jax.Array, points: jax.Array, comes: jax.Array) -> jax.Array:
        """(N,) bool: whether the vehicle would meet each point (N, 2) if both went on like this."""
        half = jnp.array([self.half_length, self.half_width])
        axle = jnp.array([self.turns_at, 0.0])
        met = []
        for time in np.arange(1, POSES + 1) * (2.0 * self.time / POSES):
            pose = jnp.concatenate([axle + _chord(command, time), command[1:] * time])
            there = axle + to_body(pose, (points + time * comes).T).T
            met.append((jnp.abs(there) < half + SIDE).all(-1))
        return jnp.stack(met).any(0)


def _turned(vectors: jax.Array, angle: jax.Array) -> jax.Array:
    """(N, 2) turned to the left by an angle ()."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return jnp.stack([x * cos - y * sin, x * sin + y * cos], -1)


def _chord(twist: jax.Array, time: float) -> jax.Array:
    """(2,) m: way of the axle in a time, at speed v and yaw rate w: v t sinc(w t / 2), in direction w t / 2."""
    half = twist[1] * time / 2.0
    return twist[0] * time * jnp.sinc(half / jnp.pi) * jnp.stack([jnp.cos(half), jnp.sin(half)])


def monitor_of(env: Env, time: float, margin: float) -> Monitor:
    """The monitor of an environment's vehicle and scanners.

    Raises:
        ValueError: the environment shows no scan.
    """
    scanners: tuple[tuple[str, Any], ...] = tuple(pair for pair in env.sensors if isinstance(pair[1], Lidar))
    if not scanners:
        raise ValueError(f"a collision monitor needs a scan, and the task {env.task.name} shows none. Give it a Lidar, "
                         "or choose another --safety.")
    spec = env.model.spec
    seconds = env.model.config.control_dt * env.task.action_repeat
    odometry = next((name for name, one in env.sensors if isinstance(one, Odometry)), None)
    size = spec.body_length / 2, spec.body_width / 2
    return Monitor(scanners, *size, spec.reference_x, time, margin, seconds, odometry)
