"""Colour of what a ray meets in a world with rich looks: procedural materials, lamps, soft shadows, sunlight, gloss.

One formula draws all materials: cells with joints, a tone by cell, figures, blotches and grain. Which one it is, is
numbers of its label, so that a pixel costs the same whatever it shows. Elementwise, shared by both renderers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from whill_mjx.world.render.textures import random_cell, smooth_noise
from whill_mjx.world.render.visibility import GROUND, Rays, face_normal

NUMBERS = 27
"""Numbers of a material in the table."""
BODY = 11
"""Numbers of a box or a round in the table."""
TOP_FACE = 2
"""The face across a box's third axis; the ground shows it."""
CASTER = 10
"""Numbers of a thing that throws a soft shadow."""
NEAR_SHADOW, FAR_SHADOW = 0.06, 0.35
"""Width of the edge of a soft shadow at the thing's top [m], and its growth per metre below."""
WRAP = 0.3
"""Share of a lamp's light that comes around corners: lamps are wide, and walls throw light back."""


def material_table(materials: Any) -> jax.Array:
    """(L, NUMBERS) of materials: see `shade_rich` for the places."""
    inverse = 1.0 / jnp.maximum(materials.cell, 1e-3)
    columns = [
        materials.paint, materials.second, materials.band_paint, inverse, materials.shift[:, None],
        0.5 * materials.joint[:, None] * inverse, materials.joint_tone[:, None], materials.tone[:, None],
        materials.fill[:, None], materials.blotch[:, None], 1.0 / materials.blotch_size[:, None],
        materials.grain[:, None], 1.0 / materials.grain_size, materials.band, materials.glow[:, None],
        materials.gloss[:, None], materials.figure[:, None],
    ]  # fmt: skip
    return jnp.concatenate(columns, 1)


def shade_rich(view: Any, stage: Any, rays: Rays, hit: Any) -> list:
    """Three arrays: the root of the linear light that comes from what rays meet, or of the sky."""
    lights, seed, seen = view.lights, view.looks.seed, hit.seen
    depth = jnp.where(seen, hit.depth, 0.0)
    point = [view.position[i] + depth * way for i, way in enumerate((rays.x, rays.y, rays.z))]
    code = jnp.where(hit.solid, hit.code, 4 * GROUND + TOP_FACE)
    label = code >> 2
    m = stage.material(label)
    normal, s, t, toward = stage.face(code, point, rays)
    length = jax.lax.rsqrt(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z)
    facing = toward * length
    pixel = depth * (1.0 / view.intrinsics.fy) * jax.lax.rsqrt(jnp.maximum(facing, 0.05))  # m on the surface
    paint, tone = stage.settle(_paint(stage, Surface((s, t), m, label, point[2], pixel), seed))
    light = stage.settle(_light(lights, normal, point, stage))
    glossy = jnp.where(seen & (normal[2] > 0.9), m[25], 0.0)
    mirror = stage.where_some(glossy > 0.0, lambda: _mirror(lights, rays, point, facing), jnp.zeros_like(glossy))
    gleam = glossy * mirror
    looks, height = view.looks, jnp.clip(rays.z * length, 0.0, 1.0)
    colours = []
    for channel in range(3):
        sky = looks.sky_horizon[channel] + height * (looks.sky_zenith[channel] - looks.sky_horizon[channel])
        value = paint[channel] * (tone * light[channel] + m[24]) + gleam * lights.colour[0, channel]
        value = jnp.maximum(value * lights.exposure, 0.0)
        colours.append(jnp.where(seen, jnp.sqrt(value), sky))
    return colours


def face_of_row(row: list, point: list, rays: Rays) -> tuple:
    """Normal of a face that rays meet at a point, the place s, t there [m], and how far a ray's direction goes into it;
    from its numbers in `tables.face_rows`."""
    x, y, z = point
    s, t = (row[i] * x + row[i + 1] * y + row[i + 2] * z + row[i + 3] for i in (8, 12))
    normal = face_normal(row, x, y, z)
    return normal, s, t, jnp.abs(_into(normal, rays))


def _into(normal: list, rays: Rays) -> jax.Array:
    """How far the direction of each ray goes along a normal."""
    return normal[0] * rays.x + normal[1] * rays.y + normal[2] * rays.z


