"""Pictures of a task: `python -m whill_mjx.look --task obstacle_course --out FILE.png`.

One column per world: what the camera sees at the start, what it sees halfway, and the world from above.
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from whill_mjx.env import Env, State, make_env, observe, reset_state, step_state
from whill_mjx.kinematics import reference_pose
from whill_mjx.planner import first_plan, for_task, plan_action
from whill_mjx.render import Intrinsics, render
from whill_mjx.scene import box, footprint, stack_boxes
from whill_mjx.types import VehicleParams


@dataclass(frozen=True)
class Look:
    """Options of the command."""

    task: str = "obstacle_course"
    """obstacle_course or corridor."""
    out: Path = Path("look.png")
    """Picture to write."""
    layout: str = "randomised"
    """randomised or fixed."""
    looks: bool = False
    """Also draw colours, light and textures at random, and change the images photometrically."""
    worlds: int = 6
    """Columns of the sheet."""
    steps: int = 18
    """Control steps that the planner drives before the second picture."""
    scale: int = 3
    """Enlargement of the pictures."""
    seed: int = 0
    """First random key."""


def contact_sheet(env: Env, params: VehicleParams, worlds: int, steps: int, seed: int = 0) -> np.ndarray:
    """Sheet (rows, columns, 3) uint8 of `worlds` worlds, at the size of the camera image."""
    draw = jax.jit(jax.vmap(lambda key: _column(env, params, key, steps)))
    pictures = draw(jax.random.split(jax.random.key(seed), worlds))
    columns = [np.concatenate([np.asarray(picture[world]) for picture in pictures]) for world in range(worlds)]
    return np.concatenate(columns, axis=1)


def top_view(env: Env, state: State, path: jax.Array | None = None) -> jax.Array:
    """World of one instance from 12 m above, as wide as its camera image and twice as high; +x is up.

    The vehicle is drawn as a dark box, and each point of `path` (T, 2) as a small yellow one.
    """
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    spec, outline = env.model.spec, footprint(env.model.spec, x, y, yaw)
    dark, yellow = jnp.array([0.1, 0.1, 0.12]), jnp.array([0.95, 0.85, 0.1])
    extra = [box(outline.x, outline.y, spec.body_length, spec.body_width, 0.9, dark, yaw)]
    if path is not None:
        extra += [box(point[0], point[1], 0.08, 0.08, 0.95, yellow) for point in path]
    marker = state.scene.marker
    edge = 2 * marker.half[1]
    extra.append(box(marker.position[0], marker.position[1], 0.15, edge, 1.4, marker.colour, marker.yaw))
    scene = dataclasses.replace(state.scene, boxes=stack_boxes([state.scene.boxes, *extra]))
    height, width = 2 * env.height, env.width
    eye = jnp.array([2.6, 0.0, 12.0])
    down = jnp.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # right is -y, down is -x, forward is -z
    focal = jnp.asarray(height * 12.0 / 9.0)  # 9 m of ground over the height
    intrinsics = Intrinsics(focal, focal, jnp.asarray(width / 2), jnp.asarray(height / 2))
    return render(eye, down, intrinsics, scene, height, width)


def _column(env: Env, params: VehicleParams, key: jax.Array, steps: int) -> tuple[jax.Array, ...]:
    config = for_task(env.task)
    reset_key, plan_key, drive_key = jax.random.split(key, 3)
    start = reset_state(env, params, reset_key)

    def one_step(carry, step_key):
        state, plan = carry
        action, plan = plan_action(config, env, state, plan, step_key)
        state, outcome = step_state(env, params, state, action)
        return (state, plan), jnp.stack([outcome.metrics["x"], outcome.metrics["y"]])

    plan = first_plan(config, env, start, plan_key)
    (later, _), path = jax.lax.scan(one_step, (start, plan), jax.random.split(drive_key, steps))
    return observe(env, start), observe(env, later), top_view(env, later, path[:: max(1, steps // 12)])


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, whole or not at all."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not ok:
        raise ValueError(f"{path}: an image of shape {image.shape} and type {image.dtype} cannot be written as PNG.")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(data.tobytes())
    os.replace(temporary, path)


def main(options: Look) -> None:
    """Write the sheet of `options`."""
    env, params = make_env(options.task, layout=options.layout, random_looks=options.looks, photometric=options.looks)
    sheet = contact_sheet(env, params, options.worlds, options.steps, options.seed)
    write_png(options.out, sheet.repeat(options.scale, 0).repeat(options.scale, 1))
    print(f"{options.out}: {options.worlds} worlds, start, after {options.steps} steps, and from above")


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Look))
