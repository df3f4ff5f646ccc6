"""Rich looks of a room: what stands in it, drawn at random inside the reset, and the record of how it looks.

`furnish` puts things into a room; `whill_mjx.world.paint` draws how everything looks. The renderer's part is
`whill_mjx.world.render.rich`; the film is `whill_mjx.world.eye`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.eye import Eye
from whill_mjx.world.scene import Boxes, Marker, Scene, box, stack_boxes
from whill_mjx.world.solids import Rounds, Solids

THINGS, ROUNDS, LAMPS, DOORS, POSTERS, WINDOWS = 6, 3, 4, 4, 5, 2
"""Numbers of things along the walls (the first ROUNDS may be cylinders), lamps and what hangs on the walls."""
LIGHTS = 3
"""Lamps that light the room; the others are only seen."""
PASSAGE = 0.95
"""Width that is left free between things, walls and obstacles [m]."""
DEEP = (0.08, 0.38)
"""How far things reach from the wall into the room [m]."""
FLOOR, MARKER, WALL, OBSTACLE, THING, PANEL, CEILING, LAMP, FRAME, DOOR, POSTER, WINDOW, POLE, TOP = range(14)
PERSON = 14
"""Roles: what a label is to the room."""


@struct.dataclass
class Materials:
    """Surfaces of L labels: joints of cells, tone by cell, figures, blotches, grain, a band of other paint."""

    paint: jax.Array  # (L, 3) reflectance
    second: jax.Array  # (L, 3) reflectance of what is filled
    band_paint: jax.Array  # (L, 3) reflectance of the band
    cell: jax.Array  # (L, 2) edges of a cell [m]
    shift: jax.Array  # (L,) by which each row of cells is moved [cells]
    joint: jax.Array  # (L,) width of the joint between cells [m]
    joint_tone: jax.Array  # (L,) relative darkness of the joint; negative is lighter
    tone: jax.Array  # (L,) relative brightness by cell
    fill: jax.Array  # (L,) share of the cells that are filled; of figures, how far from their level
    figure: jax.Array  # (L,) level of the blotches near which is filled: 0 spots, higher rings; negative fills cells
    blotch: jax.Array  # (L,) relative brightness of blotches
    blotch_size: jax.Array  # (L,) m
    grain: jax.Array  # (L,) relative brightness of the grain
    grain_size: jax.Array  # (L, 2) m
    band: jax.Array  # (L, 2) heights between which the band lies [m]
    glow: jax.Array  # (L,) light that it gives off itself
    gloss: jax.Array  # (L,) share of the lamps' mirror image


@struct.dataclass
class Lights:
    """Lamps, sunlight through a window, and soft shadows of C things. Every leaf is a float."""

    ambient: jax.Array  # (3,)
    position: jax.Array  # (LIGHTS, 3) m
    colour: jax.Array  # (LIGHTS, 3) light at 1 m
    half_width: jax.Array  # () of the room [m]; corners to the floor are darker
    sun: jax.Array  # (3,) unit vector towards the sun
    sunlight: jax.Array  # (3,) 0 without a sunlit window
    window: jax.Array  # (5,) the plane y of the window, its middle x and z, its half sizes [m]
    caster: jax.Array  # (C, 10) x, y, cos, sin, half sizes, height, shift x and y per height, strength
    exposure: jax.Array  # () factor; the environment sets it for every frame


@struct.dataclass
class Rich:
    """Looks of one world."""

    materials: Materials
    lights: Lights
    eye: Eye


class Room(NamedTuple):
    """Free space between the walls of a lane, and what stands in it."""

    begin: jax.Array  # m
    end: jax.Array
    half_width: jax.Array
    obstacles: Boxes


def room_of(scene: Scene) -> Room:
    """Room of a scene whose first boxes are its left, right and far wall."""
    boxes = scene.boxes
    left, far = boxes.centre[0], boxes.centre[2]
    return Room(
        left[0] - boxes.half[0, 0],
        far[0] - boxes.half[2, 0],
        left[1] - boxes.half[0, 1],
        jax.tree.map(lambda leaf: leaf[3 : leaf.shape[0] - pictures_of(scene)], boxes),
    )


def pictures_of(scene: Scene) -> int:
    """How many of the last boxes are pictures of a map's walls."""
    return 0 if scene.walls is None else scene.walls.keep


