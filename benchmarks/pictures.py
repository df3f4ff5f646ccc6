"""Pictures of the pages: `python -m benchmarks.pictures drive`, `loop RUN`, `map`, ...; they go to docs/images/.

    drive      drive.webp: a planner drives the obstacle course; camera picture beside the world from above
    loop RUN   missing_effect.png: a verdict of `sysid.close_loop`, from RUN/report.json
    verdict FILE   verdict.svg: how a verdict was reached, from an evidence.json
    ros        ros2.png: which node publishes which topic
    map        map.png: a made map from above, and what a camera sees of its walls
    foreign    foreign.png: what policies see of the foreign rooms; needs MUJOCO_GL=egl or osmesa without a display

README's verdict is of drives of the contact plant, of which one tyre is 1.2 % larger than the other:

    for day in 1 2 3; do python -m benchmarks.plant --out runs/day$day --seed $day; done
    python -m benchmarks.plant --out runs/today --effects '{"wheel_radius_difference": 0.012}' --seed 11
    python -m sysid.close_loop runs/today --reference runs/day1 runs/day2 runs/day3 --out runs/loop
    python -m benchmarks.pictures loop runs/loop
"""

from __future__ import annotations

import argparse
import json
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.logs.dataset import write_text

IMAGES = Path(__file__).parent.parent / "docs" / "images"
CAMERA = 288
"""Edge of the large camera picture [pixels]; the policy itself sees 64."""
PAUSE = 8
"""Frames for which the last picture of a drive stays."""


def drive(out: Path, seeds: tuple[int, ...] = (3, 8)) -> None:
    """Drives of the planner in several random worlds, as one animated picture."""
    frames = [frame for seed in seeds for frame in _drive(seed)]
    write_film(out, frames)
    print(f"{out}: {len(frames)} frames, {out.stat().st_size / 1e6:.2f} MB")


def _drive(seed: int) -> list[np.ndarray]:
    """Frames (H, W, 3) uint8 of one drive: large camera picture, what the policy would get, and the way from above."""
    import jax
    import jax.numpy as jnp

    from whill_mjx.env import make_env, observe, reset_state, step_state
    from whill_mjx.env.view_from_above import top_view
    from whill_mjx.evaluation.planner import first_plan, for_task, plan_action
    from whill_mjx.vehicle.kinematics import camera_pose, reference_pose
    from whill_mjx.world.render import Quality, pinhole, render

    env, params = make_env("obstacle_course", layout="randomised", random_looks=False)
    large, _ = make_env("obstacle_course", layout="randomised", height=CAMERA // 2, width=CAMERA // 2)
    config, best = for_task(env.task), Quality(antialias=True, shadows=True)
    key, plan_key = jax.random.split(jax.random.key(seed))
    state = jax.jit(partial(reset_state, env, params))(key)
    plan = first_plan(config, env, state, plan_key)

    @jax.jit
    def pictures(state: Any, path: Any) -> tuple[Any, Any, Any]:
        position, rotation = camera_pose(env.model, state.vehicle.qpos)
        lens = pinhole(env.model.spec.camera.fov_y, CAMERA, CAMERA)
        seen = render(position, rotation, lens, state.scene, best)
        return seen, observe(env, state), top_view(large, state, path)

    @jax.jit
    def step(state: Any, plan: Any, step_key: Any) -> tuple[Any, Any]:
        action, plan = plan_action(config, env, state, plan, step_key)
        return step_state(env, params, state, action)[0], plan

    def here(state: Any) -> Any:
        return jnp.stack(reference_pose(env.model, state.vehicle.qpos)[:2])

    path = jnp.tile(here(state), (16, 1))
    frames = []
    for number in range(env.task.max_steps):
        frames.append(_side_by_side(*(np.asarray(picture) for picture in pictures(state, path))))
        if bool(state.done):
            break
        state, plan = step(state, plan, jax.random.fold_in(plan_key, number))
        if number % 4 == 0 and number // 4 < len(path):
            path = path.at[number // 4 :].set(here(state))
    return frames + [frames[-1]] * PAUSE


def _side_by_side(seen: np.ndarray, small: np.ndarray, above: np.ndarray) -> np.ndarray:
    """One frame: the camera picture with the policy's 64x64 in its corner, beside the view from above."""
    seen = seen.copy()
    corner = small.shape[0]
    seen[4 : 4 + corner, -4 - corner : -4] = small
    for rows, columns in (((4, 4 + corner), (-5 - corner, -4 - corner)), ((4, 4 + corner), (-4, -3))):
        seen[slice(*rows), slice(*columns)] = 255
    for row in (3, 4 + corner):
        seen[row, -5 - corner : -3] = 255
    return np.hstack([seen, np.full((CAMERA, 6, 3), 255, np.uint8), above])


def write_film(path: Path, frames: list[np.ndarray], rate: int = 10) -> None:
    """Write frames (H, W, 3) uint8 as an animated WebP that repeats for ever, whole or not at all."""
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in frames)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}")
    first.save(temporary, format="WEBP", save_all=True, append_images=others, duration=1000 // rate, loop=0,
               quality=72, method=6)
    os.replace(temporary, path)


