"""How a furnished room looks: materials, lights and film of one world, drawn at random inside the reset.

Colours are reflectances of linear light.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.eye import draw_eye
from whill_mjx.world.rich import (
    CEILING,
    DOOR,
    FLOOR,
    FRAME,
    LAMP,
    LIGHTS,
    MARKER,
    OBSTACLE,
    PANEL,
    PERSON,
    POLE,
    POSTER,
    THING,
    THINGS,
    TOP,
    WALL,
    WINDOW,
    Draws,
    Lights,
    Materials,
    Rich,
    pictures_of,
    roles_of,
)  # fmt: skip
from whill_mjx.world.scene import Scene

PROPERTIES = ("value", "saturation", "second", "cell_s", "cell_t", "shift", "joint", "joint_tone", "tone", "fill",
              "blotch", "blotch_size", "grain", "grain_s", "grain_t", "gloss", "figure")  # fmt: skip
_LOG = ("cell_s", "cell_t", "blotch_size", "grain_s", "grain_t", "value")
"""Properties whose logarithm is uniform."""
PLAIN: dict[str, tuple[float, float]] = {
    "value": (0.3, 0.8), "saturation": (0.0, 0.15), "second": (0.7, 1.3), "cell_s": (1.0, 3.0), "cell_t": (1.0, 3.0),
    "shift": (0.0, 0.0), "joint": (0.0, 0.0), "joint_tone": (-0.2, 0.6), "tone": (0.0, 0.02), "fill": (0.0, 0.0),
    "blotch": (0.0, 0.12), "blotch_size": (0.2, 1.5), "grain": (0.0, 0.1), "grain_s": (0.01, 0.06),
    "grain_t": (0.01, 0.06), "gloss": (0.0, 0.0), "figure": (-1.0, -1.0),
}  # fmt: skip
FAMILIES: dict[str, dict[str, tuple[float, float]]] = {
    "plaster": {"value": (0.35, 0.85)},
    "brick": {"value": (0.12, 0.6), "saturation": (0.1, 0.6), "cell_s": (0.18, 0.42), "cell_t": (0.06, 0.2),
              "shift": (0.5, 0.5), "joint": (0.006, 0.016), "joint_tone": (-0.8, 0.6), "tone": (0.05, 0.35),
              "grain": (0.05, 0.25), "blotch": (0.0, 0.2)},
    "panels": {"value": (0.25, 0.85), "cell_s": (0.3, 1.4), "cell_t": (0.5, 3.0), "joint": (0.003, 0.02),
               "joint_tone": (0.1, 0.7), "tone": (0.0, 0.08), "gloss": (0.0, 0.1)},
    "tiles": {"value": (0.1, 0.7), "cell_s": (0.1, 0.65), "cell_t": (0.1, 0.65), "joint": (0.003, 0.012),
              "joint_tone": (-0.5, 0.9), "tone": (0.0, 0.15), "fill": (-0.5, 0.5), "second": (0.4, 1.5),
              "gloss": (0.0, 0.4)},
    "planks": {"value": (0.08, 0.5), "saturation": (0.2, 0.7), "cell_s": (0.6, 2.2), "cell_t": (0.07, 0.22),
               "shift": (0.23, 0.5), "joint": (0.002, 0.008), "joint_tone": (0.2, 0.8), "tone": (0.05, 0.3),
               "grain": (0.05, 0.35), "grain_s": (0.15, 0.6), "grain_t": (0.006, 0.03), "gloss": (0.0, 0.3)},
    "carpet": {"value": (0.06, 0.45), "saturation": (0.0, 0.5), "grain": (0.1, 0.5), "grain_s": (0.008, 0.05),
               "grain_t": (0.008, 0.05), "cell_s": (0.4, 1.0), "cell_t": (0.4, 1.0), "tone": (0.0, 0.12),
               "blotch": (0.0, 0.2)},
    "concrete": {"value": (0.12, 0.5), "saturation": (0.0, 0.08), "blotch": (0.05, 0.35), "grain": (0.0, 0.2),
                 "joint": (0.0, 0.012)},
    "linoleum": {"value": (0.1, 0.5), "saturation": (0.0, 0.35), "cell_s": (0.015, 0.06), "cell_t": (0.015, 0.06),
                 "fill": (0.0, 0.5), "second": (0.5, 1.6), "gloss": (0.1, 0.6)},
    "stones": {"value": (0.1, 0.6), "saturation": (0.0, 0.2), "cell_s": (0.03, 0.15), "cell_t": (0.03, 0.15),
               "shift": (0.1, 0.5), "fill": (0.1, 0.6), "second": (0.2, 2.5), "tone": (0.0, 0.4), "gloss": (0.0, 0.4)},
    "print": {"value": (0.1, 0.9), "saturation": (0.0, 0.8), "cell_s": (0.03, 0.3), "cell_t": (0.02, 0.2),
              "fill": (0.1, 0.7), "second": (0.1, 3.0), "tone": (0.0, 0.5)},
    "stripes": {"value": (0.2, 0.8), "saturation": (0.0, 0.3), "cell_s": (0.03, 0.4), "cell_t": (20.0, 30.0),
                "fill": (0.3, 0.6), "second": (0.6, 1.4), "tone": (0.0, 0.2)},
    "figured": {"value": (0.06, 0.6), "saturation": (0.0, 1.0), "fill": (0.3, 0.55), "second": (0.15, 4.0),
                "figure": (-0.7, 0.7), "blotch_size": (0.06, 0.5), "blotch": (0.0, 0.05), "grain": (0.0, 0.4),
                "gloss": (0.0, 0.1)},
    "cardboard": {"value": (0.15, 0.45), "saturation": (0.35, 0.75), "cell_s": (0.08, 0.25), "cell_t": (0.06, 0.2),
                  "fill": (-0.2, 0.15), "second": (0.1, 2.5), "grain": (0.0, 0.15), "blotch": (0.0, 0.2)},
    "paint": {"value": (0.03, 0.85), "saturation": (0.0, 0.9), "gloss": (0.0, 0.05)},
    "black": {"value": (0.01, 0.08), "saturation": (0.0, 0.2)},
    "metal": {"value": (0.15, 0.7), "saturation": (0.0, 0.05), "grain_s": (0.2, 0.5), "grain_t": (0.004, 0.01)},
}  # fmt: skip
BOLD, BOLDEST = 0.5, 4.0
"""Share of the worlds whose patterns and colours are bolder than usual, and by how much they are at most."""
BOLD_LIMITS = {"joint": (0.0, 0.03), "joint_tone": (-1.5, 0.95), "tone": (0.0, 0.7), "blotch": (0.0, 0.6),
               "grain": (0.0, 0.7)}  # fmt: skip
WARM = ("brick", "planks", "cardboard")
"""Families whose hue lies between red and yellow."""
CHOICE: dict[int, tuple[str, ...]] = {
    FLOOR: ("tiles", "planks", "carpet", "concrete", "linoleum", "plaster", "stones", "brick", "figured", "figured"),
    MARKER: ("plaster",),
    WALL: ("plaster", "plaster", "brick", "panels", "tiles", "concrete", "planks", "stripes", "figured"),
    OBSTACLE: ("cardboard", "cardboard", "cardboard", "cardboard", "paint", "print", "planks", "black"),
    THING: ("paint", "black", "metal", "planks", "print", "cardboard", "plaster", "paint"),
    PANEL: ("plaster", "plaster", "planks", "paint", "panels"),
    CEILING: ("plaster", "plaster", "tiles", "panels", "concrete", "planks"),
    LAMP: ("plaster",),
    FRAME: ("paint", "metal", "planks", "plaster"),
    DOOR: ("planks", "paint", "plaster", "panels"),
    POSTER: ("print", "print", "paint", "figured"),
    WINDOW: ("plaster",),
    POLE: ("black", "metal", "plaster"),
    TOP: ("paint", "black", "planks", "metal", "print"),
    PERSON: ("paint", "paint", "black", "stripes", "print", "figured"),
}
_NAMES = tuple(FAMILIES)
_RANGES = np.array(
    [[{**PLAIN, **FAMILIES[name]}[p] for p in PROPERTIES] for name in _NAMES], np.float32
)  # (F, properties, 2)
_IS_LOG = np.array([p in _LOG for p in PROPERTIES])
_CHOICES = 24
_CHOICE = np.array(
    [[_NAMES.index(CHOICE[role][i * len(CHOICE[role]) // _CHOICES]) for i in range(_CHOICES)] for role in range(15)]
)


def paint(key: jax.Array, scene: Scene) -> Scene:
    """The furnished scene with materials, lights and film drawn anew; shapes and places stay."""
    material_key, light_key, eye_key, seed_key = jax.random.split(key, 4)
    roles = roles_of(scene)
    rich = Rich(_materials(material_key, roles), _lights(light_key, scene), draw_eye(eye_key))
    sky_key, seed_key = jax.random.split(seed_key)
    sky = jax.random.uniform(sky_key, (2, 3), minval=0.5, maxval=0.95) * jnp.array([0.95, 1.0, 1.05])
    looks = dataclasses.replace(
        scene.looks, seed=jax.random.bits(seed_key, dtype=jnp.uint32), sky_horizon=sky[0], sky_zenith=sky[0] * sky[1]
    )
    return dataclasses.replace(scene, rich=rich, looks=looks)


def _materials(key: jax.Array, roles: np.ndarray) -> Materials:
    """Materials of labels with these roles. Most walls look alike, and so do doors, frames and lamps."""
    labels, width = roles.shape[0], len(PROPERTIES) + 16
    own_key, shared_key, alike_key, bold_key = jax.random.split(key, 4)
    own = jax.random.uniform(own_key, (labels, width))
    shared = jax.random.uniform(shared_key, (14, width))[np.minimum(roles, 13)]
    alike = np.isin(roles, (FLOOR, WALL, FRAME, DOOR, LAMP, CEILING))
    alike = alike & (jax.random.uniform(alike_key, (labels,)) < 0.8)
    u = jnp.where(alike[:, None], shared, own)
    family = jnp.asarray(_CHOICE)[roles, (u[:, 0] * _CHOICES).astype(jnp.int32)]
    ranges = jnp.asarray(_RANGES)[family]  # (L, properties, 2)
    part = u[:, 1 : 1 + len(PROPERTIES)]
    low, high = ranges[..., 0], ranges[..., 1]
    level = low + part * (high - low)
    scaled = jnp.exp(jnp.log(jnp.maximum(low, 1e-3)) + part * jnp.log(jnp.maximum(high, 1e-3) / jnp.maximum(low, 1e-3)))
    value = dict(zip(PROPERTIES, jnp.where(_IS_LOG, scaled, level).T, strict=True))
    value = _bold(value, *jax.random.uniform(bold_key, (2,)))
    rest = u[:, 1 + len(PROPERTIES) :]
    figured = family == _NAMES.index("figured")
    warm = jnp.isin(family, jnp.array([_NAMES.index(name) for name in WARM]))
    base, other = _two_paints(value, rest, warm, figured, roles == FLOOR)
    square = (family == _NAMES.index("tiles")) & (rest[:, 3] < 0.7)
    cell = jnp.stack([value["cell_s"], jnp.where(square, value["cell_s"], value["cell_t"])], 1)
    cell = jnp.where(figured[:, None], value["blotch_size"][:, None], cell)
    level = jnp.where(figured, jnp.maximum(value["figure"], 0.0), -1.0)
    fill = jnp.clip(value["fill"], 0.0, 1.0) * jnp.where(level > 0.0, 0.2, 1.0)  # rings are thin

    is_wall, is_carton = roles == WALL, roles == OBSTACLE
    # Walls have a skirting or a painted lower part, cartons a band of tape or print.
    low, high = 0.04 + 0.12 * rest[:, 5], 0.8 + 0.5 * rest[:, 5]
    skirting = jnp.where(rest[:, 4] < 0.55, low, jnp.where(rest[:, 4] < 0.75, high, 0.0))
    tape = 0.05 + 0.6 * rest[:, 5]
    none = jnp.full(labels, -1.0)
    top = jnp.where(is_wall, skirting, jnp.where(is_carton & (rest[:, 4] < 0.5), tape + 0.02 + 0.1 * rest[:, 6], none))
    foot = jnp.where(is_carton, tape, none)
    never = np.zeros(labels, bool)
    band = _reflectance(0.03 + 0.8 * rest[:, 7] ** 2, 0.5 * rest[:, 8], rest[:, 9], never, never)

    blue = jnp.stack([0.01 + 0.06 * rest[:, 10], 0.02 + 0.14 * rest[:, 11], 0.35 + 0.5 * rest[:, 12]], 1)
    is_marker, is_lamp, is_window = roles == MARKER, roles == LAMP, roles == WINDOW
    base = jnp.where(is_marker[:, None], blue, base)
    glow = jnp.where(is_lamp, 1.0 + 4.0 * rest[:, 13], jnp.where(is_window, 0.3 + 2.0 * rest[:, 13], 0.0))
    calm = jnp.where(is_marker, 0.5, 1.0)
    return Materials(
        paint=base, second=other, band_paint=band, cell=cell, shift=value["shift"], joint=value["joint"],
        joint_tone=value["joint_tone"], tone=value["tone"] * calm, fill=fill, figure=level,
        blotch=value["blotch"] * calm, blotch_size=value["blotch_size"], grain=value["grain"] * calm,
        grain_size=jnp.stack([value["grain_s"], value["grain_t"]], 1), band=jnp.stack([foot, top], 1), glow=glow,
        gloss=value["gloss"],
    )  # fmt: skip


def _two_paints(value: dict[str, jax.Array], rest: jax.Array, warm, figured, blue) -> list[jax.Array]:
    """(L, 3) reflectances of the ground of each material and of what is filled.

    Where `blue`, they may be as blue as the marker: on the floor, for the marker stands.
    """
    odd = rest[:, 14] < 0.12  # a tail of saturated paints
    ground = jnp.where(odd, jnp.sqrt(value["saturation"]), value["saturation"])
    filled = jnp.where(figured, 1.0, value["saturation"]) * rest[:, 1]  # figures have a colour of their own
    second = jnp.clip(value["value"] * value["second"], 0.02, 0.9)
    paints = (value["value"], ground, rest[:, 0]), (second, filled, rest[:, 2])
    return [_reflectance(*one, warm, blue) for one in paints]


def _bold(value: dict[str, jax.Array], chance: jax.Array, size: jax.Array) -> dict[str, jax.Array]:
    """Properties of a world that is drawn bolder than its materials usually are, for a BOLD share of the worlds.

    The ranges are those of real materials; a policy that has seen no stronger pattern or colour takes one for a thing.
    """
    times = jnp.where(chance < BOLD, 1.0 + (BOLDEST - 1.0) * size, 1.0)
    wider = {name: jnp.clip(times * value[name], *limits) for name, limits in BOLD_LIMITS.items()}
    second = jnp.clip(value["second"], 0.05) ** times
    saturation = jnp.clip(value["saturation"] + (times - 1.0) * 0.25 * value["saturation"] ** 0.5, 0.0, 1.0)
    return {**value, **wider, "second": jnp.clip(second, 0.02, 10.0), "saturation": saturation}


def _reflectance(value, saturation, hue, warm, blue) -> jax.Array:
    """(L, 3) reflectance of a grey `value`, made more or less colourful; few are saturated.

    Where not `blue`, it is no saturated blue, as the marker is.
    """
    saturation = saturation * jnp.where(warm, 1.0, saturation)  # squares where any hue is allowed: a tail of odd ones
    turn = 2 * jnp.pi * jnp.where(warm, 0.02 + 0.12 * hue, hue)
    angles = jnp.stack([turn, turn - 2 * jnp.pi / 3, turn + 2 * jnp.pi / 3], 1)
    colour = jnp.clip(value[:, None] * (1.0 + saturation[:, None] * jnp.cos(angles)), 0.01, 0.95)
    most = jnp.maximum(colour[:, 0], colour[:, 1])
    return colour.at[:, 2].set(jnp.where(blue, colour[:, 2], jnp.minimum(colour[:, 2], 1.5 * most + 0.02)))


def light_colour(kelvin) -> jax.Array:
    """(..., 3) colour of a lamp at 2,700 to 6,500 K, 1 in its mean: the black body's line by a fit."""
    cool = (kelvin - 2700.0) / 3800.0
    colour = jnp.stack([1.5 - 0.5 * cool, 1.0 + 0.02 * cool, 0.5 + 0.48 * cool], -1)
    return colour / jnp.mean(colour, -1, keepdims=True)


