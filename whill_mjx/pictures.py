"""Pictures of a training run: reward curve, drives from above, camera video. Imports matplotlib on demand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from whill_mjx.training import Drives


def reward_curve(metrics: Path, out: Path, action_repeat: int, reference: dict[str, float] | None = None) -> Path:
    """Return and success against control steps, from a metrics.jsonl; `reference` adds horizontal lines of return."""
    plt = _pyplot()
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 6), sharex=True, layout="constrained")
    for name, label, style in (("episode/return", "training episodes", "-"), ("eval/return", "evaluation", "o-")):
        points = [(line["env_steps"] * action_repeat, line[name]) for line in lines if name in line]
        if points:
            top.plot(*zip(*points, strict=True), style, label=label, markersize=3, linewidth=1)
    for label, value in (reference or {}).items():
        top.axhline(value, linestyle="--", linewidth=1, color="grey")
        top.annotate(label, (0.01, value), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    for name, label in (("eval/success", "success"), ("eval/collision", "collision"), ("eval/timeout", "time-out")):
        points = [(line["env_steps"] * action_repeat, line[name]) for line in lines if name in line]
        if points:
            bottom.plot(*zip(*points, strict=True), "o-", label=label, markersize=3, linewidth=1)
    top.set_ylabel("return")
    bottom.set_ylabel("share of evaluation episodes")
    bottom.set_xlabel("control steps (0.1 s), summed over instances")
    bottom.set_ylim(-0.02, 1.02)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    return _save(figure, out)


def drives_from_above(drives: Drives, goal_radius: float, out: Path, columns: int = 4, count: int = 12) -> Path:
    """Small maps of the first `count` drives: boxes, goal region, path coloured by how it ended."""
    plt = _pyplot()
    count = min(count, len(drives.length))
    rows = -(-count // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(3.2 * columns, 2.2 * rows), squeeze=False, layout="constrained")
    boxes, marker = drives.scenes.boxes, drives.scenes.marker
    for index, axes in enumerate(grid.flat):
        axes.set_axis_off()
        if index >= count:
            continue
        for box in range(boxes.yaw.shape[1]):
            if boxes.mask[index, box]:
                corners = _corners(boxes.centre[index, box], boxes.half[index, box], boxes.yaw[index, box])
                axes.fill(corners[:, 0], corners[:, 1], color=np.clip(boxes.colour[index, box], 0, 1))
        goal = marker.position[index]
        axes.add_patch(plt.Circle((goal[0], goal[1]), goal_radius, fill=False, color="tab:blue", linestyle=":"))
        path = drives.path[index, : drives.length[index] + 1]
        endings = ("success", "collision", "timeout")
        ending = next((name for name in endings if drives.metrics[name][index] > 0.5), "other")
        colour = {"success": "tab:green", "collision": "tab:red"}.get(ending, "tab:orange")
        axes.plot(path[:, 0], path[:, 1], ".-", color=colour, linewidth=1.5, markersize=3)
        axes.set_title(f"{ending}, {drives.metrics['time_s'][index]:.1f} s", fontsize=8, color=colour)
        axes.set_xlim(-1.0, 7.0)
        axes.set_ylim(-2.2, 2.2)
        axes.set_aspect("equal")
    return _save(figure, out)


def camera_video(drives: Drives, out: Path, rate_hz: float, scale: int = 4) -> Path:
    """H.264 video of the recorded cameras side by side, each until its episode ends."""
    import imageio.v2 as imageio
    import imageio_ffmpeg  # noqa: F401  without it imageio would take another writer for the file

    videos = drives.frames.shape[0]
    length = int(drives.length[:videos].max()) + 1
    out.parent.mkdir(parents=True, exist_ok=True)
    writer: Any  # its type stub lacks append_data
    with imageio.get_writer(out, fps=max(1, round(rate_hz)), macro_block_size=8, quality=7) as writer:
        for step in range(length):
            tiles = [drives.frames[i, min(step, int(drives.length[i]))] for i in range(videos)]
            writer.append_data(np.concatenate(tiles, axis=1).repeat(scale, axis=0).repeat(scale, axis=1))
    return out


def _corners(centre: np.ndarray, half_size: np.ndarray, yaw: float) -> np.ndarray:
    """Corners (4, 2) of a box's footprint."""
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return centre[:2] + (signs * half_size[:2]) @ np.array([[cos, sin], [-sin, cos]])


def _pyplot():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure, out: Path) -> Path:
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=130)
    _pyplot().close(figure)
    return out