def loop(run: Path, out: Path) -> None:
    """Plot a named effect: error of each manoeuvre before and after, and the size that each manoeuvre finds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    report = json.loads((run / "report.json").read_text())
    found = report["effects"][0]
    name, fitted = next(iter(found["parameters"].items()))
    rows = [row for row in report["by_manoeuvre"]
            if row["metric"] == "trajectory" and row["channel"] == "ground_truth"][::-1]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.0), constrained_layout=True)
    for shift, key, colour, label in (
        (0.2, "before", "tab:red", "vehicle as it was on other days"),
        (-0.2, "after", "tab:green", f"with {found['name'].replace('_', ' ')}"),
    ):
        left.barh(np.arange(len(rows)) + shift, [row[key] for row in rows], 0.38, color=colour, label=label)
    left.set_yticks(range(len(rows)), [_label(row) for row in rows], fontsize=9)
    left.set(xlabel="error of the predicted position [m]", title="Prediction, before and after")
    left.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    sizes = found["evidence"]["by_manoeuvre"][::-1]
    right.axvspan(*fitted["interval"], color="tab:green", alpha=0.25, lw=0, label="all drives together, 95 % interval")
    right.axvline(fitted["value"], color="tab:green", lw=1.5)
    for place, row in enumerate(sizes):
        right.errorbar(row["factor"] * fitted["value"], place, xerr=1.96 * row["standard_error"] * fitted["value"],
                       fmt="o", color="black", ms=4, lw=1.2)
    right.set_yticks(range(len(sizes)), [row["manoeuvre"].replace("_", " ") for row in sizes], fontsize=9)
    right.set_xlim(left=0.0)
    right.locator_params(axis="x", nbins=5)
    right.set(xlabel="left radius less right radius, share of the nominal" if name.startswith("wheel_radius") else name,
              title="Each manoeuvre finds the same size")
    right.legend(frameon=False, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    temporary = out.with_name(f".{out.name}")
    figure.savefig(temporary, dpi=100, format="png")
    plt.close(figure)
    os.replace(temporary, out)
    print(out)


def _label(row: dict[str, Any]) -> str:
    return row["manoeuvre"].replace("_", " ") + (" (held out)" if row["part"] == "held_out" else "")


def ros(out: Path) -> None:
    """Draw the nodes of the bridge and the topics between them."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyBboxPatch

    figure, axes = plt.subplots(figsize=(10, 3.5), constrained_layout=True)
    axes.set(xlim=(0, 100), ylim=(1, 37))
    axes.axis("off")

    def node(x: float, y: float, width: float, title: str, text: str, colour: str) -> None:
        box = FancyBboxPatch((x, y), width, 10, boxstyle="round,pad=0.2,rounding_size=1.2", fc=colour, ec="0.25")
        axes.add_patch(box)
        axes.text(x + width / 2, y + 6.6, title, ha="center", va="center", fontsize=10.5, family="monospace")
        axes.text(x + width / 2, y + 2.8, text, ha="center", va="center", fontsize=8.5, color="0.25")

    def topic(start: tuple[float, float], end: tuple[float, float], label: str, at: tuple[float, float]) -> None:
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "lw": 1.4, "color": "0.2"})
        axes.text(*at, label, ha="center", va="center", fontsize=8.5, family="monospace",
                  bbox={"fc": "white", "ec": "none", "pad": 1.0})

    node(2, 24, 27, "vehicle", "or bridge.simulate: same topics", "#dbe9f6")
    node(71, 24, 27, "bridge.drive", "policy file + safety supervisor", "#dff0d8")
    node(36.5, 3, 27, "bridge.record", "writes a driving-log dataset", "#fdf0d5")
    node(71, 3, 27, "bridge.guard", "stops the vehicle if the policy dies", "#f8dcdc")
    topic((29.5, 31.5), (70.5, 31.5), "/sensing/camera/front/image_raw", (50, 33.4))
    topic((70.5, 27), (29.5, 27), "/whill/controller/cmd_vel", (50, 25.0))
    topic((18, 23.5), (36, 10), "/whill/odom", (19.5, 17))
    topic((71, 25), (58, 13.6), "/whill/controller/cmd_vel", (58, 19))
    topic((84.5, 23.5), (84.5, 13.6), "cmd_vel stops", (84.5, 18.6))
    temporary = out.with_name(f".{out.name}")
    figure.savefig(temporary, dpi=110, format="png")
    os.replace(temporary, out)
    plt.close(figure)
    print(out)


