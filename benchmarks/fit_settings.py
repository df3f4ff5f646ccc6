"""What the benchmark of fits measures: its parts and their sizes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks import fit_searches
from sysid.search.settings import FitConfig


@dataclass(frozen=True)
class Benchmark:
    """What to measure."""

    shared: Path = Path(os.environ.get("WHILL_SHARED", Path(__file__).parents[2] / "shared"))
    """Folder that holds data/plant and data/measured."""
    parts: tuple[Literal["planted", "plant", "chair", "contact", "few", "speed", "many_starts", "starts", "coverage",
                         "tpe", "searches", "drive", "mrclam"], ...] = (
        "planted", "plant", "chair", "contact", "drive", "mrclam")
    part: str = "1/1"
    """I/N: of contact, few, coverage, starts, tpe and searches, every N-th job, where several processes share them."""
    work: Path = Path("runs/fit")
    """Folder for the results of those jobs; what is there is not done again."""
    collect: bool = False
    """Do no job, write the figures of those that are done."""
    logs: int = 200
    """Synthetic logs of the coverage."""
    plant_logs: int = 50
    """Logs of the contact plant of the coverage."""
    other_logs: int = 0
    """Logs of each of the contact plant's other vehicles, a scooter and a robot, of the coverage."""
    told_again: bool = False
    """Of the coverage: search nothing, take intervals by the present code where the searches kept in `work` ended."""
    search_log: str = "plant"
    """Log of starts, tpe and searches: plant (the shared plain chair), planted, or a folder."""
    search_trials: int = 18
    """Training trials of it."""
    search_seeds: int = 10
    """Runs of each search."""
    tpe_trials: int = 500
    """Parameter sets of a search with TPE."""
    methods: tuple[str, ...] = ("features", "both", "tpe", "cmaes")
    """Searches that are compared."""
    search_starts: int = 2
    """Starts of the gradient searches among them."""
    many: int = fit_searches.STARTS
    """Starts at once of many_starts."""
    whole: bool = True
    """Whether many_starts goes on from the best of them with the rest of the default search."""
    terrains: tuple[Literal["asphalt", "sand", "pooled"], ...] = ("asphalt", "sand", "pooled")
    """Fits of the DRIVE runs."""
    windows: int = 66
    """Training windows of a measured set that are fitted (6 s; half as many of 15 s), spread evenly; all held-out
    ones are scored."""
    iterations: int = 20
    """Iterations of the gradient search on poses."""
    calibrate: bool = True
    """Of plant, chair, contact and few: fit true wheel sizes and the tracked point too. Without, figures have another
    name: what do these parameters cost on logs that do not need them?"""
    all_sizes: bool = False
    """Of the same parts: keep all of them free, needed or not."""
    repeats: int = 3
    """Timed fits."""
    seeds: tuple[int, ...] = (2000, 2001, 2002)
    """Days of the contact plant (`benchmarks.plant`)."""
    physics_dt: float = 0.005
    """Physics step of the fits of measured sets, of TPE and of many starts at once [s]: searches find the same valleys
    with twice the step of a fit, which ends with its own."""
    presets: tuple[Literal["paper", "physical"], ...] = ("physical", "paper")
    """Base models."""

    @property
    def tag(self) -> str:
        """What the names of figures of fits without calibration, or with all of it, end in."""
        return "_all_free" if self.all_sizes else "" if self.calibrate else "_as_stated"

    def fitted(self, **more: Any) -> FitConfig:
        """Settings of a fit with these iterations and sizes."""
        return FitConfig(iterations=self.iterations, calibrate=self.calibrate, all_sizes=self.all_sizes, **more)
