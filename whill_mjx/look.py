"""Draw tasks and scenes as pictures or videos: `python -m whill_mjx.look --scene obstacle_course --out FILE.png`.

A task has one column per world: what the camera sees at the start, what it sees halfway, and the world from above;
its video shows a planner driving. The gallery shows all that the camera can draw: plain, at its best, with lens and
motion; depth, labels and normals; its video is a walk. `--scene all` writes every sheet beside FILE.
With the ending .rrd, FILE is a recording for the Rerun viewer; `--live` opens that viewer.
"""

from __future__ import annotations

import dataclasses
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from whill_mjx.io.command_line import SEED, OptionError, Range, check_known, listen, refusing, run, starts
from whill_mjx.io.heartbeat import Heartbeat, say_loading

if starts(__name__):
    listen()
    say_loading()

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from whill_mjx.env import Env, State, make_env, observe, reset_state, step_state
from whill_mjx.evaluation.planner import PlannerConfig, first_plan, for_task, plan_action
from whill_mjx.evaluation.rerun_log import RerunLog, load_rerun, step_with_terms
from whill_mjx.io.folders import check_file, note_written, whole_file, write_whole
from whill_mjx.io.video import write_h264
from whill_mjx.tasks.check import check_world
from whill_mjx.tasks.options import named_task, read_fields
from whill_mjx.tasks.tasks import LAYOUTS, TASKS, Task
from whill_mjx.vehicle.kinematics import reference_pose
from whill_mjx.vehicle.types import VehicleParams
from whill_mjx.world.gallery import gallery, walk
from whill_mjx.world.maps.walls import nearest_walls
from whill_mjx.world.render import Intrinsics, Quality, pinhole, render, render_frame
from whill_mjx.world.render.film import Film, develop, motion_blur
from whill_mjx.world.scene import box, footprint, stack_boxes

VIDEOS = (".mp4", ".gif")
"""Endings of videos."""
QUICKLY = {"xla_backend_optimization_level": 1}
"""Of programs that run once: compiling takes longer than they do, and the picture is the same bit for bit."""
RECORDING = ".rrd"
"""Ending of a recording for the Rerun viewer."""
VIEW, INSIDE = np.array([2.6, 0.0], np.float32), np.array([4.0, 2.0], np.float32)
"""Middle of the view from above, and how far from it the view lets a vehicle go [m]."""


@dataclass(frozen=True)
class Look:
    """Options of the command."""

    scene: str = "obstacle_course"
    """Name of a task, package.module:TASK, path/to/file.py:TASK, gallery, or all."""
    out: Path = Path("look.png")
    """Picture to write, video with the ending .mp4 or .gif, or recording for the Rerun viewer with the ending .rrd."""
    live: bool = False
    """Open the Rerun viewer and show a planner's drive as it comes; OUT is then written only if it ends in .rrd."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as people=6."""
    layout: str = "randomised"
    """randomised or fixed."""
    looks: Literal["plain", "paper", "rich"] = "plain"
    """plain, paper (colours, light and textures at random, and images changed photometrically) or rich (furnished
    rooms, docs/looks.md)."""
    worlds: Annotated[int, Range(1, 100)] = 6
    """Columns of the sheet."""
    steps: Annotated[int, Range(1, 10_000)] = 18
    """Control steps that the planner drives before the second picture."""
    scale: Annotated[int, Range(1, 50)] = 3
    """Enlargement of the pictures."""
    seed: Annotated[int, SEED] = 0
    """First random key."""


def contact_sheet(env: Env, params: VehicleParams, worlds: int, steps: int, seed: int = 0) -> np.ndarray:
    """Sheet (rows, columns, 3) uint8 of `worlds` worlds, at the size of the camera image."""
    keys = jax.vmap(partial(jax.random.split, num=3))(jax.random.split(jax.random.key(seed), worlds))
    reset_keys, plan_keys, drive_keys = keys.T
    with ThreadPoolExecutor() as threads:  # XLA compiles without holding Python's lock

        def begin(function, *args):
            """What the function of one world gives, as shapes, and the program of all, which is being compiled."""
            traced = jax.jit(jax.vmap(function)).trace(*args)
            return traced.out_info, threads.submit(lambda: traced.lower().compile(compiler_options=QUICKLY))

        start, reset = begin(partial(reset_state, env, params), reset_keys)
        plan, first = begin(partial(first_plan, for_task(env.task), env), start, plan_keys)
        (later, path), drive = begin(partial(_drive, env, params, steps=steps), start, plan, drive_keys)
        _, above = begin(partial(top_view, env), later, path)
        _, see = begin(partial(observe, env), start)
    run_reset, run_first, run_drive, run_above, run_see = (
        one.result() for one in (reset, first, drive, above, see)
    )
    start = run_reset(reset_keys)
    later, path = run_drive(start, run_first(start, plan_keys), drive_keys)
    images = run_see(start), run_see(later), run_above(later, path)
    return np.concatenate([np.concatenate(np.asarray(row), axis=1) for row in images])


