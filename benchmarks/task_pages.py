"""The pages of the tasks, docs/reference/tasks/*.md, and their pictures.

python -m benchmarks.task_pages page       # from the classes in whill_mjx/tasks; a test keeps them up to date
python -m benchmarks.task_pages picture    # docs/images/task_*.png: three worlds of each task
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import textwrap
from pathlib import Path
from typing import Any

from bridge.nodes.options import Parser
from whill_mjx.io.command_line import guarded
from whill_mjx.io.folders import write_whole
from whill_mjx.tasks.base import Task

DOCS = Path(__file__).parent.parent / "docs"
TERMS = {
    "goal": "{goal_reward:g} in the period in which the vehicle arrives",
    "collision": "{collision_reward:g} in the period in which the vehicle touches something",
    "progress": "{progress_gain:g} for each metre that the goal came nearer",
    "time": "{step_reward:g} in every control period",
    "smoothness": "-{smoothness_gain:g} for each rad/s by which the commanded yaw rate changed",
    "alignment": "-{alignment_gain:g} per rad off the dock's direction, in every period within 1 m of the dock",
    "distance": "{near_reward:g} in every period at the best distance from the person, {keep:g} m; less elsewhere",
    "haste": "-{haste_gain:g} for each m/s of speed towards a person that would touch them within {haste_time:g} s, in "
             "every period",
    "lost": "{collision_reward:g} in the period in which the person is lost",
}
"""What a term of the reward pays, by its name."""
ENDINGS = {
    "collision": "the vehicle touches a box, a wall or a person",
    "success": "the driven-axle centre is within {goal_radius:g} m of the goal",
    "timeout": "{max_steps} control periods ({seconds:g} s) are over; the episode is *truncated*",
    "diverged": "the physics failed; this never counts as a success",
    "lost": "the person is more than {lost_at:g} m away",
}
SUCCESS = {
    "docking": "the vehicle stands within {goal_radius:g} m of the dock and {heading_tolerance:g} rad of its direction",
    "follow": "the person has stopped at the end of their way, and the vehicle is within {goal_radius:g} m",
}
"""Where success is something else than to be near the goal."""
LIMITS = ("v_min", "v_max", "omega_max", "max_steps", "goal_radius", "goal_reward", "collision_reward",
          "progress_gain", "step_reward", "smoothness_gain")  # fmt: skip


def names() -> list[str]:
    """Names of the tasks of this package."""
    from whill_mjx.tasks.tasks import TASKS

    return sorted(name for name in TASKS if type(TASKS[name]).__module__.startswith("whill_mjx."))


def field_texts(kind: type) -> dict[str, str]:
    """The text below each field of a class and of the classes that it extends."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if base is object or not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(body, ast.ClassDef)
        for entry, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name) \
                    and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):  # fmt: skip
                texts[entry.target.id] = " ".join(str(after.value.value).split())
    return texts


def observation_rows(task: Task) -> list[str]:
    """Table rows of what a task observes."""
    from whill_mjx.env import make_env

    env, _ = make_env(task)
    sensors = task.observations()
    if not sensors:
        return [f"| image of the camera | ({env.height}, {env.width}, 3) uint8 | 0 to 255 |"]
    rows = []
    for name, sensor in sensors.items():
        reading = sensor.reading(env)
        text = (inspect.getdoc(type(sensor)) or name).splitlines()[0].rstrip(".")
        low, high = (f"{value:g}".replace("inf", "any") for value in (reading.low, reading.high))
        limits = "any" if "any" in low + high else f"{low} to {high}"
        rows.append(f"| `{name}`: {text} | {reading.shape} {dtype_name(reading.dtype)} | {limits} |")
    return rows


def dtype_name(dtype: Any) -> str:
    """Name of a type of numbers, such as float32."""
    import numpy as np

    return np.dtype(dtype).name


def terms_of(task: Task) -> tuple[list[str], list[str]]:
    """Names of the terms of the reward, and of the endings."""
    import jax

    from whill_mjx.tasks.base import Task as Base
    from whill_mjx.tasks.check import _moment

    source = Base() if task.name == "map_goal" else task  # without a map there is no world
    moment = _moment(jax.eval_shape(source.sample_world, jax.random.key(0)))
    return [*jax.eval_shape(task.rewards, moment)], [*jax.eval_shape(task.endings, moment)]


def paid(term: str, words: dict[str, Any]) -> str:
    """What a term of the reward pays, in words."""
    text = TERMS[term].format(**words)
    return "nothing: its gain is 0" if text.startswith("-0 ") else text