def face_of_body(body: list, face, point: list, rays: Rays) -> tuple:
    """The same, from the BODY numbers of `tables.bodies`: a GPU writes fewer of them.

    Args:
        body: of a box or a round.
        face: across the first, second or third axis of a box; of a round 0 is its side and 2 a flat end.
        point: x, y, z in the world [m].
        rays: that meet it there.
    """
    one, other = body[:3], body[3:6]
    axis = [one[1] * other[2] - one[2] * other[1], one[2] * other[0] - one[0] * other[2],
            one[0] * other[1] - one[1] * other[0]]  # fmt: skip
    away = [point[i] - body[6 + i] for i in range(3)]
    x, y, z = (sum(way[i] * away[i] for i in range(3)) for way in (one, other, axis))
    is_round, first, second = body[10] > 0.0, face == 0, face == 1
    along = jnp.minimum(jnp.maximum(z, -body[9]), body[9])
    normal = []
    for i in range(3):
        side = jnp.where(is_round, (away[i] - along * axis[i]) * body[10], one[i])
        normal.append(jnp.where(first, side, jnp.where(second, other[i], axis[i])))
    into = _into(normal, rays)
    sign = jnp.where(into > 0.0, -1.0, 1.0)
    s = jnp.where(is_round, x, jnp.where(first, y * sign, jnp.where(second, -x * sign, x)))
    t = jnp.where(is_round | first | second, z, y)
    return [value * sign for value in normal], s, t, jnp.abs(into)


class Surface(NamedTuple):
    """Where rays meet a surface, and what it is made of."""

    place: tuple  # s, t on the face [m]
    material: list  # NUMBERS of them, see `material_table`
    label: jax.Array
    height: jax.Array  # above the floor [m]
    pixel: jax.Array  # size of a pixel on it [m]


def _paint(stage: Any, surface: Surface, seed: jax.Array) -> tuple[list, jax.Array]:
    """Reflectance of a surface, and the factor on it of cells, joints, blotches and grain."""
    (s, t), m, label, z, pixel = surface
    own = stage.small(label.astype(jnp.uint32)) * 17.0
    b = t * m[10] + 0.37
    line = stage.floor(b)
    a = s * m[9] + m[11] * line + 0.19
    column = stage.floor(a)
    lot = random_cell(a, b, own + 0.5, seed, stage.whole)
    other = lot * 61.0 - stage.floor(lot * 61.0)
    cells = jnp.maximum(m[9], m[10]) * pixel  # cells in a pixel
    fine = stage.ratio(1.0, 1.0 + 4.0 * cells * cells)
    at_joint = jnp.maximum(jnp.abs(a - column - 0.5) + m[12], jnp.abs(b - line - 0.5) + m[13]) > 0.5
    thin = jnp.minimum(1.0, stage.ratio(2.0 * jnp.maximum(m[12], m[13]), cells + 1e-6))  # a joint thinner than a pixel
    joint = jnp.where(at_joint, m[14] * fine * jnp.maximum(thin, 0.35), 0.0)
    blotch = smooth_noise(s * m[18] + own, t * m[18], seed, stage) - 0.5
    grains = jnp.maximum(m[20], m[21]) * pixel
    grain = (smooth_noise(s * m[20], t * m[21] + own, seed, stage) - 0.5) * stage.ratio(1.0, 1.0 + grains * grains)
    tone = (1.0 + 2.0 * m[15] * fine * (lot - 0.5)) * (1.0 + 2.0 * m[17] * blotch) * (1.0 + 2.0 * m[19] * grain)
    filled = jnp.where(jnp.where(m[26] < 0.0, other, jnp.abs(blotch + (0.5 - m[26]))) < m[16], 1.0, 0.0)
    filled = m[16] + fine * (filled - m[16])
    banded = (z > m[22]) & (z < m[23])
    paint = []
    for channel in range(3):
        value = m[channel] + filled * (m[3 + channel] - m[channel])
        paint.append(jnp.where(banded, m[6 + channel], value))
    return paint, jnp.maximum(jnp.where(banded, 1.0 + 0.5 * m[17] * blotch, tone * (1.0 - joint)), 0.0)


class Everywhere:
    """The part of a `Stage` that may skip work, skipping nothing: all points are drawn together."""

    @staticmethod
    def where_some(condition, compute: Callable, otherwise) -> Any:
        return compute()

    @staticmethod
    def soft_shadow(casters, x, y, z) -> jax.Array:
        return shadow_factor(casters, x, y, z)


