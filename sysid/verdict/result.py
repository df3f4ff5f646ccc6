"""The result of a closed loop: settings, the vehicle with its catalogue, and what was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Annotated, Any, Literal

import numpy as np

from sysid.errors.noise import NoiseLevels
from sysid.logs.floor import FloorChange
from sysid.logs.records import Log, Trial
from sysid.missing.catalogue import Hypothesis, base_values
from sysid.missing.days import Reference, Wander
from sysid.missing.drives import Drives, make_drives
from sysid.missing.evidence import Evidence, column_layout
from sysid.missing.joint_fit import Refit
from sysid.replay.records import FreeVehicle, Plant
from sysid.replay.rollout import PathReplay
from sysid.verdict.agreement import Heterogeneity, foretold, heterogeneity, interval_of_sum, sizes_apart
from sysid.verdict.falsifiers import Tested, in_words
from sysid.verdict.posterior import Thresholds
from sysid.verdict.search_record import NullRefits, Search
from whill_mjx.io.command_line import PHYSICS_DT, SEED, Range


@dataclass(frozen=True)
class Support:
    """What speaks for one effect of a joint fit, and against it."""

    effect: str
    sizes: np.ndarray  # (G,) that each manoeuvre by itself asks for, as a factor on the joint fit
    errors: np.ndarray  # (G,) their standard errors
    agreement: Heterogeneity
    foretold: np.ndarray  # (G,) squared residual that the others' fit saves each manoeuvre
    interval: tuple[float, float]  # 95 % of the sum of it, manoeuvres drawn anew
    falsifiers: tuple[Tested, ...]

    @classmethod
    def of(cls, fit: Refit, part: slice, groups: Sequence[Sequence[int]], precision: np.ndarray, effect: str,
           falsifiers: tuple[Tested, ...] = ()) -> Support:
        """That of an effect whose coordinates are `part` of q; `groups`: trials of each manoeuvre."""
        sizes, errors = sizes_apart(fit, part, groups, precision)
        gains = foretold(fit, part, groups, precision)
        return cls(effect, sizes, errors, heterogeneity(sizes, errors), gains, interval_of_sum(gains), falsifiers)

    def against(self, thresholds: Thresholds) -> list[str]:
        """What contradicts the effect, in words."""
        out = [in_words(one) for one in self.falsifiers if one.outcome == "falsified"]
        seen = int(self.agreement.asked.sum())
        if self.agreement.outcome == "differ" and self.agreement.least > 2 * thresholds.form:
            out.append(f"the {seen} manoeuvres that excite {self.effect} differ on its size by "
                       f"{self.agreement.scatter:.0%} of it (at least {self.agreement.least:.0%})")
        if seen > 1 and self.interval[1] <= 0:
            out.append(f"{self.effect} is wrong about manoeuvres that were held back")
        return out


@dataclass(frozen=True)
class LoopConfig:
    """How the loop is closed."""

    preset: Literal["paper", "physical"] = "physical"
    """Base model."""
    iterations: Annotated[int, Range(1, 10_000)] = 15
    """Iterations of the base fit."""
    draws: Annotated[int, Range(1, 10_000_000)] = 1000
    """Simulated nulls that the decision is calibrated on."""
    seed: Annotated[int, SEED] = 0
    """Of the simulated nulls."""
    refit_nulls: Annotated[int, Range(0, 1_000_000)] = 0
    """Simulated days with nothing missing that are refitted as the drives are; from 200 they decide too."""
    quick: bool = False
    """Fewer iterations, nulls and candidates."""
    physics_dt: Annotated[float, PHYSICS_DT] = 0.005
    """Physics step [s]."""
    with_effects: tuple[str, ...] = ()
    """Effects of the catalogue that the base model has as well, fitted like its own."""
    held: tuple[str, ...] = ()
    """Base parameters that keep their value; an effect that is one of them is then looked for, not fitted before;
    `pose_delay.delay` is what it is."""
    pose_delay: bool = False
    """Look for a late outside pose too: where its stamps are those of receipt. Logs whose loader says so
    (`fields["pose_stamps"]`) are always asked."""
    poses: bool = True
    """After the verdict, refit the vehicle to whole poses."""
    without: tuple[str, ...] = ()
    """Effects of the catalogue that are not looked for."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    """When something counts as found."""

    @property
    def nulls(self) -> int:
        """Simulated nulls, fewer where it must be quick."""
        return min(self.draws, 300) if self.quick else self.draws

    @property
    def base_iterations(self) -> int:
        """Iterations of the base fit, fewer where it must be quick."""
        return max(self.iterations // 2, 4) if self.quick else self.iterations


@dataclass(frozen=True)
class Prepared:
    """All of a vehicle that does not depend on the drives in question; its compiled replay serves many logs."""

    reference: Reference
    plant: Plant
    hypotheses: tuple[Hypothesis, ...]
    full: Any  # the vehicle with the whole catalogue at neutral
    names: tuple[str, ...]
    paths: PathReplay
    wander: Wander
    others: dict[Any, PathReplay] = field(default_factory=dict)  # compiled replays of vehicles with other effects

    @property
    def vehicle(self) -> FreeVehicle:
        """With every parameter free that has an effect in the catalogue or in the base model."""
        return FreeVehicle(self.plant, self.full, self.names)

    @property
    def values(self) -> np.ndarray:
        """(all,) of these parameters."""
        base = base_values(self.full)
        return np.array([base[name] for name in self.names])

    def drives(self, trials: tuple[Trial, ...], track: float) -> tuple[Drives, np.ndarray]:
        """Drives of trials, weighted by the noise that their motion has, and their features (B, K, C) without any
        effect."""
        reference = self.reference
        drives = make_drives(self.vehicle, trials, reference.width, self.paths, reference.gyro)
        at = drives.simulate(self.values[None])[0]
        return drives.weighted(at, reference.factors, track), at

    def without(self, effects: Sequence[str]) -> Prepared:
        """The same without some effects of the catalogue; nothing is compiled or simulated again."""
        known = {one.effect for one in self.hypotheses}
        if unknown := sorted(set(effects) - known):
            raise ValueError(f"without: there is no effect {unknown[0]!r} (known: {', '.join(sorted(known))}).")
        kept = [one.effect not in effects for one in self.hypotheses]
        columns = column_layout(self.hypotheses, self.reference.space.size)
        return replace(self, hypotheses=tuple(compress(self.hypotheses, kept)),
                       wander=self.wander.of([kept[one.hypothesis] for one in columns]))


@dataclass(frozen=True, eq=False)
class Result:
    """A closed loop before the held-out trials are opened."""

    log: Log
    references: tuple[Log, ...]
    config: LoopConfig
    prepared: Prepared
    search: Search
    evidence: Evidence
    seconds: dict[str, float]
    null_refits: NullRefits | None = None
    stood: tuple[Support, ...] = ()  # for and against each effect of the final fit, where one was about to be named
    noise: NoiseLevels | None = None  # noise of each channel over that of the reference days; None without such days
    floor: FloorChange | None = None  # beside that of the reference days; None where nothing could show it

    @property
    def reference(self) -> Reference:
        return self.prepared.reference

    @property
    def plant(self) -> Plant:
        return self.prepared.plant

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        return self.prepared.hypotheses

    @property
    def full(self) -> Any:
        return self.prepared.full

    @property
    def names(self) -> tuple[str, ...]:
        return self.prepared.names