def _lights(key: jax.Array, scene: Scene) -> Lights:
    """Lamps of different power, so that the light varies by up to 1:20 along the way, and what throws shadows."""
    draw, ghosts = Draws(key, 80), scene.ghosts
    assert ghosts is not None
    ceiling = ghosts.centre[0, 2]
    begin, end = ghosts.centre[0, 0] - ghosts.half[0, 0], ghosts.centre[0, 0] + ghosts.half[0, 0]
    half_width = ghosts.half[0, 1] - 0.2
    step = (end - begin) / LIGHTS
    x = begin + step * (jnp.arange(LIGHTS) + draw(0.0, 1.0, (LIGHTS,)))
    position = jnp.stack([x, draw(-0.7, 0.7, (LIGHTS,)), jnp.broadcast_to(ceiling - 0.1, (LIGHTS,))], 1)
    power = jnp.exp(draw(-2.3, 0.7, (LIGHTS,)) * draw(0.2, 1.0)) * 2.5
    kelvin = draw(2700.0, 6500.0) + draw(-600.0, 600.0, (LIGHTS,))
    colour = power[:, None] * light_colour(jnp.clip(kelvin, 2700.0, 6500.0))
    ambient = jnp.exp(draw(-2.0, -0.3)) * light_colour(draw(3500.0, 6500.0))

    side = jnp.where(draw.chance(0.5), 1.0, -1.0)
    slope, azimuth = draw(0.3, 0.9), draw(-1.0, 1.0)
    sun = jnp.stack([azimuth, side, slope])
    sun = sun / jnp.linalg.norm(sun)
    strength = draw(0.5, 4.0) * draw.chance(0.3)
    middle = side * half_width, draw(begin + 0.5, end - 0.5), draw(1.2, 1.8)
    window = jnp.stack([*middle, draw(0.2, 0.8), draw(0.2, 0.6)])

    casters = _casters(draw, scene, position, power)
    return Lights(
        ambient=ambient, position=position, colour=colour, half_width=half_width, sun=sun,
        sunlight=strength * light_colour(jnp.asarray(5200.0)), window=window, caster=casters, exposure=jnp.ones(()),
    )  # fmt: skip