class Draws:
    """Uniform numbers, all drawn at once and handed out in order."""

    def __init__(self, key: jax.Array, count: int):
        self.numbers, self.used = jax.random.uniform(key, (count,)), 0

    def __call__(self, low=0.0, high=1.0, shape: tuple[int, ...] = ()) -> jax.Array:
        size = int(np.prod(shape))
        values = self.numbers[self.used : self.used + size].reshape(shape)
        self.used += size
        assert self.used <= self.numbers.shape[0], "more numbers are used than drawn"
        return low + values * (high - low)

    def chance(self, share: float, shape: tuple[int, ...] = ()) -> jax.Array:
        return self(shape=shape) < share


def furnish(key: jax.Array, scene: Scene, lone: bool) -> Scene:
    """The scene with a ceiling (most have one), doors, posters, lamps, and things along the walls.

    Args:
        key: random key.
        scene: a lane: left, right and far wall, then obstacles.
        lone: whether there is one obstacle, which gets another size and turn. Things stand beside it where PASSAGE is
            left; next to several obstacles nothing is put.

    Raises:
        ValueError: the scene has solids of its own.
    """
    if jax.tree.leaves(scene.solids):
        raise ValueError("looks are rich, and the task has solids of its own (posts, rods or blocks): furnished rooms "
                         "have boxes only. Make them boxes, or take the looks plain or paper.")
    draw, room = Draws(key, 220), room_of(scene)
    covered, low = draw.chance(0.85), draw(1.0, 2.4)
    ceiling = draw(2.3, 3.2)
    height = jnp.where(covered, ceiling, low)
    walls = jax.tree.map(lambda leaf: leaf[:3], scene.boxes)
    walls = dataclasses.replace(
        walls, centre=walls.centre.at[:, 2].set(height / 2), half=walls.half.at[:, 2].set(height / 2)
    )
    white = jnp.ones(3)
    back = box(room.begin - 0.1, 0.0, 0.2, 2 * room.half_width + 0.4, height, white)
    obstacles = _other_carton(draw, room.obstacles) if lone else room.obstacles
    things, rounds, tops = _things(draw, room._replace(obstacles=obstacles), scene.marker, lone)
    marker, stand, panel = _stand(draw, scene.marker)
    solid = stack_boxes([walls, obstacles, back, things, panel])
    count = solid.yaw.shape[0]
    hidden = jnp.zeros(count, bool).at[count - THINGS - 1 : count - THINGS - 1 + ROUNDS].set(rounds.mask)
    ghosts = stack_boxes([*_ceiling(draw, room, ceiling, covered), *_on_walls(draw, room, height), *stand, tops])
    if pictures := pictures_of(scene):
        solid = stack_boxes([solid, jax.tree.map(lambda leaf: leaf[-pictures:], scene.boxes)])
        hidden = jnp.concatenate([hidden, jnp.zeros(pictures, bool)])
    return dataclasses.replace(
        scene, boxes=solid, marker=marker, ghosts=ghosts, hidden=hidden, solids=Solids(rounds=rounds)
    )


def roles_of(scene: Scene) -> np.ndarray:
    """(L,) role of each label of a furnished scene."""
    pictures = pictures_of(scene)
    obstacles = scene.boxes.yaw.shape[0] - 3 - 1 - THINGS - 1 - pictures
    boxes = [WALL] * 3 + [OBSTACLE] * obstacles + [WALL] + [THING] * THINGS + [PANEL] + [WALL] * pictures
    ghosts = [CEILING] + [LAMP] * LAMPS + [FRAME, DOOR] * DOORS + [POSTER] * POSTERS + [WINDOW] * WINDOWS
    ghosts += [POLE] * 2 + [PANEL] + [TOP] * THINGS
    people = scene.solids.rounds.mask.shape[0] - ROUNDS  # type: ignore[union-attr]
    return np.array([FLOOR, FLOOR, MARKER, *boxes, *ghosts, *[THING] * ROUNDS, *[PERSON] * people])


def _other_carton(draw: Draws, carton: Boxes) -> Boxes:
    """The obstacle with another size and turn; at least 0.9 m are left on its wider side."""
    half = jnp.stack([draw(0.12, 0.32), draw(0.12, 0.32), draw(0.11, 0.42)])
    yaw = draw(-jnp.pi / 2, jnp.pi / 2) * draw.chance(0.7)
    across = half[0] * jnp.abs(jnp.sin(yaw)) + half[1] * jnp.abs(jnp.cos(yaw))
    shrink = jnp.minimum(1.0, (0.28 + jnp.abs(carton.centre[0, 1])) / across)
    half = half * jnp.stack([shrink, shrink, jnp.ones(())])
    return dataclasses.replace(carton, centre=carton.centre.at[0, 2].set(half[2]), half=half[None], yaw=yaw[None])


