"""The image by the renderer that suits the device: the kernel on NVIDIA GPUs, plain JAX elsewhere."""

from __future__ import annotations

from functools import partial

import jax

from whill_mjx.devices import runs_triton
from whill_mjx.world.render.camera import Intrinsics
from whill_mjx.world.render.image import PLAIN, render
from whill_mjx.world.render.shading import Quality
from whill_mjx.world.scene import Scene


def draw(
    position: jax.Array,
    rotation: jax.Array,
    intrinsics: Intrinsics,
    scene: Scene,
    quality: Quality = PLAIN,
) -> jax.Array:
    """Image (H, W, 3) uint8 of one instance; arguments and errors as `render`.

    At most 0.5 % of the pixels differ by more than one grey level between the two renderers. An image of bytes has no
    derivative; what is computed beside it keeps its own.
    """
    if not runs_triton():
        return render(position, rotation, intrinsics, scene, quality)
    from whill_mjx.world.render.pallas import render_pallas

    position, rotation, intrinsics, scene = jax.lax.stop_gradient((position, rotation, intrinsics, scene))
    arguments = position, rotation, intrinsics, scene, quality
    kernel = partial(render_pallas, *arguments)
    return jax.lax.platform_dependent(cuda=kernel, default=partial(render, *arguments))
