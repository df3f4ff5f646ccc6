"""Picture of a training run, and what pictures share. Imports matplotlib on demand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from whill_mjx.io.png import pyplot, save_figure
from whill_mjx.io.reading import read_lines


def reward_curve(
    metrics: Path, out: Path, reference: dict[str, float] | None = None, action_repeat: int = 1
) -> Path:
    """Return and success against environment steps, as the progress bar counts them.

    Args:
        metrics: metrics.jsonl of a training.
        out: picture to write.
        reference: adds horizontal lines of return.
        action_repeat: control periods of a step; the axis says so.
    """
    plt = pyplot()
    lines = [line for _, line in read_lines(metrics)]
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 6), sharex=True, layout="constrained")
    for name, label, style in (("episode/return", "training episodes", "-"), ("eval/return", "evaluation", "o-")):
        points = [(line["env_steps"], line[name]) for line in lines if name in line]
        if points:
            top.plot(*zip(*points, strict=True), style, label=label, markersize=3, linewidth=1)
    for label, value in (reference or {}).items():
        top.axhline(value, linestyle="--", linewidth=1, color="grey")
        top.annotate(label, (0.01, value), xycoords=("axes fraction", "data"), va="bottom", fontsize=8)
    for name, label, colour in (("eval/success", "success", "tab:green"), ("eval/collision", "collision", "tab:red"),
                                ("eval/timeout", "time-out", "tab:orange")):  # fmt: skip
        points = [(line["env_steps"], line[name]) for line in lines if name in line]
        if points:
            bottom.plot(*zip(*points, strict=True), "o-", color=colour, label=label, markersize=3, linewidth=1)
    top.set_ylabel("return")
    bottom.set_ylabel("share of evaluation episodes")
    each = f"each {action_repeat} control periods" if action_repeat > 1 else "each one control period"
    bottom.set_xlabel(f"environment steps ({each}), summed over instances")
    bottom.set_ylim(-0.02, 1.02)
    for axes in (top, bottom):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    return save_figure(figure, out)


def _corners(centre: np.ndarray, half_size: np.ndarray, yaw: float) -> np.ndarray:
    """Corners (4, 2) of a box's footprint."""
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    cos, sin = np.cos(yaw), np.sin(yaw)
    return centre[:2] + (signs * half_size[:2]) @ np.array([[cos, sin], [-sin, cos]])
