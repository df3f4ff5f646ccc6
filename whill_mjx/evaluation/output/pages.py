"""Pictures, video and page of an evaluation. Imports matplotlib on demand."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from whill_mjx.evaluation.episodes import MEANS, OF_SUCCESSES, SHARES, Episodes, shares_of
from whill_mjx.evaluation.output.pictures import _corners
from whill_mjx.evaluation.sweeps import Sweep
from whill_mjx.io import html
from whill_mjx.io.fields import percent
from whill_mjx.io.folders import write_whole
from whill_mjx.io.png import pyplot, save_figure
from whill_mjx.io.video import write_h264
from whill_mjx.world.collision import from_above

ENDINGS = {"success": "tab:green", "collision": "tab:red", "timeout": "tab:orange", "diverged": "black"}

OWN = "tab:purple"
"""Colour of the endings that a task adds."""
ENDED = {"success": "arrived", "collision": "collision", "timeout": "time-out", "diverged": "diverged"}
"""Words for how an episode ended."""
LANE = np.array([-1.0, -2.2]), np.array([1.6, 2.2])
"""Corners of the picture of a lane: the first from the start, the second from the goal's x and the middle [m]."""
AROUND = 1.5
"""What other pictures show around path and goal [m]."""
FARTHEST = 100.0
"""Points farther from the goal are of a vehicle that diverged [m]."""


def ending(episodes: Episodes, index: int) -> str:
    """How an episode ended."""
    return next((name for name in shares_of(episodes) if episodes.ends[name][index] > 0.5), "timeout")


def _ended(how: str) -> str:
    return ENDED.get(how, how.replace("_", " "))


def draw_scene(axes: Any, scene: Any, goal_radius: float, path: np.ndarray) -> None:
    """Boxes, walls, round things and goal of one scene from above, around a path (T, 2) [m]."""
    boxes, plt = scene.boxes, pyplot()
    for box in range(boxes.yaw.shape[0]):
        if boxes.mask[box]:
            corners = _corners(boxes.centre[box], boxes.half[box], float(boxes.yaw[box]))
            axes.fill(corners[:, 0], corners[:, 1], color=np.clip(boxes.colour[box], 0, 1))
    if scene.walls is not None:
        from matplotlib.collections import LineCollection

        axes.add_collection(LineCollection(list(scene.walls.segments), colors="dimgrey", linewidths=1.0))
    if scene.solids is not None and scene.solids.rounds is not None:
        rounds = jax.tree.map(np.asarray, from_above(scene.solids.rounds))
        for number in np.flatnonzero(rounds.mask):
            colour = np.clip(scene.solids.rounds.colour[number], 0, 1)
            for end in (rounds.start[number], rounds.end[number]):
                axes.add_patch(plt.Circle(end, rounds.radius[number], color=colour))
    goal = np.asarray(scene.marker.position[:2])
    axes.add_patch(plt.Circle(goal, goal_radius, fill=False, color="tab:blue", linestyle=":"))
    axes.plot([goal[0]], [goal[1]], "s", color="tab:blue", markersize=4)
    low, high = _frame(path, goal)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")


