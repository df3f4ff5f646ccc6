"""A room of 4 x 4 cells with a key and a door at random places: four moves to choose from, the key before the door.

A task for discrete actions that is learned in minutes on a CPU. The agent sees a picture of the room (itself red, the
key green, the door blue) and, as a number, whether it holds the key.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from dreamer.spaces import Discrete
from dreamer.types import FunctionalEnv, Transition

SIDE = 4
CELLS = SIDE * SIDE
PIXELS = 4  # side of a cell
LIMIT = 30  # steps of an episode
STEP_COST = 0.01
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # rows, columns


@struct.dataclass
class Room:
    """State of one instance; places are (2,) int32 row and column."""

    agent: jax.Array
    key_place: jax.Array
    door: jax.Array
    has_key: jax.Array
    count: jax.Array
    over: jax.Array
    random: jax.Array


def make(instances: int) -> FunctionalEnv:
    """`instances` rooms. The key and the door pay 1 each, the door only with the key, and then the episode ends."""

    def cell(place: jax.Array) -> jax.Array:
        return jax.nn.one_hot(place[0] * SIDE + place[1], CELLS).reshape(SIDE, SIDE)

    def observe(room: Room) -> dict[str, jax.Array]:
        key = jnp.where(room.has_key, 0.0, cell(room.key_place))
        room_plan = (255 * jnp.stack([cell(room.agent), key, cell(room.door)], -1)).astype(jnp.uint8)
        image = jnp.repeat(jnp.repeat(room_plan, PIXELS, 0), PIXELS, 1)
        return {"image": image, "holding": room.has_key.astype(jnp.float32)[None]}

    def begin(random: jax.Array) -> Room:
        random, places_key = jax.random.split(random)
        cells = jax.random.choice(places_key, CELLS, (3,), replace=False)
        agent, key, door = jnp.stack([cells // SIDE, cells % SIDE], -1).astype(jnp.int32)
        return Room(agent, key, door, jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros((), bool), random)

    def emit(room: Room, reward: jax.Array, solved: jax.Array, first: jax.Array) -> tuple[Room, Transition]:
        ends = solved | ((room.count >= LIMIT) & ~first)
        room = room.replace(over=ends)  # type: ignore[attr-defined]
        return room, Transition(observe(room), reward, first, ends, solved, {"success": solved.astype(jnp.float32)})

    def reset_one(random: jax.Array) -> tuple[Room, Transition]:
        return emit(begin(random), jnp.zeros(()), jnp.zeros((), bool), jnp.ones((), bool))

    def step_one(room: Room, action: jax.Array) -> tuple[Room, Transition]:
        agent = jnp.clip(room.agent + jnp.array(MOVES)[action], 0, SIDE - 1)
        found = ~room.has_key & jnp.all(agent == room.key_place)
        solved = room.has_key & jnp.all(agent == room.door) & ~room.over
        reward = jnp.where(room.over, 0.0, found + solved - STEP_COST)
        moved = Room(agent, room.key_place, room.door, room.has_key | found, room.count + 1, room.over, room.random)
        new = jax.tree.map(lambda new, old: jnp.where(room.over, new, old), begin(room.random), moved)
        return emit(new, reward, solved, room.over)

    return FunctionalEnv(
        num_envs=instances, obs_shape={"image": (SIDE * PIXELS, SIDE * PIXELS, 3), "holding": (1,)},
        action_dim=Discrete(len(MOVES)),
        reset=lambda key: jax.vmap(reset_one)(jax.random.split(key, instances)), step=jax.vmap(step_one),
    )  # fmt: skip
