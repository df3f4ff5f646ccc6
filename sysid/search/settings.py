"""How a log is fitted: the settings of a fit, and the constants of its searches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from sysid.errors.prior import SPREAD
from whill_mjx.io.command_line import PHYSICS_DT, SEED, Range, With

QUICK_TRIALS = 24  # trials fitted in quick mode, spread over the log
QUICK_EVALUATIONS = 64
QUICK_ITERATIONS = 14
TRIED, TOGETHER = 4, 3.0  # steps on poses, and how often their errors may count the same information
FEATURE_ITERATIONS = 20
BATCH = {"tpe": 4, "cmaes": 16}  # candidates simulated together: at no loss on a processor; a population
GLOBAL = tuple(BATCH)  # methods that end with their global search


@dataclass(frozen=True)
class FitConfig:
    """How a log is fitted."""

    preset: Literal["paper", "physical"] = "physical"
    """Base model whose parameters are fitted."""
    method: Literal["features", "lm", "tpe", "cmaes", "both"] = "features"
    """features: gradient search on motion in short bins, whitened in the end. lm: on poses. tpe, cmaes: global search.
    both: a short global search that gives the gradient search on poses its starts."""
    trials: Annotated[int, Range(1, 1_000_000), With("method", ("tpe", "cmaes", "both"))] = 192
    """Parameter sets that the global search tries."""
    storage: str = ""
    """Where the global search keeps its study, for several processes at once: journal:FILE or a database URL."""
    study: Annotated[str, With("storage")] = "fit"
    """Name of the study there."""
    starts: Annotated[int, Range(1, 10_000)] = 1
    """Starts of the gradient search: the initial values, and random ones (features: each the best of many) or the best
    of the global search (both: at least one of them)."""
    iterations: Annotated[int, Range(1, 10_000)] = 40
    """Iterations of the gradient search, after the first one on features."""
    elsewhere: bool = True
    """Whether the gradient search also starts far away along ranges where that costs little, from other delays, and
    from random points close to its end. A fit of a robot file does not: that takes four times as long."""
    seed: Annotated[int, SEED] = 0
    """Seed of both searches."""
    quick: bool = False
    """Fewer trials, candidates and iterations: minutes on two cores."""
    channels: Literal["both", "ground_truth", "odometry"] = "both"
    """Which measurements are fitted; all are scored."""
    robust: bool = True
    """Count large residuals linearly (Huber): a model is least exact where wheels skid."""
    parameters: tuple[str, ...] = ()
    """Names to fit; by default all that a driving log can determine."""
    effects: tuple[str, ...] = ()
    """Effects of the catalogue (docs/effects.md) that the model gets as well, fitted from where they do nothing."""
    calibrate: bool = True
    """Whether wheel radii, track, scales of the odometry and the tracked point are fitted as well, where an outside
    pose shows them and drives that are held back come out better so."""
    all_sizes: bool = False
    """Keep all of these free, also where drives that are held back do not need them."""
    profile: tuple[str, ...] = ()
    """Parameters whose profile likelihood is traced, or `all`: each takes a search of its own."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.0025
    """Physics step [s]: with 5 ms a skid that begins errs by several noise scales, and gains and limit with it."""
    vehicle: Path | None = None
    """Vehicle file of an earlier fit: where the search starts, and what is known before (instead of the preset)."""
    spread: Annotated[float, Range(0, 10, above=True), With("vehicle")] = SPREAD
    """With a vehicle file: standard deviation of a parameter from day to day, as a share of its value (assumed)."""
    model: str = ""
    """Another model in place of the simulator's vehicle: an MJCF or URDF file, or FILE.py[:NAME] (docs/fit.md)."""
    wheels: tuple[str, ...] = ()
    """With an MJCF or URDF file: joints or actuators of the driven wheels, left and right."""
