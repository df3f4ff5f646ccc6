"""Colour of what a ray meets: one definition for both renderers.

A `View` holds the numbers of one image. A `Stage` answers the questions that the renderers answer differently: which
primitive is nearest, what a table says about a face, whether a point lies in shadow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from whill_mjx.world.materials import Finish
from whill_mjx.world.render.camera import Intrinsics, pixel_rays
from whill_mjx.world.render.rich import shade_rich
from whill_mjx.world.render.textures import random_cell, texture
from whill_mjx.world.render.visibility import FAR, GROUND, MARKER, Rays, bits_to_float, face_normal, key_of, rays_of
from whill_mjx.world.scene import Looks

SEAM = 0.35
"""Height over which boxes are darkened towards the ground, as by ambient occlusion [m]."""
SAMPLES = ((0.25, 0.375), (0.375, 0.75), (0.625, 0.25), (0.75, 0.625))
"""Places of the anti-aliasing samples in a pixel: no two share a row or column, so that level edges blend too."""


@dataclass(frozen=True)
class Quality:
    """What an image may cost beyond the plain one. Static: each choice is compiled apart."""

    antialias: bool = False
    """Blend edges by the coverage of four samples in each pixel."""
    shadows: bool = False
    """Hard shadows of the sun."""
    keep: int | None = None
    """jnp renderer: boxes tested in each strip of the image, the nearest ones that it can show; None tests all."""
    strips: int = 8
    """jnp renderer: upright strips in which `keep` counts."""


@struct.dataclass
class View:
    """Numbers of one image; in the kernel every leaf is a scalar."""

    position: Any  # (3,)
    rotation: Any  # (3, 3) camera to world
    intrinsics: Intrinsics
    looks: Looks
    finish: Finish | None  # without its tables per label
    lights: Any = None  # of rich looks; None without


class Hit(NamedTuple):
    """What rays meet."""

    key: Any  # depth and code of the nearest thing, the ground included
    code: Any  # 4 * label + face of the nearest solid; 0 where it is not the nearest thing
    depth: Any  # m along the optical axis
    solid: Any  # bool: a solid or the marker
    seen: Any  # bool: that or the ground


class Stage(Protocol):
    """Answers of one renderer."""

    @property
    def bits(self) -> int:
        """Bits of the code in a key."""

    @property
    def lit_words(self) -> bool:
        """Whether the words already hold the light of the flat faces."""

    @property
    def first_bent(self) -> int | None:
        """Where `lit_words`: the first code of a round, whose words hold no light; None without rounds."""

    @property
    def picture(self) -> Any:
        """Function (number, s, t) -> colour of a picture of the atlas; None without one."""

    def nearest(self, rays: Rays) -> Any:
        """Key of the nearest solid."""

    def word(self, code) -> Any:
        """Colour of a face as blue << 16 | green << 8 | red."""

    def dark_word(self, code) -> Any:
        """The same in shadow."""

    def invert(self, x) -> Any:
        """1 / x for the depth along a ray."""

    def ratio(self, x, y) -> Any:
        """x / y."""

    def whole(self, x) -> Any:
        """Largest integer not above x, as int32."""

    def floor(self, x) -> Any:
        """The same as float. Both may be one less where x is whole, but agree."""

    def small(self, integer) -> Any:
        """A uint32 below 2^23 as float."""

    def level(self, value) -> Any:
        """Grey level 0 to 255, as int32, of a value that is cut to [0, 1]."""

    def settle(self, values) -> Any:
        """The same values, computed once for all that use them."""

    def row(self, code) -> list:
        """Numbers of a face: see `tables.face_rows`."""

    def material(self, label) -> list:
        """Numbers of a label's material: see `render.rich`."""

    def face(self, code, point: list, rays: Rays) -> tuple:
        """Normal of a face where rays meet it, the place s, t on it [m], and how far a ray's direction goes into it."""

    def bent(self, place) -> list:
        """Numbers of a face of a round, by its code less `first_bent`: see `tables.bent_rows`."""

    def shadow(self, x, y, z) -> Any:
        """Bool: is a point hidden from the sun?"""

    def soft_shadow(self, casters, x, y, z) -> Any:
        """Share of the light that things leave to points: see `rich.shadow_factor`."""

    def where_some(self, condition, compute: Callable, otherwise) -> Any:
        """`compute()`, or `otherwise`, of the same shapes, where the condition holds for no pixel that is drawn with
        this one. So the two must not differ where the condition does not hold, or nothing may read them there."""