def page(name: str) -> str:
    """Markdown of one task's page."""
    from whill_mjx.tasks.tasks import TASKS

    task = TASKS[name]
    kind, fields = type(task), {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    words = {**fields, "seconds": task.max_steps / 10}
    rewards, endings = terms_of(task)
    said = {**ENDINGS, "success": SUCCESS.get(name, ENDINGS["success"])}
    texts = field_texts(kind)
    own = [field for field in fields if field not in LIMITS and field in texts and field != "action_repeat"]
    gym = "".join(part.title() for part in name.split("_"))
    doc = inspect.cleandoc(kind.__doc__ or "").replace("\n\n", "\0").replace("\n", " ").replace("\0", "\n\n")
    lines = [
        f"# {name}", "",
        "<!-- Written by python -m benchmarks.task_pages page. -->", "",
        doc, "",
        f"![Three worlds of {name}: what the camera sees at the start, and the world from above]"
        f"(../../images/task_{name}.png)",
        "", "| | |", "|---|---|",
        f"| Gymnasium | `gymnasium.make(\"whill_mjx.gym:Whill{gym}-v0\")` |",
        f"| commands | `--task {name}` |",
        f"| source | `whill_mjx/tasks/{name}.py` |",
        "", "## Observation", "", "| what | shape and type | range |", "|---|---|---|", *observation_rows(task),
        "", "## Action", "", "| number | range | meaning |", "|---|---|---|",
        f"| 0 | -1 to 1 | forward speed, {task.v_min:g} to {task.v_max:g} m/s |",
        f"| 1 | -1 to 1 | yaw rate, {-task.omega_max:g} to {task.omega_max:g} rad/s; positive turns left |",
        "", "One step is a control period of 0.1 s.",
        "", "## Reward", "", "The reward is the sum of these terms.", "", "| term | pays |", "|---|---|",
        *(f"| `{term}` | {paid(term, words)} |" for term in rewards),
        "", "## End of an episode", "", "| ending | when |", "|---|---|",
        *(f"| `{ending}` | {said[ending].format(**words)} |" for ending in [*endings, "timeout", "diverged"]),
        "", "## Drawn anew for each episode", "", f"{(inspect.getdoc(kind.sample_world) or '').splitlines()[0]}",
        *(["", "## Fields", "", "`--set NAME=VALUE` changes one of these fields, and the limits and gains above.", "",
           "| field | default | meaning |", "|---|---|---|",
           *(f"| `{field}` | `{fields[field]!r}` | {texts[field]} |" for field in own)] if own else []),
        "", "## Training", "", training_text(task), "",
    ]  # fmt: skip
    return "\n".join(lines)


def training_text(task: Task) -> str:
    """One or two sentences on the presets that know the task."""
    if not task.budgets:
        return "No preset but `smoke` has a budget for this task. Give `train` a number of steps: `--steps 200000`."
    budgets = ", ".join(f"`{name}` ({budget.steps:,} steps)" for name, budget in task.budgets.items())
    return f"Presets with a budget for this task: {budgets}. [Which preset](../../training.md#which-preset)."


def picture(name: str, out: Path) -> None:
    """Three random worlds of a known task."""
    import tempfile

    from whill_mjx.tasks.tasks import TASKS

    with tempfile.TemporaryDirectory() as folder:
        task: Any = TASKS[name]
        if name == "map_goal":
            task = dataclasses.replace(task, map=_map(Path(folder)))
        worlds(task, out)


def worlds(task: Task, out: Path) -> None:
    """Three random worlds: what the camera sees at the start, larger than for a policy, and the world from above."""
    import cv2
    import jax
    import numpy as np

    from whill_mjx.env import make_env, reset_state
    from whill_mjx.env.view_from_above import top_view
    from whill_mjx.vehicle.kinematics import camera_pose
    from whill_mjx.world.maps.walls import shown
    from whill_mjx.world.render import Quality, pinhole, render

    env, params = make_env(task, height=120, width=120)

    @jax.jit
    def draw(key: jax.Array) -> tuple[jax.Array, ...]:
        state = reset_state(env, params, key)
        position, rotation = camera_pose(env.model, state.vehicle.qpos)
        lens = pinhole(env.model.spec.camera.fov_y, 240, 240)
        scene = shown(state.scene, position, rotation, lens)
        seen = render(position, rotation, lens, scene, Quality(antialias=True, shadows=True))
        return seen, top_view(env, state), state.scene.marker.position[:2]

    chosen: list[np.ndarray] = []  # their goal is in the view from above
    others: list[np.ndarray] = []
    for seed in range(50):
        seen, above, goal = (np.asarray(one) for one in draw(jax.random.key(seed)))
        column = np.hstack([seen, above, np.full((240, 8, 3), 255, np.uint8)])
        (chosen if 1.0 < goal[0] < 6.5 and abs(goal[1]) < 2.0 else others).append(column)
    sheet = np.hstack([*chosen, *others][:3])[:, :-8, ::-1]
    cv2.imwrite(str(out), sheet, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{out}: {sheet.shape[1]} x {sheet.shape[0]}")


def _map(folder: Path) -> str:
    """A small made map: two rooms and a door."""
    import numpy as np

    wall = np.full((120, 200), 254, np.uint8)
    wall[:2] = wall[-2:] = wall[:, :2] = wall[:, -2:] = 0
    wall[:, 99:102] = 0
    wall[48:76, 99:102] = 254
    wall[20:34, 140:160] = 0
    (folder / "office.pgm").write_bytes(b"P5 200 120 255\n" + wall.tobytes())
    (folder / "office.yaml").write_text(
        "image: office.pgm\nresolution: 0.05\norigin: [0.0, -3.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    return str(folder / "office.yaml")


def main() -> None:
    """Write the pages or the pictures."""
    parser = Parser(
        prog="python -m benchmarks.task_pages",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=("page", "picture"))
    parser.add_argument("--tasks", nargs="+", choices=names(), default=names(), help="only these")
    given = parser.parse_args()
    for name in given.tasks:
        if given.what == "page":
            write_whole(DOCS / "reference" / "tasks" / f"{name}.md", page(name).encode())
        else:
            picture(name, DOCS / "images" / f"task_{name}.png")


if __name__ == "__main__":
    from whill_mjx import share_results

    with guarded():
        share_results()
        main()
