"""Pictures of README, the tutorials and the concepts, which go to docs/images:

    python -m benchmarks.page_pictures concepts            frames, drive, statistics of naming
    python -m benchmarks.page_pictures tutorials FOLDER    from what the tutorials left in FOLDER, where
                                                           `python -m benchmarks.tutorials run --out FOLDER` ran them
    python -m benchmarks.page_pictures training RUN        drives.png of README: the drives of the final evaluation
                                                           of a training, with legend and scale, as the run drew them

The pictures of the tasks are drawn by `benchmarks.task_pages`, the others by `benchmarks.pictures`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures import IMAGES, write_film
from benchmarks.task_pages import worlds
from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.io.folders import whole_file
from whill_mjx.tasks.options import named_task

WIDEST = 1100
"""Of a picture [pixels]; wider ones are made smaller."""


def save_figure(figure: Any, out: Path) -> None:
    """Write a matplotlib figure as PNG, whole or not at all."""
    import matplotlib.pyplot as plt

    with whole_file(out) as temporary:
        figure.savefig(temporary, dpi=110, format="png", pil_kwargs={"optimize": True})
    plt.close(figure)
    print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


def frames(out: Path) -> None:
    """The built-in chair from above, with its frames."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Arc

    from whill_mjx.vehicle.presets import preset

    spec, _ = preset("whill_cr")
    figure, axes = plt.subplots(figsize=(7.4, 4.6), constrained_layout=True)
    middle = -spec.rear_x  # the chassis origin, counted from the drive axle
    _chair_from_above(axes, spec, middle)
    for (x, y), (dx, dy), label, place in (
        ((0, 0), (0.55, 0), "x ahead, v > 0", (0.36, 0.05)),
        ((0, 0), (0, 0.5), "y left", (0.02, 0.5)),
    ):
        axes.annotate("", (x + dx, y + dy), (x, y), arrowprops={"arrowstyle": "-|>", "lw": 2, "color": "tab:red"})
        axes.text(*place, label, color="tab:red", va="center")
    axes.add_patch(Arc((0, 0), 0.44, 0.44, theta1=0, theta2=70, color="tab:blue", lw=2))
    axes.annotate("", (0.06, 0.214), (0.10, 0.200), arrowprops={"arrowstyle": "-|>", "lw": 2, "color": "tab:blue"})
    axes.text(0.2, 0.15, "yaw, omega > 0:\nto the left", color="tab:blue", fontsize=9)
    camera = middle + spec.camera.x
    line = {"arrowstyle": "-", "color": "0.5"}
    for along, mark, colour, text, at in (
        (0, "o", "tab:red", "reference point:\nmiddle of the drive axle", (-0.62, -0.12)),
        (middle, "s", "tab:green", "chassis origin: middle of the length,\nat the height of the wheel centres",
         (middle + 0.05, -0.42)),
        (camera, "^", "tab:purple", "camera", (camera + 0.07, -0.16)),
    ):  # fmt: skip
        axes.plot(along, 0, mark, color=colour, ms=7)
        axes.annotate(text, (along, 0), at, fontsize=9, va="center", arrowprops=line)
    axes.annotate(
        "", (-0.22, spec.track / 2), (-0.22, -spec.track / 2), arrowprops={"arrowstyle": "<->", "color": "0.4"}
    )
    axes.text(-0.25, 0.13, "track", rotation=90, va="center", ha="right", fontsize=9, color="0.3")
    axes.set(xlim=(-0.75, 1.15), ylim=(-0.52, 0.56), aspect="equal")
    axes.axis("off")
    save_figure(figure, out)


def _chair_from_above(axes: Any, spec: Any, middle: float) -> None:
    """Body and wheels; `middle` is the chassis origin, counted from the drive axle [m]."""
    from matplotlib.patches import Rectangle

    corner = (middle - spec.body_length / 2, -spec.body_width / 2)
    axes.add_patch(Rectangle(corner, spec.body_length, spec.body_width, fc="#eef3f7", ec="0.4"))
    for side in (1, -1):
        rear = (-spec.wheel_radius, side * spec.track / 2 - 0.03)
        axes.add_patch(Rectangle(rear, 2 * spec.wheel_radius, 0.06, fc="0.25"))
        front = (spec.wheelbase - 0.08, side * spec.track / 2 - 0.025)
        axes.add_patch(Rectangle(front, 0.16, 0.05, fc="0.7"))


