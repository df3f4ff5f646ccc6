"""The gallery as the camera shows it: a sheet of pictures, and a film of the walk."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.world.gallery import gallery, walk
from whill_mjx.world.render import Quality, pinhole, render, render_frame
from whill_mjx.world.render.film import Film, develop, motion_blur


def gallery_sheet(height: int = 96, width: int = 144) -> np.ndarray:
    """Sheet (2, 3 pictures) uint8 of the gallery: plain, best, lens and motion; depth, labels, normals."""
    scene, lens = gallery(), pinhole(1.0, height, width)
    best = Quality(antialias=True, shadows=True)
    curved = dataclasses.replace(lens, distortion=jnp.array([-0.30, 0.08, 0.0, 0.0, 0.0]))
    start, end = walk(jnp.array(0.1)), walk(jnp.array(0.14))

    def moving(scene):
        draw = partial(render, intrinsics=curved, scene=scene, quality=best)
        image = motion_blur(lambda position, rotation: draw(position, rotation), start, end, samples=6)
        warm = Film(jnp.array(1.1), jnp.array([1.06, 1.0, 0.9]), jnp.array(0.45), jnp.array(2.0))
        return develop(image, warm, jax.random.key(0))

    plain = dataclasses.replace(scene, finish=None)
    frame = jax.jit(lambda scene: render_frame(*start, lens, scene, normals=True))(plain)
    good = jax.jit(lambda scene: render(*start, lens, scene, best))(scene)
    depth = depth_picture(np.asarray(frame.depth))
    label = np.asarray(frame.label).astype(int)
    colours = np.random.default_rng(3).integers(40, 256, (label.max() + 1, 3)).astype(np.uint8)[label]
    normal = (np.asarray(frame.normal) * 127.0 + 128.0).astype(np.uint8)
    top = [np.asarray(image) for image in (frame.rgb, good, jax.jit(moving)(scene))]
    return np.vstack([np.hstack(top), np.hstack([depth, colours, normal])])


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Grey picture (H, W, 3) uint8 of a depth (H, W): nearest white, each doubling as much darker, the sky black."""
    seen = np.isfinite(depth)
    if not seen.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    double = np.log2(np.maximum(np.where(seen, depth, 0.0), 1e-3))
    near, far = double[seen].min(), double[seen].max()
    grey = np.where(seen, 255.0 - 215.0 * (double - near) / max(far - near, 1e-6), 0.0)
    return np.repeat(grey[..., None], 3, -1).astype(np.uint8)


def gallery_film() -> tuple[list[np.ndarray], float]:
    """Frames (H, W, 3) uint8 of the walk, and how many there are in a second."""
    scene, lens, best = gallery(), pinhole(1.0, 144, 192), Quality(antialias=True, shadows=True)
    # The scene is an argument: as a constant, XLA would work it out while compiling.
    draw = jax.jit(lambda share, scene: render(*walk(share), lens, scene, best))
    return [np.asarray(draw(share, scene)) for share in jnp.linspace(0.0, 1.0, 60)], 10.0