def office(out: Path) -> None:
    """A made map of rooms and pillars from above, its starts and goals, and three views from starts."""
    import cv2
    import jax
    import jax.numpy as jnp

    from whill_mjx.world.maps import FREE, OCCUPIED, GridMap, make_map_scene, map_scene_sampler, shown
    from whill_mjx.world.maps.picture import from_above
    from whill_mjx.world.render import Quality, camera_rotation, pinhole, render

    row, column = np.mgrid[:220, :400]
    solid = (row < 3) | (row > 216) | (column < 3) | (column > 396)
    solid |= (abs(column + row // 3 - 170) < 2) & (abs(row - 60) > 14) & (abs(row - 170) > 14)  # a slanted wall
    solid |= (abs(row - 110) < 2) & (column > 150 - row // 3) & (abs(column - 300) > 16)
    solid |= np.hypot(row - 60, column - 310) < 8
    solid |= (abs(row - 165) < 10) & (abs(column - 240) < 22)
    grid = GridMap(np.where(solid, OCCUPIED, FREE).astype(np.uint8), 0.05, (0.0, 0.0, 0.0))
    made = make_map_scene(grid)
    above = cv2.imdecode(np.frombuffer(from_above(made, 1000), np.uint8), cv2.IMREAD_COLOR)
    lens = pinhole(1.1, 176, 234)

    @jax.jit
    def view(key: jax.Array) -> jax.Array:
        scene, start = map_scene_sampler(made)(key)
        position, rotation = jnp.append(start[:2], 1.0), camera_rotation(start[2], 0.1, 0.0)
        scene = shown(scene, position, rotation, lens)
        return render(position, rotation, lens, scene, Quality(antialias=True))

    views = [np.asarray(view(jax.random.key(seed)))[..., ::-1] for seed in (0, 1, 2)]
    column_of = np.concatenate([np.pad(one, ((0, 11), (12, 0), (0, 0)), constant_values=255) for one in views])
    assert above is not None
    height = above.shape[0]
    sheet = np.concatenate([above, np.resize(column_of[:height], (height, column_of.shape[1], 3))], 1)
    cv2.imwrite(str(out), sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{out}: {len(made.walls.segments)} walls, {sheet.shape[1]} x {sheet.shape[0]}")


def foreign(out: Path) -> None:
    """First images of foreign rooms, four corridors beside four courses: plain, furnished and unseen."""
    import cv2

    from benchmarks.foreign.camera import Camera
    from benchmarks.foreign.drive import Pose
    from benchmarks.foreign.plan import PLANS
    from benchmarks.foreign.room import VARIANTS, make_room
    from benchmarks.foreign.run import MOUNT

    def first(variant: str, seed: int, task: str) -> np.ndarray:
        room = make_room(variant, seed, task)
        camera = Camera(room.model, MOUNT, variant == "plain", np.random.default_rng(seed))
        camera.place(Pose(*room.plan.start, 0.0, 0.0))
        image = [camera.image(64) for _ in range(10)][-1]  # after a second of exposure control
        camera.close()
        large = cv2.resize(image, (128, 128), interpolation=cv2.INTER_NEAREST)
        return np.pad(large[..., ::-1], ((2, 2), (2, 2), (0, 0)), constant_values=255)

    rows = [np.hstack([first(variant, seed, task) for task in PLANS for seed in range(4)]) for variant in VARIANTS]
    cv2.imwrite(str(out), np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{out}: {len(rows)} variants")


def main() -> None:
    """Draw what the command line names."""
    parser = Parser(prog="python -m benchmarks.pictures", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    kinds.add_parser("drive", help="the moving picture")
    kinds.add_parser("loop", help="a named effect").add_argument("run", type=Path, help="folder with report.json")
    kinds.add_parser("verdict", help="how it was reached").add_argument("file", type=Path, help="evidence.json")
    kinds.add_parser("ros", help="nodes and topics")
    kinds.add_parser("map", help="a map and its walls")
    kinds.add_parser("foreign", help="rooms of the foreign simulator")
    given = parser.parse_args()
    if given.kind == "map":
        office(IMAGES / "map.png")
    elif given.kind == "foreign":
        foreign(IMAGES / "foreign.png")
    elif given.kind == "drive":
        drive(IMAGES / "drive.webp")
    elif given.kind == "loop":
        loop(given.run, IMAGES / "missing_effect.png")
    elif given.kind == "verdict":
        from sysid.pages.verdict_picture import account, draw
        from sysid.verdict.posterior import Thresholds, read

        write_text(IMAGES / "verdict.svg", draw(account(read(given.file), Thresholds())) + "\n")
    else:
        ros(IMAGES / "ros2.png")


if __name__ == "__main__":
    from whill_mjx import share_results

    with guarded():
        share_results()
        main()