def _things(draw: Draws, room: Room, marker: Marker, lone: bool) -> tuple[Boxes, Rounds, Boxes]:
    """Things along the walls, the cylinders among them, and what is on top of them; none closes the passage."""
    n = (THINGS,)
    x = draw(room.begin + 0.3, room.end - 0.4, n)
    side = jnp.where(draw.chance(0.5, n), 1.0, -1.0)
    deep, long = draw(*DEEP, n), draw(0.06, 0.45, n)
    high = jnp.where(draw.chance(0.6, n), draw(0.2, 0.9, n), draw(0.9, 2.1, n))
    is_round = draw.chance(0.45, n) & (jnp.arange(THINGS) < ROUNDS)
    radius = deep / 2
    half_x = jnp.where(is_round, radius, long)
    y = side * (room.half_width - deep / 2 - 0.01)
    mask = draw.chance(0.55, n)
    start = jnp.abs(x) < 0.8 + half_x
    mask &= ~(start & (deep > 0.25)) & (jnp.abs(x - marker.position[0]) > 0.3 + half_x)
    mask &= _leaves_passage(room, x, half_x, side, deep, lone)
    centre = jnp.stack([x, y, high / 2], 1)
    half = jnp.stack([half_x, deep / 2, high / 2], 1)
    zero, white = jnp.zeros(n), jnp.ones((THINGS, 3))
    boxes = Boxes(centre, half, zero, white, mask)
    first = slice(0, ROUNDS)
    axis = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (ROUNDS, 3))
    rounds = Rounds(centre[first], axis, high[first] / 2, radius[first], jnp.zeros(ROUNDS, bool), white[first],
                    (mask & is_round)[first])  # fmt: skip
    # A back rest, a lid or leaves: seen, not felt, and within what the thing takes of the floor.
    kind, tall = draw.chance(0.5, n), draw(0.05, 0.5, n)
    thin = jnp.where(kind, 0.03, deep / 2 * 0.8)
    top = Boxes(
        jnp.stack([x, side * (room.half_width - 0.01 - jnp.where(kind, 0.03, deep / 2)), high + tall / 2], 1),
        jnp.stack([half_x * 0.95, thin, tall / 2], 1),
        zero, white, mask & (high < 0.9) & draw.chance(0.5, n),
    )  # fmt: skip
    return boxes, rounds, top


def _leaves_passage(room: Room, x, half_x, side, deep, lone: bool) -> jax.Array:
    """(THINGS,) bool: does a wide way lead past the obstacles and these things? Any two things leave it elsewhere."""
    obstacles = room.obstacles
    c, s = jnp.abs(jnp.cos(obstacles.yaw)), jnp.abs(jnp.sin(obstacles.yaw))
    reach_x = obstacles.half[:, 0] * c + obstacles.half[:, 1] * s
    reach_y = obstacles.half[:, 0] * s + obstacles.half[:, 1] * c
    near = jnp.abs(x[:, None] - obstacles.centre[:, 0]) < half_x[:, None] + reach_x + 0.9  # (THINGS, O)
    near = near & obstacles.mask
    if not lone:
        return ~near.any(1)
    # One obstacle: its wider side stays wide, whatever stands on the other side.
    wider = jnp.where(obstacles.centre[0, 1] > 0, -1.0, 1.0)
    free = room.half_width + jnp.abs(obstacles.centre[0, 1]) - reach_y[0]
    return ~near[:, 0] | (side != wider) | (free - deep >= PASSAGE)


def _stand(draw: Draws, marker: Marker) -> tuple[Marker, list[Boxes], Boxes]:
    """The marker on a stand, on a board, on a wall behind it, or hanging; its size and height differ a little."""
    x, y, z = marker.position
    size, lift = marker.half[1] * draw(0.85, 1.15), draw(-0.08, 0.12)
    kind = draw()
    white, black = jnp.ones(3), jnp.zeros(3)
    on_stand, on_wall = kind < 0.45, kind > 0.65
    z = z + lift
    pole = box(x + 0.05, y, 0.035, 0.035, z, black, mask=on_stand)
    base = box(x + 0.05, y, draw(0.2, 0.5), draw(0.2, 0.6), draw(0.02, 0.06), black, mask=on_stand)
    border = size * draw(1.02, 1.5)
    plate = Boxes(
        jnp.stack([x + 0.035, y, z])[None], jnp.stack([jnp.asarray(0.01), border, border])[None], jnp.zeros(1),
        white[None], draw.chance(0.5)[None],
    )  # fmt: skip
    board = box(x + 0.10, y + draw(-0.3, 0.3), 0.06, draw(0.9, 1.6), draw(1.0, 2.2), white, mask=on_wall)
    marker = dataclasses.replace(
        marker, position=jnp.stack([x, y, z]), half=jnp.stack([marker.half[0], size, size]),
    )  # fmt: skip
    return marker, [pole, base, plate], board