def top_view(env: Env, state: State, path: jax.Array | None = None) -> jax.Array:
    """World of one instance from 12 m above, as wide as its camera image and twice as high; +x is up.

    The vehicle is drawn as a dark box, and each point of `path` (T, 2) as a small yellow one. The view follows a
    vehicle that would leave it, and in a map every one. Colours are plain ones, without ceiling and lamps.
    """
    x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
    spec, outline = env.model.spec, footprint(env.model.spec, x, y, yaw)
    dark, yellow = jnp.array([0.1, 0.1, 0.12]), jnp.array([0.95, 0.85, 0.1])
    extra = [box(outline.x, outline.y, spec.body_length, spec.body_width, 0.9, dark, yaw)]
    if path is not None:
        extra += [box(point[0], point[1], 0.08, 0.08, 0.95, yellow) for point in path]
    scene, walls, marker = state.scene, state.scene.walls, state.scene.marker
    edge = 2 * marker.half[1]
    extra.append(box(marker.position[0], marker.position[1], 0.15, edge, 1.4, marker.colour, marker.yaw))
    boxes, off = scene.boxes, jnp.stack([x, y]) - VIEW
    place: jax.Array = jnp.asarray(VIEW) + (off - jnp.clip(off, -INSIDE, INSIDE))
    if scene.hidden is not None:
        boxes = dataclasses.replace(boxes, mask=boxes.mask & ~scene.hidden)
    if walls is not None:  # the last boxes are those that the camera sees; from above, the nearest are seen
        boxes = jax.tree.map(lambda leaf: leaf[: leaf.shape[0] - walls.keep], boxes)
        extra.append(nearest_walls(jnp.asarray(walls.segments), x, y, walls.keep, walls.height))
        place = jnp.stack([x, y])
    ghosts = scene.ghosts if scene.rich is None else None
    scene = dataclasses.replace(
        scene, boxes=stack_boxes([boxes, *extra]), walls=None, hidden=None, ghosts=ghosts, finish=None, rich=None
    )
    height, width = 2 * env.height, env.width
    down = jnp.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # right is -y, down is -x, forward is -z
    focal = jnp.asarray(height * 12.0 / 9.0)  # 9 m of ground over the height
    intrinsics = Intrinsics(focal, focal, jnp.asarray(width / 2), jnp.asarray(height / 2), height=height, width=width)
    return render(jnp.append(place, 12.0), down, intrinsics, scene)