def _light(lights, normal, point, stage: Any = Everywhere) -> list:
    """Light on a surface, for each channel: ambient, lamps, soft shadows near the floor, and a patch of sunlight."""
    x, y, z = point
    sky = 0.8 + 0.2 * normal[2]
    near = jnp.clip((lights.half_width - jnp.abs(y)) * 4.0, 0.0, 1.0)
    corner = jnp.where(normal[2] > 0.5, 0.75 + 0.25 * near, 0.78 + 0.22 * jnp.clip(z * 4.0, 0.0, 1.0))
    open_ = corner * stage.soft_shadow(lights.caster, x, y, z)
    light = [lights.ambient[i] * sky * open_ for i in range(3)]
    for lamp in range(lights.position.shape[0]):
        to = [lights.position[lamp, axis] - point[axis] for axis in range(3)]
        square = to[0] * to[0] + to[1] * to[1] + to[2] * to[2] + 0.15
        inverse = jax.lax.rsqrt(square)
        cosine = (to[0] * normal[0] + to[1] * normal[1] + to[2] * normal[2]) * inverse
        strength = jnp.maximum(WRAP + (1.0 - WRAP) * cosine, 0.05) * inverse * inverse * open_
        light = [light[i] + strength * lights.colour[lamp, i] for i in range(3)]
    sunny = (lights.sunlight[0] > 0.0) & (x == x)
    patch = stage.where_some(sunny, lambda: _sun_patch(lights, normal, point), jnp.zeros_like(x))
    return [light[i] + patch * lights.sunlight[i] for i in range(3)]


def _sun_patch(lights, normal, point) -> jax.Array:
    """Share of the sunlight that falls through the window onto a surface."""
    x, y, z = point
    back = jnp.abs(lights.window[0] - y) / jnp.abs(lights.sun[1])  # way back to the plane of the window
    beside = jnp.abs(x + back * lights.sun[0] - lights.window[1])
    above = jnp.abs(z + back * lights.sun[2] - lights.window[2])
    inside = jnp.clip((lights.window[3] - beside) * 12.0, 0.0, 1.0)
    inside = inside * jnp.clip((lights.window[4] - above) * 12.0, 0.0, 1.0)
    inside = inside * jnp.clip(beside * 20.0 - 0.3, 0.0, 1.0)  # the bar in the middle of the window
    cosine = normal[0] * lights.sun[0] + normal[1] * lights.sun[1] + normal[2] * lights.sun[2]
    return inside * jnp.maximum(cosine, 0.0)


def shadow_factor(casters, x, y, z) -> jax.Array:
    """Share of the light that things leave to a point: soft, darkest at their foot, and away from the lamps."""
    factor = jnp.ones_like(x)
    for index in range(casters.shape[0]):
        factor = factor * caster_factor([casters[index, i] for i in range(CASTER)], x, y, z)
    return factor


def caster_factor(c: list, x, y, z) -> jax.Array:
    """The share that one thing leaves, from its CASTER numbers."""
    rise = jnp.maximum(c[6] - z, 0.0)  # of the thing above the point
    dx, dy = x - c[0] - 0.5 * rise * c[7], y - c[1] - 0.5 * rise * c[8]
    along, across = jnp.abs(dx * c[2] + dy * c[3]), jnp.abs(dy * c[2] - dx * c[3])
    reach = 0.5 * rise * jnp.maximum(jnp.abs(c[7]), jnp.abs(c[8]))
    out = jnp.maximum(along - c[4] - reach, across - c[5] - reach)
    soft = jnp.clip(1.0 - out / (NEAR_SHADOW + FAR_SHADOW * rise), 0.0, 1.0)
    return 1.0 - c[9] * soft * soft * jnp.minimum(rise * 4.0, 1.0)


def caster_reach(c: list) -> tuple:
    """How far from a thing's place (c[0], c[1]) its shadow can be, along x and y [m]; it is below c[6]."""
    aside = 0.5 * c[6] * jnp.maximum(jnp.abs(c[7]), jnp.abs(c[8])) + NEAR_SHADOW + FAR_SHADOW * c[6]
    long, wide, cos, sin = c[4] + aside, c[5] + aside, jnp.abs(c[2]), jnp.abs(c[3])
    x, y = cos * long + sin * wide, sin * long + cos * wide
    return x + 0.5 * c[6] * jnp.abs(c[7]), y + 0.5 * c[6] * jnp.abs(c[8])


def _mirror(lights, rays: Rays, point, facing) -> jax.Array:
    """Strength of the lamps' mirror image in a smooth floor."""
    up = jnp.maximum(jnp.abs(rays.z), 1e-3)
    total = 0.0
    for lamp in range(lights.position.shape[0]):
        way = (lights.position[lamp, 2] - point[2]) / up
        dx, dy = point[0] + way * rays.x - lights.position[lamp, 0], point[1] + way * rays.y - lights.position[lamp, 1]
        far = 1.0 + 3.0 * (dx * dx + 4.0 * dy * dy)
        total = total + 1.0 / (far * far)
    glance = 1.0 - facing
    return total * (0.08 + 0.9 * glance * glance * glance)


def floor_light(lights: Any, x, y) -> jax.Array:
    """() mean light on the floor and the walls near a point, for the exposure control."""
    up = (0.0, 0.0, 1.0)
    return sum(_light(lights, up, (x, y, 0.4 + 0.0 * x))) / 3.0  # type: ignore[arg-type, return-value]