def _ceiling(draw: Draws, room: Room, height, covered) -> list[Boxes]:
    """The ceiling, and LAMPS lamps in a row on it."""
    middle, length = (room.begin + room.end) / 2, room.end - room.begin
    white = jnp.ones((1, 3))
    centre = jnp.stack([middle, jnp.zeros(()), height + 0.05])[None]
    half = jnp.stack([length / 2 + 0.2, room.half_width + 0.2, jnp.asarray(0.05)])[None]
    slab = Boxes(centre, half, jnp.zeros(1), white, covered[None])
    step = length / LAMPS
    x = room.begin + step * (jnp.arange(LAMPS) + draw(0.2, 0.8))
    y = jnp.broadcast_to(draw(-0.5, 0.5), (LAMPS,))
    along, across = draw(0.08, 0.7), draw(0.06, 0.4)
    lamps = Boxes(
        jnp.stack([x, y, jnp.broadcast_to(height - draw(0.0, 0.08), (LAMPS,))], 1),
        jnp.broadcast_to(jnp.stack([along, across, jnp.asarray(0.02)]), (LAMPS, 3)),
        jnp.zeros(LAMPS), jnp.ones((LAMPS, 3)), draw.chance(0.8, (LAMPS,)) & covered,
    )  # fmt: skip
    return [slab, lamps]


def _on_walls(draw: Draws, room: Room, tall) -> list[Boxes]:
    """Doors with frames, posters and windows, flat on the side walls; some posters on the far wall."""
    n = DOORS
    x, side = draw(room.begin + 0.6, room.end - 0.6, (n,)), jnp.where(draw.chance(0.5, (n,)), 1.0, -1.0)
    wide, high = draw(0.35, 0.6, (n,)), draw(1.9, 2.2, (n,))
    mask = draw.chance(0.6, (n,)) & (high < tall)
    doors = []
    for i in range(n):
        for thick, grow in ((0.015, 0.06), (0.02, 0.0)):
            middle = (high[i] + grow) / 2
            doors.append(_flat((x[i], side[i] * room.half_width, middle), (wide[i] + grow, thick, middle), mask[i]))
    n = POSTERS
    x, side = draw(room.begin + 0.4, room.end - 0.4, (n,)), jnp.where(draw.chance(0.5, (n,)), 1.0, -1.0)
    wide, high, z = draw(0.1, 0.5, (n,)), draw(0.1, 0.5, (n,)), draw(0.9, 1.8, (n,))
    mask = draw.chance(0.6, (n,)) & (z + high < tall)
    posters = [_flat((x[i], side[i] * room.half_width, z[i]), (wide[i], 0.01, high[i]), mask[i]) for i in range(n - 1)]
    on_far = Boxes(
        jnp.stack([room.end, draw(-0.8, 0.8), z[-1]])[None], jnp.stack([jnp.asarray(0.01), wide[-1], high[-1]])[None],
        jnp.zeros(1), jnp.ones((1, 3)), mask[-1:],
    )  # fmt: skip
    n = WINDOWS
    x, side = draw(room.begin + 0.5, room.end - 0.5, (n,)), jnp.where(draw.chance(0.5, (n,)), 1.0, -1.0)
    wide, high, mask = draw(0.3, 0.8, (n,)), draw(0.3, 0.6, (n,)), draw.chance(0.3, (n,)) & (tall > 2.2)
    windows = [_flat((x[i], side[i] * room.half_width, 1.5), (wide[i], 0.012, high[i]), mask[i]) for i in range(n)]
    return [*doors, *posters, on_far, *windows]


def _flat(centre: tuple, half: tuple, mask) -> Boxes:
    """One thin upright box on a side wall, by its centre and its half edges (3,) [m]."""
    where, size = (jnp.stack([jnp.asarray(one, float) for one in three])[None] for three in (centre, half))
    return Boxes(where, size, jnp.zeros(1), jnp.ones((1, 3)), jnp.asarray(mask)[None])
