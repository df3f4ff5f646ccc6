"""Replay of a model that the host steps by itself: what is around it is traced, its own steps are not.

C MuJoCo steps a small robot some hundred times as fast as MJX, without compilation. Commands go through their effects
for a whole drive, the host drives it, and what it observed goes through the effects of odometry and outside pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sysid.replay.arrays import moved
from sysid.replay.delays import delay_apart, delayed
from sysid.replay.one_drive import from_reference, simulate_one
from sysid.replay.records import POSE, Batch, Plant, Simulated

FEW, MANY = 4, 32
"""Parameter sets whose commands and readings are computed together: each other number would be compiled."""


class HostReplay:
    """`Replay` of one batch by `Plant.host`."""

    def __init__(self, plant: Plant, batch: Batch, set_values: Callable[[jax.Array], Any]):
        """`set_values` turns values (P,) into the model's parameters."""
        host = plant.host
        assert host is not None
        recorded = replace(host.recorded, frame=plant.frame)

        def before(values: jax.Array, one: Batch) -> tuple[Any, Any, jax.Array, jax.Array]:
            """Values of the model, its state at the start, commands (S, 2) of every physics step, and where it starts:
            at the origin where that does not matter, so that sets which differ in readings alone share a drive."""
            params = set_values(values)
            start = from_reference(params, one.start)
            begin = start if params.room_fixed else start.at[:3].set(0.0)
            command = one.command.reshape(-1, 2)
            if one.warm_up:  # it came with these
                command = jnp.concatenate([jnp.broadcast_to(start[3:], (one.warm_up, 2)), command])
            params, delay = delay_apart(params)
            command = delayed(delay, command, plant.dt)
            return params.values, host.place(params, begin), host.commands(params, command), begin

        def after(values: jax.Array, one: Batch, motion: jax.Array) -> Simulated:
            params = set_values(values)
            start = from_reference(params, one.start)
            if not params.room_fixed:  # it was driven from the origin
                motion = motion.at[:, POSE].set(moved(motion[:, POSE], jnp.zeros(3), start))
            kept = tuple(effect for effect in params.effects if not hasattr(effect, "command"))
            motion = motion.reshape(*one.command.shape[:2], -1)
            return simulate_one(recorded, replace(params, effects=kept), replace(one, command=motion, warm_up=0))

        def of_all(function: Callable[..., Any]) -> Any:
            """Of each set (N,) on each trial (B,)."""
            each = jax.vmap(function, in_axes=(None, 0, *((0,) if function is after else ())))
            return jax.jit(jax.vmap(each, in_axes=(0, None, *((0,) if function is after else ()))))

        self.batch, self._host = batch, host
        self._before, self._after = of_all(before), of_all(after)

    def simulate(self, values: np.ndarray) -> Simulated:
        """Replay with each of values (N, P); leaves gain the axis N in front."""
        given = _in_blocks(lambda sets: self._before(sets, self.batch), np.asarray(values, float))
        keys = [tuple(leaf[i].tobytes() for leaf in jax.tree.leaves(given)) for i in range(len(values))]
        first = {key: i for i, key in reversed(list(enumerate(keys)))}
        place = {key: k for k, key in enumerate(first)}
        drives = list(first.values())
        driven = []
        for start in range(0, len(drives), MANY):  # the host keeps all of its states
            part = drives[start : start + MANY]
            inner, states, commands, begin = jax.tree.map(lambda leaf, part=part: leaf[part], given)
            driven.append(self._host.drive({name: leaf[:, 0] for name, leaf in inner.items()}, states, commands,
                                           self.batch.warm_up, begin[..., :3]))
        motion = np.concatenate(driven)[[place[key] for key in keys]]
        found: Simulated = _in_blocks(lambda sets, seen: self._after(sets, self.batch, seen),
                                      np.asarray(values, float), motion)
        return found


def _in_blocks(function: Callable[..., Any], *arrays: np.ndarray) -> Any:
    """What a function makes of arrays (N, ...), in blocks of `MANY` or `FEW` rows; the last is filled up."""
    count, found = len(arrays[0]), []
    size = FEW if count <= FEW else MANY
    for first in range(0, count, size):
        rows = [one[first : first + size] for one in arrays]
        missing = size - len(rows[0])
        filled = [np.concatenate([one, np.repeat(one[-1:], missing, axis=0)]) for one in rows]
        block = function(*(jnp.asarray(one, jnp.result_type(float)) for one in filled))
        found.append(jax.tree.map(lambda leaf, kept=size - missing: np.asarray(leaf)[:kept], block))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