def cast(view: View, stage: Stage, rays: Rays) -> Hit:
    """What these rays meet."""
    mask = (1 << stage.bits) - 1
    ground = -view.position[2] * rays.inverse_z
    key = stage.nearest(rays)
    ground_key = jnp.where(ground > 0, key_of(ground, 4 * GROUND, stage.bits), np.int32(FAR))
    solid = key < ground_key
    depth = jnp.where(solid, bits_to_float(key & ~mask), jnp.where(ground > 0, ground, jnp.inf))
    return Hit(jnp.minimum(key, ground_key), key & mask, depth, solid, solid | (ground > 0))


def pixel_colours(view: View, stage: Stage, quality: Quality, row, column) -> list:
    """Three arrays in [0, 1]: colours of the pixels at `row` and `column`."""
    if not quality.antialias:
        centre = pixel_view(view, stage, row, column)
        return shade(view, stage, quality, centre, cast(view, stage, centre))
    shape = (len(SAMPLES), *jnp.broadcast_shapes(row.shape, column.shape))
    sample = jax.lax.broadcasted_iota(jnp.int32, shape, 0)
    rays = pixel_view(view, stage, row[None], column[None], _place(sample))
    key = stage.settle(cast(view, stage, rays).key)
    mask = (1 << stage.bits) - 1
    front, back = jnp.min(key, 0), jnp.max(key, 0)
    share = jnp.sum(jnp.where((key & mask) == (front & mask)[None], 0.25, 0.0), 0)

    def colours_of(chosen) -> list:
        first = jnp.min(jnp.where(key == chosen[None], sample, len(SAMPLES)), 0)
        one = pixel_view(view, stage, row, column, _place(first))
        return shade(view, stage, quality, one, _hit_of(view, stage, one, chosen))

    nearest = colours_of(front)  # the only one where all samples meet one surface: its share is 1
    behind = stage.where_some(share < 1.0, lambda: colours_of(back), nearest)
    return [share * a + (1.0 - share) * b for a, b in zip(nearest, behind, strict=True)]


def _place(sample) -> tuple:
    """Row and column within the pixel of samples by number."""
    place: list = list(SAMPLES[0])
    for index, other in enumerate(SAMPLES[1:], 1):
        place = [jnp.where(sample == index, new, old) for new, old in zip(other, place, strict=True)]
    return tuple(place)


def _hit_of(view: View, stage: Stage, rays: Rays, key) -> Hit:
    """The hit that a key of `cast` stands for."""
    mask = (1 << stage.bits) - 1
    seen = key < FAR
    solid = seen & ((key & mask) >= 4 * MARKER)
    depth = jnp.where(solid, bits_to_float(key & ~mask), -view.position[2] * rays.inverse_z)
    return Hit(key, key & mask, jnp.where(seen, depth, jnp.inf), solid, seen)


def pixel_view(view: View, stage: Stage, row, column, shift=(0.5, 0.5)) -> Rays:
    """Rays through the place `shift` of pixels."""
    return rays_of(view.rotation, *pixel_rays(view.intrinsics, row, column, shift), stage.invert)


