"""The camera image of an environment."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from whill_mjx.env.records import Env, State
from whill_mjx.vehicle.kinematics import camera_pose
from whill_mjx.world.eye import develop, mounted
from whill_mjx.world.maps.walls import shown
from whill_mjx.world.photometric import augment
from whill_mjx.world.render import Quality, pinhole
from whill_mjx.world.render.draw import draw
from whill_mjx.world.render.rich import floor_light

METERED = (0.8, 1.8, 3.5)
"""Distances ahead of the camera at which the exposure control finds the light [m]."""
SHUTTER = 1.0 / 40.0
"""Time for which the shutter of a camera in a room is open [s]."""
RICH = Quality(antialias=True)


def observe(env: Env, state: State) -> jax.Array:
    """Camera image (H, W, 3) uint8 of one instance."""
    if env.rich:
        return _observe_rich(env, state)
    position, rotation = camera_pose(env.model, state.vehicle.qpos)
    mount = env.model.spec.camera
    intrinsics = pinhole(mount.fov_y, env.height, env.width)
    scene = shown(state.scene, position, rotation, intrinsics, mount)
    image = draw(position, rotation, intrinsics, scene)
    if not env.photometric:
        return image
    return augment(image, state.photometry, jax.random.fold_in(state.key, state.step_count))


def _observe_rich(env: Env, state: State) -> jax.Array:
    """The same with mount, exposure control, film and delay of the camera."""
    eye, lights, trail = state.scene.rich.eye, state.scene.rich.lights, state.trail
    assert trail is not None
    position, rotation = camera_pose(env.model, trail[eye.delay])
    position, rotation = mounted(eye, position, rotation)
    mount = env.model.spec.camera
    intrinsics = pinhole(mount.fov_y * eye.zoom, env.height, env.width)

    then, before = camera_pose(env.model, trail[-1])
    ahead = before[:2, 2] * jax.lax.rsqrt(jnp.sum(before[:2, 2] ** 2) + 1e-6)
    metered = [jnp.log(floor_light(lights, *(then[:2] + far * ahead)) + 1e-4) for far in METERED]
    exposure = 0.5 * jnp.exp(-sum(metered) / len(METERED))
    rich = dataclasses.replace(state.scene.rich, lights=dataclasses.replace(lights, exposure=exposure))
    scene = shown(dataclasses.replace(state.scene, rich=rich), position, rotation, intrinsics, mount)
    image = draw(position, rotation, intrinsics, scene, RICH)
    turning = state.vehicle.qvel[5] * SHUTTER * intrinsics.fx
    return develop(image, eye, turning, jax.random.fold_in(state.key, state.step_count), state.step_count)