def _frame(path: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,) of a picture: those of a lane where it holds path and goal, else `AROUND` them."""
    low, high = LANE[0], LANE[1] + [goal[0], 0.0]
    points = np.vstack([path[np.isfinite(path).all(-1)], goal])
    points = points[np.abs(points - goal).max(-1) < FARTHEST]  # of one that diverged, what is there
    if (points >= low).all() and (points <= high).all():
        return low, high
    return points.min(0) - AROUND, points.max(0) + AROUND


def paths_from_above(episodes: Episodes, goal_radius: float, out: Path, count: int = 12, columns: int = 4) -> Path:
    """Small maps of the first `count` episodes with a legend and a scale bar; paths are coloured by how they ended."""
    plt = pyplot()
    count = min(count, episodes.count)
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(3.2 * columns, 2.2 * rows), squeeze=False, layout="constrained")
    x, y, length = episodes.channel("x"), episodes.channel("y"), episodes.length
    for index, axes in enumerate(grid.flat):
        axes.set_axis_off()
        if index >= count:
            continue
        how, path = ending(episodes, index), np.stack([x[index], y[index]], -1)[: length[index] + 1]
        draw_scene(axes, jax.tree.map(lambda leaf, i=index: leaf[i], episodes.scene), goal_radius, path)
        colour = ENDINGS.get(how, OWN)
        axes.plot(*path.T, "-", color=colour, linewidth=1.5)
        axes.plot(*path[-1], "o", color=colour, markersize=3)
        axes.set_title(f"{_ended(how)}, {episodes.ends['time_s'][index]:.1f} s", fontsize=8, color=colour)
        _scale_bar(axes)
    figure.get_layout_engine().set(h_pad=0.12)
    _legend(figure, {ending(episodes, index) for index in range(count)}, min(3, columns))
    return save_figure(figure, out)


def _scale_bar(axes: Any, metres: float = 1.0) -> None:
    """Draw a bar of this length in the lower left corner."""
    x, y = axes.get_xlim()[0] + 0.15, axes.get_ylim()[0] + 0.15
    axes.plot([x, x + metres], [y, y], "-", color="black", linewidth=2, solid_capstyle="butt")
    axes.text(x + metres + 0.08, y, f"{metres:g} m", va="center", fontsize=6)


def _legend(figure: Any, endings: set[str], columns: int) -> None:
    """Say below the maps, in `columns` columns, what lines and marks mean."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ordered = [*(how for how in ENDINGS if how in endings), *sorted(endings - set(ENDINGS))]
    handles: list[Any] = [Line2D([], [], color=ENDINGS.get(how, OWN), label=f"path: {_ended(how)}") for how in ordered]
    handles += [
        Line2D([], [], color="grey", marker="o", linestyle="", markersize=4,
               label="last position of the drive axle; the body reaches further"),
        Line2D([], [], color="tab:blue", marker="s", linestyle=":", markersize=4, label="goal and its region"),
        Patch(color="grey", label="boxes and walls, in their colours"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=8 if columns > 1 else 7)


def sweep_picture(sweep: Sweep, out: Path, name: str) -> Path:
    """Success of every cell: a heat map for two axes, a curve with its 95 % intervals for one."""
    return _heat_map(sweep, out, name) if len(sweep.axes) == 2 else _curve(sweep, out, name)


def _curve(sweep: Sweep, out: Path, name: str) -> Path:
    plt = pyplot()
    axis = sweep.axes[0]
    figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
    numeric = axis.name != "vehicle"
    at = np.array(axis.values, float) if numeric else np.arange(len(axis.values))
    for share, colour in (("success", "tab:green"), ("collision", "tab:red"), ("timeout", "tab:orange")):
        axes.plot(at, sweep.figures[share], "o-", color=colour, label=share, markersize=4)
        low, high = sweep.intervals[share].T
        axes.fill_between(at, low, high, color=colour, alpha=0.15)
    if not numeric:
        axes.set_xticks(at, axis.labels)
    axes.set_xlabel(axis.name + (" (factor)" if axis.relative else ""))
    axes.set_ylabel(f"share of {sweep.episodes} episodes")
    axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    axes.set_title(name, fontsize=9)
    return save_figure(figure, out)


def _heat_map(sweep: Sweep, out: Path, name: str) -> Path:
    plt = pyplot()
    rows, columns = sweep.axes
    figure, panels = plt.subplots(1, 2, figsize=(5.2 + 1.1 * len(columns.values), 1.7 + 0.5 * len(rows.values)),
                                  layout="constrained")
    for panel, share, colours in zip(panels, ("success", "collision"), ("RdYlGn", "RdYlGn_r"), strict=True):
        shares = sweep.figures[share]
        image = panel.imshow(shares, cmap=colours, vmin=0, vmax=1, origin="lower", aspect="auto")
        for (row, column), value in np.ndenumerate(shares):
            panel.text(column, row, f"{100 * value:.0f}", ha="center", va="center", fontsize=8)
        panel.set_xticks(range(len(columns.values)), columns.labels, fontsize=8)
        panel.set_yticks(range(len(rows.values)), rows.labels, fontsize=8)
        panel.set_xlabel(columns.name, fontsize=9)
        panel.set_ylabel(rows.name, fontsize=9)
        panel.set_title(f"{share} [%]", fontsize=9)
        figure.colorbar(image, ax=panel, shrink=0.9)
    figure.suptitle(f"{name}, {sweep.episodes} episodes per cell", fontsize=9)
    return save_figure(figure, out)


def sweep_paths(sweep: Sweep, out: Path, goal_radius: float) -> Path:
    """Paths of every cell from above, on the scene of its first episode."""
    plt = pyplot()
    shape = (1, *sweep.figures["success"].shape)[-2:]
    figure, grid = plt.subplots(*shape, squeeze=False, layout="constrained",
                                figsize=(2.6 * shape[1] + 0.4, 1.9 * shape[0] + 0.3))
    labels = itertools.product(*([f"{axis.name} {label}" for label in axis.labels] for axis in sweep.axes))
    for index, ((paths, scene), label, axes) in enumerate(zip(sweep.paths, labels, grid.flat, strict=True)):
        draw_scene(axes, scene, goal_radius, paths.reshape(-1, 2))
        for path in paths:
            axes.plot(path[:, 0], path[:, 1], color="tab:purple", linewidth=0.6, alpha=0.5)
        axes.set_title(f"{', '.join(label)}: {100 * sweep.figures['success'].flat[index]:.0f} %", fontsize=7)
        axes.set_axis_off()
    return save_figure(figure, out)


def episode_video(
    episodes: Episodes, frames: np.ndarray, above: np.ndarray, out: Path, rate_hz: float, scale: int = 4
) -> Path:
    """H.264 video of a few episodes side by side: the camera over the view from above, framed when it has ended.

    Args:
        episodes: V of them.
        frames: (V, T + 1, H, W, 3) uint8 camera images.
        above: (V, T + 1, 2H, W, 3) uint8 views from above.
        out: file to write.
        rate_hz: frames per second.
        scale: enlargement.
    """
    colours = {"success": (40, 160, 60), "collision": (210, 40, 40), "timeout": (240, 150, 30), "diverged": (0, 0, 0)}
    own = 148, 103, 189

    def tile(index: int, length: int, step: int) -> np.ndarray:
        row = min(step, length)
        shown = np.concatenate([frames[index, row], above[index, row]]).repeat(scale, 0).repeat(scale, 1)
        if step >= length:
            for edge in (np.s_[:6], np.s_[-6:], np.s_[:, :6], np.s_[:, -6:]):
                shown[edge] = colours.get(ending(episodes, index), own)
        return shown

    steps = range(int(episodes.length.max()) + round(rate_hz))
    pictures = (
        np.concatenate([tile(index, int(length), step) for index, length in enumerate(episodes.length)], axis=1)
        for step in steps
    )
    return write_h264(out, pictures, max(1, round(rate_hz)))


WORDS = {
    "success": "success", "collision": "collision", "timeout": "time-out", "diverged": "simulation diverged",
    "return": "return", "min_clearance_m": "smallest clearance [m]", "path_length_m": "path length [m]",
    "mean_speed_m_s": "mean speed [m/s]", "command_change_rad_s2": "change of the yaw-rate command [rad/s²]",
    "acceleration_rms_m_s2": "acceleration, RMS [m/s²]",
    "yaw_acceleration_rms_rad_s2": "yaw acceleration, RMS [rad/s²]",
    "near_misses": "near misses per episode", "near_s": "time in near misses [s]",
    "time_to_goal_s": "time to the goal [s]",
}  # fmt: skip
"""Words for the figures of a summary."""
DRIVERS = {
    "policy": "the policy", "planner": "planner that knows the scene", "random": "random actions",
    "blank": "with black images", "freeze": "with its first image alone",
    "replay": "with another episode's actions",
}  # fmt: skip
"""Words for drivers and for proofs of sight."""
CAPTIONS = {
    "paths": "Drives of the policy from above", "failures": "Drives that failed, from above",
    "paths_planner": "Drives of the planner from above",
}
"""Captions of pictures by the stem of their names."""


def page(evaluation: dict[str, Any], pictures: list[Path], videos: list[Path], out: Path) -> Path:
    """Write one page with the table of figures and the pictures; the videos stay beside it."""
    drivers, task = evaluation["drivers"], evaluation["task"]["name"].replace("_", " ")
    first = next(iter(drivers.values()))
    sections = [html.Section("Figures", _figures(drivers)), html.Section("What the figures mean", _meanings(first))]
    shown = "".join(html.png(path, _caption(path)) for path in pictures)
    sections += [html.Section("Pictures", shown)] if pictures else []
    moving = "".join(html.video(path.name, "Episodes that failed, as the camera saw them and from above")
                     for path in videos)  # fmt: skip
    sections += [html.Section("Videos", moving)] if videos else []
    device = " ".join(dict.fromkeys(evaluation["device"].split(": ")))
    subtitle = f"{first['episodes']} episodes with each driver; computed on {device}"
    main_name = next(iter(drivers))
    lead = f"{_driver(main_name).capitalize()} succeeds in {_shown('success', first['success'])} of the episodes."
    lead += _sight(first, [one for name, one in drivers.items() if name.startswith(f"{main_name} ")])
    title = f"Evaluation of {evaluation['policy']} in the task {task}"
    write_whole(out, html.html_page(title, sections, subtitle, kind="Evaluation", lead=lead))
    return out


def _sight(seeing: dict[str, Any], blind: list[dict[str, Any]]) -> str:
    """How often the policy succeeds without sight, and what this shows; empty where it was not tried."""
    if not blind:
        return ""
    most = _shown("success", max(one["success"] for one in blind))
    needs = seeing["success_interval_95"][0] > max(one["success_interval_95"][1] for one in blind)
    shows = "so it drives by what it sees" if needs else "so nothing shows that it uses its camera"
    return f" Without sight it succeeds in at most {most}: {shows}."


def _figures(drivers: dict[str, Any]) -> str:
    first = next(iter(drivers.values()))
    rows: list[list[Any]] = []
    measured = [name.removesuffix("_interval_95") for name in first if name.endswith("_interval_95")]
    own = [name for name in measured if name not in WORDS]  # endings of the task
    for name in (*SHARES, *own, *(name for name in WORDS if name in measured and name not in SHARES)):
        cells = [_with_interval(name, one.get(name), one.get(f"{name}_interval_95")) for one in drivers.values()]
        rows.append([WORDS.get(name, _ended(name)), *cells])
    return html.table(["figure", *map(_driver, drivers)], rows, "in brackets: the 95% interval")


def _meanings(first: dict[str, Any]) -> str:
    texts = {**MEANS, **OF_SUCCESSES}
    items = [f"{WORDS[name]}: {texts[name]}" for name in texts]
    return html.bullets([*items, f"near miss: closer than {first['near_m']:g} m to a box or a wall"])


def _driver(name: str) -> str:
    """A driver in words: "policy freeze" is the policy without sight."""
    base, _, blind = name.partition(" ")
    text = DRIVERS.get(base, base)
    return f"{text} {DRIVERS[blind]}" if blind in DRIVERS else text


def _caption(path: Path) -> str:
    stem = path.stem
    if stem.startswith("sweep_"):
        return f"Success over {stem.removeprefix('sweep_').replace('_', ' ')}"
    return CAPTIONS.get(stem, f"Drives from above: {_driver(stem.removeprefix('paths_').replace('_', ' '))}")


def _shown(name: str, value: float | None) -> str:
    if value is None:
        return "–"
    return html.number(float(value)) if name in {*MEANS, *OF_SUCCESSES} else percent(value)


def _with_interval(name: str, value: float | None, interval: list[float] | None) -> str:
    between = "" if interval is None else f" ({_shown(name, interval[0])} to {_shown(name, interval[1])})"
    return _shown(name, value) + between
