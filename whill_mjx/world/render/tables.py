"""Numbers of all primitives of one image as small tables: tests, colours of faces, and their geometry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.world.render.rich import material_table
from whill_mjx.world.render.shading import View
from whill_mjx.world.render.visibility import (
    GROUND,
    MARKER,
    block_shadow_table,
    block_table,
    code_bits,
    into_frame,
    round_shadow_table,
    round_table,
    upright_shadow_table,
    upright_table,
)
from whill_mjx.world.scene import Boxes, Looks, Scene, stack_boxes
from whill_mjx.world.solids import Blocks, Rounds, across


@struct.dataclass
class Parts:
    """Primitives of a scene by kind, the marker being the first upright box."""

    boxes: Boxes
    blocks: Blocks | None
    rounds: Rounds | None

    @property
    def labels(self) -> int:
        """Number of labels, sky and ground included."""
        count = MARKER + self.boxes.yaw.shape[0]
        return count + sum(part.mask.shape[0] for part in (self.blocks, self.rounds) if part is not None)

    @property
    def first_block(self) -> int:
        """Label of the first block."""
        return MARKER + self.boxes.yaw.shape[0]

    @property
    def first_round(self) -> int:
        """Label of the first round."""
        return self.first_block + (0 if self.blocks is None else self.blocks.mask.shape[0])

    @property
    def bits(self) -> int:
        """Low bits of a key that hold label and face."""
        return code_bits(self.labels)


def parts_of(scene: Scene) -> Parts:
    """Primitives of a scene by kind; the order is that of the labels."""
    boxes, marker, solids = scene.boxes, scene.marker, scene.solids
    if scene.hidden is not None:
        boxes = boxes.replace(mask=boxes.mask & ~scene.hidden)  # type: ignore[attr-defined]
    if scene.ghosts is not None:
        boxes = stack_boxes([boxes, scene.ghosts])
    upright = Boxes(
        jnp.concatenate([marker.position[None], boxes.centre]),
        jnp.concatenate([marker.half[None], boxes.half]),
        jnp.concatenate([marker.yaw[None], boxes.yaw]),
        jnp.concatenate([marker.colour[None], boxes.colour]),
        jnp.concatenate([jnp.ones(1, bool), boxes.mask]),
    )
    parts = Parts(upright, None, None) if solids is None else Parts(upright, solids.blocks, solids.rounds)
    code_bits(parts.labels)  # refuses too many
    if scene.finish is not None and scene.finish.texture.shape[0] != parts.labels:
        raise ValueError(
            f"the finish names textures of {scene.finish.texture.shape[0]} labels; this scene has {parts.labels}."
            " Take whill_mjx.world.materials.label_count(scene)."
        )
    return parts


@struct.dataclass
class Tables:
    """Numbers of all primitives of one image; None where a kind or a table is not needed."""

    upright: jax.Array  # (P, 12)
    block: jax.Array | None  # (K, 15)
    round: jax.Array | None  # (K, 12)
    words: jax.Array | None  # (labels, 4) uint32 colour of each face; None with rich looks
    dark: jax.Array | None  # (labels, 4) uint32 colour of each face in shadow
    bent: jax.Array | None  # (K * 4, 8) geometry of each face of the rounds, whose words hold no light
    rows: jax.Array | None  # (labels * 4, row_numbers) geometry and texture of each face
    upright_shadow: jax.Array | None  # (P, 11)
    block_shadow: jax.Array | None  # (K, 18)
    round_shadow: jax.Array | None  # (K, 13)
    materials: jax.Array | None = None  # (labels, NUMBERS) of rich looks


def make_tables(view: View, parts: Parts, scene: Scene, shadows: bool, rows: bool = False) -> Tables:
    """Tables of one image; `rows` also when the light does not need them."""
    lit, rich = lit_words(scene), scene.rich
    words, dark = (None, None) if rich is not None else face_words(view.position, parts, scene.looks, lit)
    sun = scene.looks.sun
    blocks, rounds = parts.blocks, parts.rounds
    return Tables(
        upright_table(view.position, view.rotation, parts.boxes),
        None if blocks is None else block_table(view.position, view.rotation, blocks),
        None if rounds is None else round_table(view.position, view.rotation, rounds),
        words,
        dark if shadows and lit else None,
        bent_rows(view.position, rounds).reshape(-1, 8) if rounds is not None and lit else None,
        face_rows(view.position, parts, scene) if rows or not lit else None,
        upright_shadow_table(sun, parts.boxes) if shadows else None,
        block_shadow_table(sun, blocks) if shadows and blocks is not None else None,
        round_shadow_table(sun, rounds) if shadows and rounds is not None else None,
        None if rich is None else material_table(rich.materials),
    )


def lit_words(scene: Scene) -> bool:
    """Whether every flat face has one colour under the sun, so that its light can be looked up with its colour."""
    return scene.finish is None and scene.rich is None


def face_words(position: jax.Array, parts: Parts, looks: Looks, lit: bool) -> tuple[jax.Array, jax.Array]:
    """(labels, 4) uint32: colour of the x, y and z face that is turned to the camera, and the same in shadow.

    Where `lit`, they hold the light of the flat faces; those of rounds are the paint, for their light bends.
    """
    boxes = parts.boxes
    if not lit:
        kinds = [kind for kind in (boxes, parts.blocks, parts.rounds) if kind is not None]
        colour = jnp.concatenate([kind.colour for kind in kinds])
        words = jnp.broadcast_to(_pack(colour)[:, None], (colour.shape[0], 4))
        words = jnp.zeros((parts.labels, 4), jnp.uint32).at[MARKER:].set(words)
        return words, words
    c, s = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    offset = position - boxes.centre
    sun_x, sun_y = c * looks.sun[0] + s * looks.sun[1], c * looks.sun[1] - s * looks.sun[0]
    side_x, side_y = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
    cosine = jnp.stack([
        jnp.where(side_x > 0, sun_x, -sun_x),
        jnp.where(side_y > 0, sun_y, -sun_y),
        jnp.where(offset[:, 2] > 0, looks.sun[2], -looks.sun[2]),
    ], 1)  # (P, 3)
    colour = boxes.colour
    if parts.blocks is not None:
        blocks = parts.blocks
        own = into_frame(blocks.rotation, position - blocks.centre)
        into_sun = into_frame(blocks.rotation, looks.sun)
        cosine = jnp.concatenate([cosine, jnp.where(own > 0, into_sun, -into_sun)])
        colour = jnp.concatenate([colour, blocks.colour])

    def under(strength):
        light = looks.ambient + strength * jnp.maximum(cosine, 0.0)
        packed = _pack(light[..., None] * colour[:, None, :])
        words = jnp.zeros((parts.labels, 4), jnp.uint32).at[MARKER : parts.first_round, :3].set(packed)
        if parts.rounds is not None:
            words = words.at[parts.first_round :].set(_pack(parts.rounds.colour)[:, None])
        return words

    return under(looks.diffuse), under(0.0)


def row_numbers(scene: Scene) -> int:
    """Numbers of a face in `face_rows`."""
    return 16 if scene.finish is None else 18


def face_rows(position: jax.Array, parts: Parts, scene: Scene) -> jax.Array:
    """(labels * 4, row_numbers) numbers of each face.

    0-2 normal, or the axis of a round; 3-5 centre, 6 half length and 7 inverse radius of a round, 0 for flat faces;
    8-11 and 12-15 the maps from a point of the world to texture coordinates s and t. With a
    finish also: 16 texture, 17 repeats per metre.
    """
    labels, finish = parts.labels, scene.finish
    scale = jnp.ones(labels) if finish is None else finish.scale
    ground = jnp.array([0, 0, 1.0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0])
    ground = jnp.broadcast_to(ground, (1, 4, 16)).at[..., 8:].multiply(_inverse(scale[GROUND]))
    rows = [jnp.zeros((1, 4, 16)), ground]
    boxes = parts.boxes
    c, s, zero = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw), jnp.zeros_like(boxes.yaw)
    rotation = jnp.stack([jnp.stack([c, -s, zero], 1), jnp.stack([s, c, zero], 1),
                          jnp.stack([zero, zero, zero + 1.0], 1)], 1)
    rows.append(_box_rows(position, boxes.centre, boxes.half, rotation, scale[MARKER : parts.first_block]))
    if parts.blocks is not None:
        blocks = parts.blocks
        own = scale[parts.first_block : parts.first_round]
        rows.append(_box_rows(position, blocks.centre, blocks.half, blocks.rotation, own))
    if parts.rounds is not None:
        rows.append(_round_rows(position, parts.rounds, scale[parts.first_round :]))
    table = jnp.concatenate(rows)
    if finish is not None:
        extra = jnp.stack([finish.texture.astype(jnp.float32), jnp.where(scale > 0, _inverse(scale), 1.0)], 1)
        table = jnp.concatenate([table, jnp.broadcast_to(extra[:, None], (labels, 4, 2))], 2)
    return table.reshape(labels * 4, row_numbers(scene))


def _box_rows(position, centre, half, rotation, scale) -> jax.Array:
    """(K, 4, 16) rows of boxes; pictures stand upright and unmirrored on the sides of an upright one."""
    own = into_frame(rotation, position - centre)
    sign = jnp.where(own > 0, 1.0, -1.0)
    local = into_frame(rotation, -centre)
    maps = jnp.concatenate([jnp.swapaxes(rotation, 1, 2), local[..., None]], 2)  # (K, axis, 4): world to own axes
    fitted = scale[:, None] <= 0
    factor = jnp.where(fitted, 0.5 / half, _inverse(scale)[:, None])[..., None]
    shift = jnp.where(fitted, 0.5, 0.0) * jnp.array([0, 0, 0, 1.0])
    x, y, z = (maps[:, axis] * factor[:, axis] for axis in range(3))
    right, along = y * sign[:, :1], -x * sign[:, 1:2]
    faces = []
    for axis, (s, t) in enumerate(((right, z), (along, z), (x, y))):
        normal = rotation[:, :, axis] * sign[:, axis : axis + 1]
        faces.append(jnp.concatenate([normal, jnp.zeros((normal.shape[0], 5)), s + shift, t + shift], 1))
    return jnp.stack([*faces, faces[2]], 1)


def _round_rows(position, rounds: Rounds, scale) -> jax.Array:
    """(K, 4, 16) rows of rounds."""
    axis, aside = rounds.axis, across(rounds.axis)
    factor = jnp.where(scale > 0, _inverse(scale), 1.0)[:, None]
    offsets = [-jnp.sum(way * rounds.centre, 1, keepdims=True) for way in (aside, axis)]
    maps = jnp.concatenate([part * factor for pair in zip((aside, axis), offsets, strict=True) for part in pair], 1)
    maps = jnp.broadcast_to(maps[:, None], (maps.shape[0], 4, 8))
    return jnp.concatenate([bent_rows(position, rounds), maps], 2)


def bodies(parts: Parts) -> jax.Array:
    """(labels, BODY) numbers of what has rich looks: a line each, where `face_rows` has four of 16.

    0-2 and 3-5 two axes square to each other; 6-8 centre, 9 half length and 10 inverse radius of a round, whose axis is
    the third one; 0 for boxes.
    """
    sky = ground = jnp.array([[1.0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0]])
    boxes = parts.boxes
    c, s, zero = jnp.cos(boxes.yaw)[:, None], jnp.sin(boxes.yaw)[:, None], jnp.zeros((boxes.yaw.shape[0], 1))
    rows = [sky, ground, jnp.concatenate([c, s, zero, -s, c, zero, boxes.centre, zero, zero], 1)]
    if parts.blocks is not None:
        blocks, flat = parts.blocks, jnp.zeros((parts.blocks.mask.shape[0], 2))
        rows.append(jnp.concatenate([blocks.rotation[:, :, 0], blocks.rotation[:, :, 1], blocks.centre, flat], 1))
    if parts.rounds is not None:
        rounds = parts.rounds
        aside, bend = across(rounds.axis), jnp.stack([rounds.half, 1.0 / jnp.maximum(rounds.radius, 1e-6)], 1)
        rows.append(jnp.concatenate([aside, jnp.cross(rounds.axis, aside), rounds.centre, bend], 1))
    return jnp.concatenate(rows)


def bent_rows(position: jax.Array, rounds: Rounds) -> jax.Array:
    """(K, 4, 8), the first numbers of `face_rows`: faces 0 and 1 curved, 2 and 3 the flat end turned to the camera."""
    axis = rounds.axis
    bend = jnp.stack([rounds.half, 1.0 / jnp.maximum(rounds.radius, 1e-6)], 1)
    curved = jnp.concatenate([axis, rounds.centre, bend], 1)
    side = jnp.sum((position - rounds.centre) * axis, 1, keepdims=True)
    flat = jnp.concatenate([jnp.where(side > 0, axis, -axis), jnp.zeros((axis.shape[0], 5))], 1)
    return jnp.stack([curved, curved, flat, flat], 1)


def _inverse(scale):
    return 1.0 / jnp.where(scale > 0, scale, 1.0)


def _pack(colour: jax.Array) -> jax.Array:
    """Words (...) of colours (..., 3) in [0, 1]."""
    word = jnp.zeros(colour.shape[:-1], jnp.uint32)
    for channel in range(3):
        level = (jnp.clip(colour[..., channel], 0.0, 1.0) * 255.0 + 0.5).astype(jnp.int32).astype(jnp.uint32)
        word = word | (level << (8 * channel))
    return word
