"""Days with nothing missing, put through the same fits as the drives in question.

The nulls of `sysid.verdict.scan` are linear: they move along the columns of the base parameters. Those here are drives
of the simulator. A vehicle is drawn from the day-to-day spread and replayed, what the model left of one whole reference
day is added, and the whole search sees it as it sees measured drives. They show how often this very set of drives would
raise a false alarm, and calibrate its p-value without the assumption that the model is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sysid.missing.days import Wander, alike
from sysid.missing.evidence import Solver, at_fit
from sysid.missing.joint_fit import Refit, Start
from sysid.missing.refit import ITERATIONS, Refitter, side_by_side
from sysid.missing.signatures import white_leftover
from sysid.replay.cores import on_processor
from sysid.search.result import Progress
from sysid.verdict.posterior import Thresholds, posterior
from sysid.verdict.rounds import Asked
from sysid.verdict.scan import best, drawn_away, scan_again
from sysid.verdict.search_record import NullRefits, PairScan, Search, tails

TOGETHER, ACCELERATED = 16, 100  # days whose base fits advance side by side on a processor, and on an accelerator


def run(
    asked: Asked, judge: Callable[[Asked, PairScan | None], Search], pairs: PairScan | None, count: int, seed: int = 0,
    progress: Progress | None = None,
) -> NullRefits:
    """Simulate and judge `count` days.

    Args:
        judge: what the drives in question are judged by (`sysid.verdict.search.settle`).
        asked: of the drives in question; its linear nulls are what the first look at each day is held against.
        pairs: likewise of pairs of effects; None where pairs do not decide.
    """
    scan, hypotheses, wander, reference = asked.scan, asked.hypotheses, asked.wander, asked.refitter.reference
    rng = np.random.default_rng((seed, 1))
    factor = np.linalg.cholesky(reference.spread + 1e-14 * np.eye(len(reference.u)))
    p, alarms = np.ones(count), 0
    for n, (one, base) in enumerate(_days(asked.refitter, factor, rng, count)):
        around = at_fit(asked.evidence, base.residual, base.jacobian, base.u - reference.u)
        gain, worth, q = best(Solver(around), hypotheses, wander)
        day = replace(asked, evidence=around, refitter=one, base=base, far=None, report=lambda _: None,
                      scan=replace(scan, gain=gain, worth=worth, q=q, p=tails(scan.null, worth)))
        found = judge(day, None if pairs is None else scan_again(pairs, around, hypotheses, wander))
        p[n] = found.p_value
        alarms += found.verdict != "none"
        if progress is not None:
            progress(1, f"null refits, {alarms} of {n + 1} alarms")
    return NullRefits(p, alarms)


def _days(
    refitter: Refitter, factor: np.ndarray, rng: np.random.Generator, count: int
) -> Iterator[tuple[Refitter, Refit]]:
    """Simulated days, each with its base fit; `factor` (P, P) is that of the day-to-day spread. Several are replayed
    together: alone they would leave most rows of a replay unused."""
    reference = refitter.reference
    start = Start((), reference.u, np.zeros(0))
    together = TOGETHER if on_processor() else ACCELERATED
    for first in range(0, count, together):
        drawn = [(np.clip(reference.u + drawn_away(factor, rng), 0.0, 1.0), _noise(refitter, rng))
                 for _ in range(min(together, count - first))]
        seen = refitter.white_of(np.stack([u for u, _ in drawn]))
        days = [refitter.aimed(white + noise) for white, (_, noise) in zip(seen, drawn, strict=True)]
        yield from zip(days, side_by_side([(day, start) for day in days], ITERATIONS), strict=True)


def checked(found: Search, nulls: NullRefits, wander: Wander, thresholds: Thresholds) -> Search:
    """The verdict, taken back where simulated days with nothing in them often look the same."""
    if (found.verdict != "none" and len(nulls.p) >= 1 / thresholds.alpha
            and nulls.p_of(found.p_value) >= thresholds.alpha and wander.p_excess(found.excess[0]) >= thresholds.alpha):
        found.verdict, found.accepted, found.classes, found.final = "none", [], [], found.base
        found.share, found.excess = 0.0, (found.excess[0], found.excess[0])
        if found.findings is not None:
            found.findings = replace(found.findings, sets=())
            found.weights = posterior(found.findings, thresholds).weights
        found.reason = f"stands out no more than in {nulls.p_of(found.p_value):.1%} of simulated days without anything"
    return found


def _noise(refitter: Refitter, rng: np.random.Generator) -> np.ndarray:
    """(B, n) white: what the model left of the drives of one reference day, with either sign."""
    reference, drives = refitter.reference, refitter.drives
    day = int(rng.choice(sorted({one.day for one in reference.leftovers})))
    mine = [one for one in reference.leftovers if one.day == day]
    rows, taken = [], dict.fromkeys(range(len(mine)), 0)
    for trial, mask in zip(drives.trials, drives.mask, strict=True):
        like = ([i for i, one in enumerate(mine) if alike(one.trial, trial)]
                or [i for i, one in enumerate(mine) if one.trial.manoeuvre == trial.manoeuvre] or list(taken))
        least = min(taken[i] for i in like)
        chosen = int(rng.choice([i for i in like if taken[i] == least]))  # each drive once before one comes again
        taken[chosen] += 1
        rows.append(white_leftover(reference, mine[chosen], mask))
    return float(rng.choice((-1.0, 1.0))) * np.stack(rows)