def _casters(draw: Draws, scene: Scene, position, power) -> jax.Array:
    """(C, 10) numbers of what throws soft shadows on the floor: obstacles, things and the board."""
    # Not the walls: the first three, and the back one before the things.
    own = scene.boxes.yaw.shape[0] - pictures_of(scene)
    back = own - THINGS - 2
    solid = jax.tree.map(lambda leaf: jnp.concatenate([leaf[3:back], leaf[back + 1 : own]]), scene.boxes)
    offset = solid.centre[:, None, :2] - position[:, :2]  # (C, LIGHTS, 2)
    high = position[:, 2] - solid.centre[:, None, 2]
    weight = power / (jnp.sum(offset**2, -1) + high**2)
    share = weight / jnp.sum(weight, 1, keepdims=True)
    shift = jnp.sum((share / high)[..., None] * offset, 1) * draw(0.4, 1.2)
    strength = draw(0.2, 0.85) * solid.mask
    height = jnp.minimum(2.0 * solid.half[:, 2], 1.0)
    return jnp.concatenate([
        solid.centre[:, :2], jnp.cos(solid.yaw)[:, None], jnp.sin(solid.yaw)[:, None], solid.half[:, :2],
        height[:, None], jnp.clip(shift, -1.2, 1.2), strength[:, None],
    ], 1)  # fmt: skip
