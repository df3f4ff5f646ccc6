"""Options of the evaluation command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from whill_mjx.evaluation.episodes import NEAR_M
from whill_mjx.io.command_line import NOT_NEGATIVE, SEED, Range, With


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the command."""

    policy: Annotated[str, tyro.conf.Positional]
    """Folder of an exported policy or of its training, or "planner" or "random"."""
    task: str | None = None
    """Name of a task, package.module:TASK or path/to/file.py:TASK; none takes the one that the policy was trained
    for."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 200
    """Episodes of each driver."""
    out: Path = Path("runs/evaluation")
    """Folder for everything that is written."""
    vehicle: str | None = None
    """Vehicle file or preset; none takes the one inside the policy file, else the built-in chair."""
    layout: Literal["randomised", "fixed"] | None = None
    """A new world in each episode, or always the same one; none takes that of the training, else randomised."""
    set: tuple[str, ...] = ()
    """Fields of the task, such as gates=1; those that the policy was trained with are found beside it."""
    looks: Literal["task", "on", "off", "plain", "paper", "rich"] = "task"
    """plain (nothing random), paper (random colours, light and photometric changes) or rich (furnished rooms,
    docs/looks.md); task leaves it to the task. off and on are older names of plain and paper."""
    spread: Annotated[float, Range(0, 1, below=True)] = 0.0
    """Relative spread of the vehicle's parameters from episode to episode."""
    baselines: tuple[str, ...] = ()
    """Also drive the same episodes with planner, random, or another policy as NAME=FOLDER."""
    blind: tuple[Literal["blank", "freeze", "replay"], ...] = ()
    """Proofs of sight: black images, the first image frozen, actions of another episode replayed."""
    sweep: tuple[str, ...] = ()
    """Grids such as "obstacle_x=2,3 obstacle_y=-0.4:0.4:5"; "standard" stands for those of the task."""
    sweep_episodes: Annotated[int, Range(1, 1_000_000), With("sweep")] = 50
    """Episodes in each cell of a grid."""
    videos: Annotated[int, Range(0, 1000)] = 4
    """Failures shown as video, at most."""
    html: bool = False
    """Also write one page with everything."""
    near: Annotated[float, NOT_NEGATIVE] = NEAR_M
    """Distance below which there is a near miss [m]."""
    seed: Annotated[int, SEED] = 2_000_003
    """Random seed of the episodes; training and its own evaluations use others."""
    batch: Annotated[int, Range(1, 1_000_000)] = 1000
    """Episodes at a time."""
    runtime: Literal["jax", "onnxruntime"] = "jax"
    """Who computes the policy: compiled with the simulator, or the vehicle's runtime, slowly."""