def drives(out: Path) -> None:
    """Speed of both drives after a step of the command, as the simulator computes it."""
    import jax
    import jax.numpy as jnp
    import matplotlib.pyplot as plt

    from whill_mjx import make_env
    from whill_mjx.env import reset_state, step_state

    figure, axes = plt.subplots(figsize=(7.4, 3.2), constrained_layout=True)
    count = 30
    commands = np.where(np.arange(count) < 3, 0.0, np.where(np.arange(count) < 18, 0.5, 0.0))
    for name, colour, label in (
        ("whill_cr_paper", "tab:orange", "paper's drive (whill_cr_paper)"),
        ("whill_cr_ramp", "tab:green", "with the maker's ramp (whill_cr_ramp)"),
        ("whill_cr_physical", "tab:blue", "physical drive (whill_cr_physical)"),
    ):
        env, params = make_env("point_goal", vehicle=name)
        low, high = env.task.v_min, env.task.v_max
        state = jax.jit(lambda key, env=env, params=params: reset_state(env, params, key))(jax.random.key(0))
        step = jax.jit(lambda state, action, env=env, params=params: step_state(env, params, state, action))
        speeds = [0.0]
        for command in commands:
            action = jnp.array([2 * (command - low) / (high - low) - 1, 0.0])
            state, outcome = step(state, action)
            speeds.append(float(outcome.metrics["v"]))
        axes.plot(0.1 * np.arange(count + 1), speeds, color=colour, label=label)
    axes.step(0.1 * np.arange(count), commands, where="post", color="0.4", ls="--", label="command")
    axes.set(xlabel="time [s]", ylabel="speed [m/s]")
    figure.legend(frameon=False, fontsize=9, loc="outside lower center", ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, out)


def naming(out: Path) -> None:
    """What the best of many effects gains on days with nothing missing: a drawing with made numbers, and it says so."""
    import matplotlib.pyplot as plt

    random = np.random.default_rng(1)
    one = random.chisquare(1, 4000)
    best = random.chisquare(1, (4000, 50)).max(1)
    figure, axes = plt.subplots(figsize=(7.4, 3.2), constrained_layout=True)
    bins = np.linspace(0, 32, 81).tolist()
    axes.hist(one, bins, density=True, color="0.75", label="one effect, chosen beforehand")
    axes.hist(best, bins, density=True, color="tab:blue", alpha=0.7, label="the best of 50 effects")
    limit = np.quantile(best, 0.995)
    axes.axvline(limit, color="tab:red", lw=1.5, label="exceeded on 0.5 % of such days")
    axes.annotate("today", (27, 0.0), (27, 0.1), ha="center", arrowprops={"arrowstyle": "-|>", "color": "black"})
    axes.set(
        xlabel="gain of the fit [chi-squared]",
        ylabel="density",
        xlim=(0, 32),
        ylim=(0, 0.32),
        title="Days on which nothing is missing (made numbers)",
    )
    axes.title.set_fontsize(10)
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, out)


def fleet(out: Path, count: int = 12, steps: int = 150) -> None:
    """Twelve of many chairs at once, each in its own world and with its own parameters, driven by one simple rule."""
    import jax
    import jax.numpy as jnp

    from whill_mjx import make_batch, make_env
    from whill_mjx.env.view_from_above import top_view
    from whill_mjx.tasks.doorway import Doorway
    from whill_mjx.vehicle.kinematics import reference_pose

    env, params = make_env(Doorway(), height=80, width=80)
    chairs = make_batch(env, params, count=count, spread=0.1)
    task = Doorway()

    def aim(state: Any) -> Any:
        """Action towards the door, through it, and on to the marker."""
        x, y, yaw = reference_pose(env.model, state.vehicle.qpos)
        boxes = state.scene.boxes
        left = boxes.centre[3, 1] - boxes.half[3, 1]  # the wall's part to the left begins here
        right = boxes.centre[4, 1] + boxes.half[4, 1]
        door = (left + right) / 2
        goal = state.scene.marker.position[:2]
        target = jnp.where(
            x < task.wall_x - 0.9,
            jnp.array([task.wall_x - 0.6, door]),
            jnp.where(x < task.wall_x + 0.7, jnp.array([task.wall_x + 1.2, door]), goal),
        )
        bearing = jnp.arctan2(target[1] - y, target[0] - x) - yaw
        speed = jnp.clip(0.5 * jnp.cos(2 * bearing), 0.05, 0.5)
        return jnp.stack([2 * (speed - task.v_min) / (task.v_max - task.v_min) - 1, jnp.clip(2.5 * bearing, -1, 1)])

    @jax.jit
    def advance(state: Any) -> tuple[Any, Any]:
        state, _ = chairs.step(state, jax.vmap(aim)(state.env))
        return state, jax.vmap(lambda one: top_view(env, one))(state.env)

    state, _ = jax.jit(chairs.reset)(jax.random.key(5))
    pictures = []
    for number in range(steps):
        state, above = advance(state)
        if number % 2 == 0:
            framed = np.pad(np.asarray(above), ((0, 0), (0, 0), (0, 3), (0, 0)), constant_values=255)
            pictures.append(np.hstack(list(framed)))
    write_film(out, pictures)
    print(f"{out}: {pictures[0].shape}, {out.stat().st_size / 1e3:.0f} kB")