def _drive(
    env: Env, params: VehicleParams, start: State, plan: jax.Array, key: jax.Array, steps: int
) -> tuple[State, jax.Array]:
    """State of one instance after `steps` control periods of the planner, and about twelve points (T, 2) of its way."""
    config = for_task(env.task)

    def one_step(carry, step_key):
        state, plan = carry
        action, plan = plan_action(config, env, state, plan, step_key)
        state, outcome = step_state(env, params, state, action)
        return (state, plan), jnp.stack([outcome.metrics["x"], outcome.metrics["y"]])

    (later, _), path = jax.lax.scan(one_step, (start, plan), jax.random.split(key, steps))
    return later, path[:: max(1, steps // 12)]


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8, whole or not at all."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not ok:
        raise ValueError(f"{path}: an image of shape {image.shape} and type {image.dtype} cannot be written as PNG.")
    write_whole(path, data.tobytes())


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


def film_of(options: Look) -> tuple[list[np.ndarray], float]:
    """Frames of the video of a scene, at the size of its camera image, and how many there are in a second."""
    if options.scene == "gallery":
        scene, lens, best = gallery(), pinhole(1.0, 144, 192), Quality(antialias=True, shadows=True)
        # The scene is an argument: as a constant, XLA would work it out while compiling.
        draw = jax.jit(lambda share, scene: render(*walk(share), lens, scene, best))
        return [np.asarray(draw(share, scene)) for share in jnp.linspace(0.0, 1.0, 60)], 10.0
    env, params = _env(options)
    config, state, plan, plan_key = _start(options, env, params)

    def one_step(state, plan, step_key):
        action, plan = plan_action(config, env, state, plan, step_key)
        return step_state(env, params, state, action)[0], plan, observe(env, state)

    step, frames = jax.jit(one_step), []
    for number in range(env.task.max_steps):
        state, plan, image = step(state, plan, jax.random.fold_in(plan_key, number))
        frames.append(np.asarray(image))
        if bool(state.done):
            break
    return frames, 1.0 / (env.model.config.control_dt * env.task.action_repeat)


def write_video(path: Path, frames: list[np.ndarray], scale: int, rate: float) -> None:
    """Write frames (H, W, 3) uint8 as a video of `rate` frames per second, whole or not at all."""
    large = [frame.repeat(scale, 0).repeat(scale, 1) for frame in frames]
    if path.suffix != ".gif":
        write_h264(path, large, rate)
        return
    import imageio.v2 as imageio

    with whole_file(path) as temporary:
        imageio.mimwrite(temporary, large, duration=1000 / rate, loop=0)  # type: ignore[arg-type]


def _env(options: Look) -> tuple[Env, VehicleParams]:
    task = named_task(options.scene, "--scene")
    with refusing():
        task = dataclasses.replace(task, **read_fields(task, options.set), layout=options.layout)
        check_world(task)
        return make_env(task, looks=options.looks)


def _start(options: Look, env: Env, params: VehicleParams) -> tuple[PlannerConfig, State, jax.Array, jax.Array]:
    """What a planner's episode begins with: its settings, the state, a plan, and the key of all later plans."""
    config = for_task(env.task)
    key, plan_key = jax.random.split(jax.random.key(options.seed))
    state = jax.jit(partial(reset_state, env, params))(key)
    return config, state, first_plan(config, env, state, plan_key), plan_key


def record(options: Look) -> int:
    """Drive an episode with the planner for the Rerun viewer; returns its number of control periods."""
    env, params = _env(options)
    env = dataclasses.replace(env, task=dataclasses.replace(env.task, action_repeat=1))
    config, state, plan, plan_key = _start(options, env, params)

    def one_step(state, plan, step_key):
        action, plan = plan_action(config, env, state, plan, step_key)
        return *step_with_terms(env, params, state, action), plan

    step = jax.jit(one_step)
    with whole_file(options.out) if options.out.suffix == RECORDING else nullcontext() as path:
        with RerunLog(env, path, options.live) as log:
            log.begin(state)
            for number in tqdm(range(env.task.max_steps), unit="step", leave=False):
                state, rewards, plan = step(state, plan, jax.random.fold_in(plan_key, number))
                log.moment(state, rewards)
                if bool(state.done):
                    break
    return int(state.step_count)


def _missing(task: Task) -> str:
    """What a task cannot be drawn without, such as a map; nothing for most."""
    try:
        check_world(task)
    except ValueError as error:
        return str(error)
    return ""


def main(options: Look) -> None:
    """Write the sheet or the video of `options`."""
    known = (*TASKS, "gallery")
    if ":" in options.scene or options.scene.endswith(".py"):
        named_task(options.scene, "--scene")
    elif options.scene not in (*known, "all"):
        raise OptionError(f"--scene: unknown scene {options.scene!r} (known: {', '.join(known)}, all). Correct it.")
    check_known("--layout", options.layout, LAYOUTS)
    if options.out.suffix not in (".png", *VIDEOS, RECORDING):
        raise OptionError(f"--out {options.out}: must end in .png for a picture, {' or '.join(VIDEOS)} for a video, "
                          f"{RECORDING} for the Rerun viewer.")
    if options.scene in ("gallery", "all") and (options.live or options.set or options.out.suffix == RECORDING):
        raise OptionError(f"--scene {options.scene}: is no single task, as --set, --live and {RECORDING} need. Name "
                          "one task.")
    if options.scene != "all":
        _show(options)
        return
    missing = {name: said for name in known if name in TASKS and (said := _missing(TASKS[name]))}
    outs = {name: options.out.with_name(f"{options.out.stem}_{name}{options.out.suffix}")
            for name in known if name not in missing}
    for out in outs.values():
        check_file("--out", out)
    for name, said in missing.items():
        print(f"{name}: left out. {said}")
    for name, out in outs.items():
        _show(dataclasses.replace(options, scene=name, out=out))


def _show(options: Look) -> None:
    """Draw or drive one scene."""
    viewed = options.live and options.out.suffix != RECORDING  # nothing is written
    if not viewed:
        check_file("--out", options.out)
    _draw(options)
    if not viewed:
        note_written(options.out)


def _draw(options: Look) -> None:
    if options.live or options.out.suffix == RECORDING:
        try:
            load_rerun()
        except ImportError as error:
            raise OptionError(f"--live and {RECORDING}: {error}") from error
        steps = record(options)
        print(f"{options.out if options.out.suffix == RECORDING else 'viewer'}: {steps} steps of {options.scene}")
        return
    if options.out.suffix in VIDEOS:
        frames, rate = film_of(options)
        write_video(options.out, frames, options.scale, rate)
        print(f"{options.out}: {len(frames)} frames of {options.scene}")
        return
    seen = None if options.scene == "gallery" else _env(options)
    with Heartbeat() as heartbeat:
        heartbeat.stage(f"drawing {options.scene}: half a minute, most of it compilation")
        sheet = gallery_sheet() if seen is None else contact_sheet(*seen, options.worlds, options.steps, options.seed)
    write_png(options.out, sheet.repeat(options.scale, 0).repeat(options.scale, 1))
    rows = "" if seen is None else (
        f"; each column is a world. Rows: the camera at the start, the camera after {options.steps} control steps of "
        "a planner, and the world from above with its path")
    print(f"{options.out}: {options.scene}{rows}")


def cli() -> None:
    """Command line."""
    # `--task` is the option's former name.
    run(Look, main, __doc__, args=["--scene" if word == "--task" else word for word in sys.argv[1:]])


if __name__ == "__main__":
    cli()