def shade(view: View, stage: Stage, quality: Quality, rays: Rays, hit: Hit) -> list:
    """Colours of what the rays meet: paint, texture, light, grain, darker foot, tiles of the ground, sky and fog."""
    if not stage.lit_words or stage.first_bent is not None or quality != Quality():
        rays, hit = stage.settle((rays, hit))
    if view.lights is not None:
        return shade_rich(view, stage, rays, hit)
    looks, origin = view.looks, view.position
    box, seen = hit.solid, hit.seen
    depth = jnp.where(seen, hit.depth, 0.0)
    x, y, z = origin[0] + depth * rays.x, origin[1] + depth * rays.y, origin[2] + depth * rays.z

    ratio = stage.ratio
    tile_x, tile_y = ratio(x - looks.tile_offset[0], looks.tile), ratio(y - looks.tile_offset[1], looks.tile)
    odd = (stage.whole(tile_x) + stage.whole(tile_y)) & 1
    fine = ratio(1.0, 1.0 + 0.05 * depth * depth)  # texture finer than a pixel fades into its mean
    cell = jnp.where(box, 10.0, 10.0 / looks.tile)
    above = jnp.where(box, z * 10.0 + 0.41, 0.0)
    noise = random_cell(x * cell + 0.37, y * cell + 0.59, above, looks.seed, stage.whole) - 0.5
    noise = 1.0 + 2.0 * jnp.where(box, looks.grain, looks.noise) * fine * noise
    foot = 0.72 + 0.28 * jnp.clip(z / SEAM, 0.0, 1.0)
    mix = 0.5 + (odd.astype(jnp.float32) - 0.5) * ratio(1.0, 1.0 + 0.01 * depth * depth)
    height = jnp.clip(rays.z * jax.lax.rsqrt(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z), 0.0, 1.0)

    shadow = stage.settle(stage.shadow(x, y, z)) if quality.shadows else None
    lit = looks.ambient + looks.diffuse * jnp.maximum(looks.sun[2], 0.0)
    if shadow is not None:
        lit = jnp.where(shadow, looks.ambient, lit)
    word = stage.word(hit.code)
    if stage.lit_words and shadow is not None:
        word = jnp.where(shadow, stage.dark_word(hit.code), word)
    glow = noise
    if stage.lit_words and stage.first_bent is not None:
        row = stage.bent(jnp.maximum(hit.code - stage.first_bent, 0))
        light = _light(view, face_normal(row, x, y, z), (x, y, z), shadow)[0]  # white: it has no lamps
        glow = stage.settle(noise * jnp.where(hit.code >= stage.first_bent, light, 1.0))
    if not stage.lit_words:
        row = stage.row(jnp.where(box, hit.code, 4 * GROUND))
        light = stage.settle(_light(view, face_normal(row, x, y, z), (x, y, z), shadow))
        factors = stage.settle(_texture(view, stage, row, (x, y, z), depth))

    channels = []
    for channel in range(3):
        paint = stage.small((word >> (8 * channel)) & 255) * (foot / 255.0)
        tile = looks.ground[0, channel] + mix * (looks.ground[1, channel] - looks.ground[0, channel])
        sky = looks.sky_horizon[channel] + height * (looks.sky_zenith[channel] - looks.sky_horizon[channel])
        if stage.lit_words:
            thing, ground = paint * glow, tile * (lit * noise)
        else:
            thing = paint * noise * light[channel] * factors[channel]
            ground = tile * noise * light[channel] * factors[channel]
        channels.append(jnp.where(box, thing, jnp.where(seen, ground, sky)))
    return channels if view.finish is None else _fog(view.finish, rays, seen, depth, height, channels)


def _light(view: View, normal, point, shadow) -> list:
    """Light of the sun and the lamps on a surface, for each channel."""
    looks, finish = view.looks, view.finish
    cosine = normal[0] * looks.sun[0] + normal[1] * looks.sun[1] + normal[2] * looks.sun[2]
    sun = looks.diffuse * jnp.maximum(cosine, 0.0)
    if shadow is not None:
        sun = jnp.where(shadow, 0.0, sun)
    light = [looks.ambient + sun] * 3
    if finish is None:
        return light
    for lamp in range(finish.lamp_position.shape[0]):
        to = [finish.lamp_position[lamp, axis] - point[axis] for axis in range(3)]
        square = to[0] * to[0] + to[1] * to[1] + to[2] * to[2] + 0.05
        facing = to[0] * normal[0] + to[1] * normal[1] + to[2] * normal[2]
        strength = jnp.maximum(facing, 0.0) * jax.lax.rsqrt(square) / square
        light = [light[channel] + strength * finish.lamp_colour[lamp, channel] for channel in range(3)]
    return light


def _texture(view: View, stage: Stage, row, point, depth) -> list:
    if view.finish is None:
        return [1.0] * 3
    x, y, z = point
    s = row[8] * x + row[9] * y + row[10] * z + row[11]
    t = row[12] * x + row[13] * y + row[14] * z + row[15]
    pixel = depth * row[17] * (1.0 / view.intrinsics.fy)  # of a repeat
    fine = stage.ratio(1.0, 1.0 + 400.0 * pixel * pixel)
    return texture(row[16], s, t, fine, view.looks.seed, stage.picture)


def _fog(finish: Finish, rays: Rays, seen, depth, height, channels) -> list:
    length = jnp.sqrt(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z)
    distance = jnp.where(seen, depth * length, 60.0 * (1.0 - height) * (1.0 - height))  # the sky clears upwards
    clear = jnp.exp(-finish.fog * distance)
    return [finish.fog_colour[i] + clear * (channels[i] - finish.fog_colour[i]) for i in range(3)]


def pack_channels(stage: Stage, channels) -> jax.Array:
    """Words uint32 of three arrays: blue << 16 | green << 8 | red."""
    red, green, blue = (stage.level(value).astype(jnp.uint32) for value in channels)
    return red | (green << 8) | (blue << 16)