INERTIA = '<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/>'
ROBOT = f"""<robot name="rover"><link name="base">
<inertial><origin xyz="0.05 0 0.1"/><mass value="12"/>{INERTIA.format(x=0.2, y=0.4, z=0.5)}</inertial>
<collision><origin xyz="0.1 0 0.1"/><geometry><box size="0.5 0.34 0.12"/></geometry></collision></link>
WHEELS
<link name="caster"><inertial><mass value="0.2"/>{INERTIA.format(x=1e-4, y=1e-4, z=1e-4)}</inertial>
<collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="caster_joint" type="fixed"><parent link="base"/><child link="caster"/>
<origin xyz="0.28 0 -0.05"/></joint></robot>"""
WHEEL = f"""<link name="SIDE_wheel"><inertial><mass value="0.8"/>{INERTIA.format(x=2e-3, y=4e-3, z=2e-3)}</inertial>
<collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.1" length="0.04"/></geometry></collision></link>
<joint name="SIDE_wheel_joint" type="continuous"><parent link="base"/><child link="SIDE_wheel"/>
<origin xyz="0 PLACE 0"/><axis xyz="0 1 0"/></joint>"""
SIDES = (("left", "0.21"), ("right", "-0.21"))


def robot(out: Path) -> None:
    """What `sysid.inspect` draws of a small made robot with two wheels and a caster."""
    import tempfile

    from benchmarks.tutorials import run_here

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rover.urdf"
        wheels = [WHEEL.replace("SIDE", side).replace("PLACE", place) for side, place in SIDES]
        file.write_text(ROBOT.replace("WHEELS", "".join(wheels)))
        run_here(f"python -m sysid.inspect {file} --out {folder}")
        reduced(Path(folder) / "rover.png", out)


def reduced(source: Path, out: Path, box: tuple[int, int, int, int] | None = None) -> None:
    """A picture cut to `box` (left, top, right, bottom) and made at most WIDEST wide, in 128 colours."""
    from PIL import Image

    picture = Image.open(source).convert("RGB")
    picture = picture.crop(box) if box else picture
    if picture.width > WIDEST:
        picture = picture.resize((WIDEST, round(picture.height * WIDEST / picture.width)), Image.Resampling.LANCZOS)
    temporary = out.with_name(f".{out.name}")
    picture.quantize(128, dither=Image.Dither.NONE).save(temporary, format="PNG", optimize=True)
    temporary.replace(out)
    print(f"{out}: {picture.width} x {picture.height}, {out.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Draw what the command line names."""
    import matplotlib

    matplotlib.use("Agg")
    parser = Parser(
        prog="python -m benchmarks.page_pictures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    kinds.add_parser("concepts", help="frames, drive, naming")
    kinds.add_parser("tutorials", help="pictures of the tutorials").add_argument("folder", type=Path)
    kinds.add_parser("training", help="the drives of a training").add_argument("run", type=Path, metavar="RUN")
    given = parser.parse_args()
    if given.kind == "concepts":
        frames(IMAGES / "concept_frames.png")
        robot(IMAGES / "robot_file.png")
        fleet(IMAGES / "fleet.webp")
        naming(IMAGES / "concept_naming.png")
        drives(IMAGES / "concept_drive.png")
    elif given.kind == "tutorials":
        for name, source in (("last", "last.png"), ("inspect", "inspect/inspect.png"), ("map", "office/scene.png")):
            if (given.folder / "runs" / source).exists():
                reduced(given.folder / "runs" / source, IMAGES / f"tutorial_{name}.png")
            else:
                print(f"{source} is not there; its picture stays as it is")
        worlds(named_task(f"{given.folder / 'parking.py'}:Parking"), IMAGES / "tutorial_parking.png")
    else:
        source = given.run / "drives.png"
        if not source.is_file():
            raise FileNotFoundError(f"RUN {given.run}: has no drives.png. Give the folder of a whole training.")
        reduced(source, IMAGES / "drives.png")


if __name__ == "__main__":
    from whill_mjx import share_results

    with guarded():
        share_results()
        main()
