"""Pictures, video and page of an evaluation. Imports matplotlib and imageio on demand."""

from __future__ import annotations

import base64
import html
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from whill_mjx.evaluation.episodes import Episodes
from whill_mjx.evaluation.pictures import _corners, _pyplot, _save
from whill_mjx.evaluation.sweeps import Sweep
from whill_mjx.folders import whole_file, write_whole

ENDINGS = {"success": "tab:green", "collision": "tab:red", "timeout": "tab:orange", "diverged": "black"}


def ending(episodes: Episodes, index: int) -> str:
    """How an episode ended."""
    return next((name for name in ENDINGS if episodes.ends[name][index] > 0.5), "timeout")


def draw_scene(axes: Any, scene: Any, goal_radius: float) -> None:
    """Boxes and goal of one scene from above."""
    boxes = scene.boxes
    for box in range(boxes.yaw.shape[0]):
        if boxes.mask[box]:
            corners = _corners(boxes.centre[box], boxes.half[box], float(boxes.yaw[box]))
            axes.fill(corners[:, 0], corners[:, 1], color=np.clip(boxes.colour[box], 0, 1))
    goal = scene.marker.position
    axes.add_patch(_pyplot().Circle((goal[0], goal[1]), goal_radius, fill=False, color="tab:blue", linestyle=":"))
    axes.plot([goal[0]], [goal[1]], "s", color="tab:blue", markersize=4)
    axes.set_xlim(-1.0, float(goal[0]) + 1.6)
    axes.set_ylim(-2.2, 2.2)
    axes.set_aspect("equal")


def paths_from_above(episodes: Episodes, goal_radius: float, out: Path, count: int = 12, columns: int = 4) -> Path:
    """Small maps of the first `count` episodes: boxes, goal region, path coloured by how it ended."""
    plt = _pyplot()
    count = min(count, episodes.count)
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(3.2 * columns, 2.2 * rows), squeeze=False, layout="constrained")
    x, y, length = episodes.channel("x"), episodes.channel("y"), episodes.length
    for index, axes in enumerate(grid.flat):
        axes.set_axis_off()
        if index >= count:
            continue
        draw_scene(axes, jax.tree.map(lambda leaf, i=index: leaf[i], episodes.scene), goal_radius)
        how, rows_driven = ending(episodes, index), slice(0, length[index] + 1)
        axes.plot(x[index, rows_driven], y[index, rows_driven], "-", color=ENDINGS[how], linewidth=1.5)
        axes.plot(x[index, length[index]], y[index, length[index]], "o", color=ENDINGS[how], markersize=3)
        axes.set_title(f"{how}, {episodes.ends['time_s'][index]:.1f} s", fontsize=8, color=ENDINGS[how])
    return _save(figure, out)


def sweep_picture(sweep: Sweep, out: Path, name: str) -> Path:
    """Success of every cell: a heat map for two axes, a curve with its 95 % intervals for one."""
    return _heat_map(sweep, out, name) if len(sweep.axes) == 2 else _curve(sweep, out, name)


def _curve(sweep: Sweep, out: Path, name: str) -> Path:
    plt = _pyplot()
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
    return _save(figure, out)


def _heat_map(sweep: Sweep, out: Path, name: str) -> Path:
    plt = _pyplot()
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
    return _save(figure, out)


def sweep_paths(sweep: Sweep, out: Path, goal_radius: float) -> Path:
    """Paths of every cell from above, on the scene of its first episode."""
    plt = _pyplot()
    shape = (1, *sweep.figures["success"].shape)[-2:]
    figure, grid = plt.subplots(*shape, squeeze=False, layout="constrained",
                                figsize=(2.6 * shape[1] + 0.4, 1.9 * shape[0] + 0.3))
    labels = itertools.product(*([f"{axis.name} {label}" for label in axis.labels] for axis in sweep.axes))
    for index, ((paths, scene), label, axes) in enumerate(zip(sweep.paths, labels, grid.flat, strict=True)):
        draw_scene(axes, scene, goal_radius)
        for path in paths:
            axes.plot(path[:, 0], path[:, 1], color="tab:purple", linewidth=0.6, alpha=0.5)
        axes.set_title(f"{', '.join(label)}: {100 * sweep.figures['success'].flat[index]:.0f} %", fontsize=7)
        axes.set_axis_off()
    return _save(figure, out)


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
    import imageio.v2 as imageio
    import imageio_ffmpeg  # noqa: F401  without it imageio would take another writer for the file

    writer: Any  # its type stub lacks append_data
    colours = {"success": (40, 160, 60), "collision": (210, 40, 40), "timeout": (240, 150, 30), "diverged": (0, 0, 0)}
    fps = max(1, round(rate_hz))
    with (
        whole_file(out) as temporary,
        imageio.get_writer(temporary, format="FFMPEG", fps=fps, macro_block_size=8, quality=7) as writer,
    ):
        for step in range(int(episodes.length.max()) + round(rate_hz)):
            tiles = []
            for index, length in enumerate(episodes.length):
                row = min(step, int(length))
                tile = np.concatenate([frames[index, row], above[index, row]]).repeat(scale, 0).repeat(scale, 1)
                if step >= length:
                    for edge in (np.s_[:6], np.s_[-6:], np.s_[:, :6], np.s_[:, -6:]):
                        tile[edge] = colours[ending(episodes, index)]
                tiles.append(tile)
            writer.append_data(np.concatenate(tiles, axis=1))
    return out


def page(title: str, evaluation: dict[str, Any], pictures: list[Path], videos: list[Path], out: Path) -> Path:
    """One self-contained page with the table of figures and the pictures; videos are linked beside it."""
    drivers = evaluation["drivers"]
    names = [name for name, value in next(iter(drivers.values())).items()
             if f"{name}_interval_95" in next(iter(drivers.values()))]
    rows = []
    for name in names:
        cells = "".join(f"<td>{_cell(entry[name], entry[f'{name}_interval_95'])}</td>" for entry in drivers.values())
        rows.append(f"<tr><th>{html.escape(name)}</th>{cells}</tr>")
    head = "".join(f"<th>{html.escape(name)}</th>" for name in drivers)
    images = "".join(
        f"<figure><img src='data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}'>"
        f"<figcaption>{html.escape(path.name)}</figcaption></figure>"
        for path in pictures
    )
    links = "".join(f"<p><video controls width='640' src='{html.escape(path.name)}'></video></p>" for path in videos)
    style = ("body{font:14px sans-serif;margin:2em;max-width:1200px}table{border-collapse:collapse}"
             "td,th{border:1px solid #ccc;padding:3px 8px;text-align:right}img{max-width:100%}")
    text = (
        f"<!doctype html><meta charset='utf-8'><title>{html.escape(title)}</title><style>{style}</style>"
        f"<h1>{html.escape(title)}</h1><p>{next(iter(drivers.values()))['episodes']} episodes each; brackets are 95 % "
        f"intervals.</p><table><tr><th></th>{head}</tr>{''.join(rows)}</table>{images}{links}\n"
    )
    write_whole(out, text)
    return out


def _cell(value: float | None, interval: list[float] | None) -> str:
    if value is None or interval is None:
        return "-"
    return f"{value:.3g} <small>[{interval[0]:.3g}, {interval[1]:.3g}]</small>"
